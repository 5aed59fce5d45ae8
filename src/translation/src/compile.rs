//! Compiles the pairs of two definitions to the programs that carry messages from one to the other.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use ros_message::RosVersion;
use ros_message::codec::cursor::MessageCursor;
use ros_message::codec::default_message;
use ros_message::schema::{MessageType, Primitive};

use crate::number::Number;
use crate::pairing::{Pairings, Path, stamp_of_message, stamp_of_primitive, write_path};
use crate::program::{Action, Piece, Program, Step};
use crate::shape::{Count, PLACEHOLDER, Shape, Shapes, Slot, SlotBase, is_placeholder};
use crate::text::TextForm;

/// Maximum number of steps of a message that become steps of the message around it; longer ones are called, as are all
/// once the outer one has `MAX_STEPS`. Otherwise programs could grow exponentially with the depth of their definition.
const MAX_INLINED: usize = 64;
const MAX_STEPS: usize = 1024;

/// Maximum length in bytes of the path of a step that becomes one of the message around it.
const MAX_PATH: usize = 512;

/// Compiles programs from one ROS version to the other, and keeps those of messages.
pub(crate) struct Compiler<'a> {
    pairings: &'a Pairings,
    from: RosVersion,
    sources: Shapes,
    targets: Shapes,
    programs: HashMap<(String, String), Arc<Program>>,
}

/// The fields of one side that are paired, with those of the other side.
type ByPath<'p> = BTreeMap<&'p Path, &'p Path>;

/// A field of the source, in order of serialization.
struct Source {
    path: Path,
    shape: Shape,
    is_paired: bool,
}

/// A field of the target, in order of serialization.
enum Target {
    /// It is made of this field of the source.
    Paired { source: Path, target: Path },
    /// The source has nothing for it.
    Alone(Shape),
}

impl<'a> Compiler<'a> {
    /// Creates a compiler of messages of ROS `from`.
    pub(crate) fn new(pairings: &'a Pairings, from: RosVersion) -> Compiler<'a> {
        Compiler {
            pairings,
            from,
            sources: Shapes::new(from),
            targets: Shapes::new(from.other()),
            programs: HashMap::new(),
        }
    }

    /// Returns the program for two messages whose pairs are known.
    pub(crate) fn message(&mut self, source: &MessageType, target: &MessageType) -> Arc<Program> {
        let key = (source.name().to_owned(), target.name().to_owned());
        if let Some(known) = self.programs.get(&key) {
            return known.clone();
        }
        let program = Arc::new(self.compile(source, target));
        self.programs.insert(key, program.clone());
        program
    }

    /// Returns about how many bytes all programs take.
    pub(crate) fn bytes_held(&self) -> usize {
        self.programs.values().map(|program| program.bytes_held()).sum()
    }

    fn compile(&mut self, source: &MessageType, target: &MessageType) -> Program {
        let pairs = match self.from {
            RosVersion::One => self.pairings.get(source.name(), target.name()).iter(),
            RosVersion::Two => self.pairings.get(target.name(), source.name()).iter(),
        };
        let pairs: Vec<(&Path, &Path)> = pairs
            .map(|pair| match self.from {
                RosVersion::One => (&pair.one, &pair.two),
                RosVersion::Two => (&pair.two, &pair.one),
            })
            .collect();
        let mut targets = Vec::new();
        let by_target: ByPath<'_> = pairs.iter().map(|(source, target)| (*target, *source)).collect();
        self.list_targets(target, &mut Path::new(), &by_target, &mut targets);
        let mut sources = Vec::new();
        let by_source: ByPath<'_> = pairs.iter().copied().collect();
        self.list_sources(source, &mut Path::new(), &by_source, &mut sources);

        let order = targets.iter().filter_map(|target| match target {
            Target::Paired { source, .. } => Some(source),
            Target::Alone(_) => None,
        });
        let paired = || sources.iter().filter(|source| source.is_paired).map(|source| &source.path);
        let is_in_order = paired().eq(order);
        let places: BTreeMap<&Path, usize> = paired().zip(0..).collect();
        let fills = Fills::new(target, &targets);
        let mut assembly = Assembly::default();
        let mut next_source = 0;
        for (index, one) in targets.iter().enumerate() {
            match one {
                Target::Alone(_) => assembly.fill(fills.get(index)),
                Target::Paired { source: from, target: to } => {
                    if is_in_order {
                        while let Some(skipped) = sources.get(next_source).filter(|source| !source.is_paired) {
                            assembly.push(Step::new(source, &skipped.path, Action::Skip(skipped.shape.clone())));
                            next_source += 1;
                        }
                        next_source += 1;
                    } else {
                        let place = places.get(from).copied().unwrap_or_default();
                        assembly.push(Step::new(source, from, Action::Jump(place)));
                    }
                    let slots = (Slot::at_path(source, from), Slot::at_path(target, to));
                    if let (Some(source_slot), Some(target_slot)) = slots {
                        let action = self.action(&source_slot, &target_slot);
                        assembly.push_or_inline(Step::new(source, from, action));
                    }
                }
            }
        }
        if is_in_order {
            for skipped in &sources[next_source.min(sources.len())..] {
                assembly.push(Step::new(source, &skipped.path, Action::Skip(skipped.shape.clone())));
            }
        } else {
            let scan = sources.into_iter().map(|source| (source.shape, source.is_paired));
            assembly.program.scan = scan.collect();
        }
        assembly.program
    }

    /// Lists the fields of a target; those of a message of which only parts are paired in its place.
    fn list_targets(&mut self, root: &MessageType, path: &mut Path, pairs: &ByPath<'_>, targets: &mut Vec<Target>) {
        if let Some(source) = pairs.get(path) {
            targets.push(Target::Paired { source: (*source).clone(), target: path.clone() });
            return;
        }
        let Some(slot) = Slot::at_path(root, path) else {
            return;
        };
        let SlotBase::Message(message) = slot.base else {
            targets.push(Target::Alone(self.targets.slot(&slot)));
            return;
        };
        if !has_parts(path, pairs) {
            targets.push(Target::Alone(self.targets.slot(&slot)));
            return;
        }
        for index in 0..message.fields().len() {
            path.push(index);
            self.list_targets(root, path, pairs, targets);
            path.pop();
        }
        if is_placeholder(message) {
            targets.push(Target::Alone(PLACEHOLDER));
        }
    }

    /// Lists the fields of a source likewise.
    fn list_sources(&mut self, root: &MessageType, path: &mut Path, pairs: &ByPath<'_>, sources: &mut Vec<Source>) {
        let Some(slot) = Slot::at_path(root, path) else {
            return;
        };
        let is_paired = pairs.contains_key(path);
        match slot.base {
            SlotBase::Message(message) if !is_paired && has_parts(path, pairs) => {
                for index in 0..message.fields().len() {
                    path.push(index);
                    self.list_sources(root, path, pairs, sources);
                    path.pop();
                }
                if is_placeholder(message) {
                    sources.push(Source { path: path.clone(), shape: PLACEHOLDER, is_paired: false });
                }
            }
            _ => sources.push(Source { path: path.clone(), shape: self.sources.slot(&slot), is_paired }),
        }
    }

    /// Returns the action for a field.
    fn action(&mut self, source: &Slot<'_>, target: &Slot<'_>) -> Action {
        let element = self.element(source, target);
        let (Some(from), Some(to)) = (source.count(), target.count()) else {
            return element;
        };
        match (from, to, element) {
            (Count::Fixed(count), Count::Fixed(_), Action::Copy { width, bytes }) => {
                Action::Copy { width, bytes: bytes.saturating_mul(count) }
            }
            (from, to, element) => {
                Action::Array { from, to, min_size: source.element_min_size(), element: Box::new(element) }
            }
        }
    }

    /// Returns the action for one value.
    fn element(&mut self, source: &Slot<'_>, target: &Slot<'_>) -> Action {
        match (source.base, target.base) {
            (SlotBase::Message(source), SlotBase::Message(target)) => {
                let program = self.message(source, target);
                match (&program.steps[..], program.scan.is_empty()) {
                    ([Step { action: copy @ Action::Copy { .. }, .. }], true) => copy.clone(),
                    _ => Action::Message(program),
                }
            }
            (SlotBase::Primitive(primitive), SlotBase::Message(message))
            | (SlotBase::Message(message), SlotBase::Primitive(primitive)) => {
                match stamp_of_primitive(primitive).or_else(|| stamp_of_message(message)) {
                    Some(stamp) => Action::Stamp(stamp),
                    // Not paired.
                    None => Action::Copy { width: 1, bytes: 0 },
                }
            }
            (SlotBase::Primitive(from), SlotBase::Primitive(to)) => {
                match (Number::from_primitive(from), Number::from_primitive(to)) {
                    (Some(from), Some(to)) => {
                        // A `byte` is signed in ROS 1 and unsigned in ROS 2, and means its bits in both.
                        let is_byte = [source, target].iter().any(|slot| slot.type_name == "byte");
                        let same = from == to || (is_byte && from.width() == to.width());
                        // Nodes of ROS 2 refuse a bool that is neither 0 nor 1.
                        let is_loose = from == Number::BOOL && self.from == RosVersion::One;
                        if same && !is_loose {
                            Action::Copy { width: from.width(), bytes: from.width() }
                        } else {
                            Action::Number { from, to }
                        }
                    }
                    _ => Action::Text {
                        from: text_form(self.from, from),
                        to: text_form(self.from.other(), to),
                        most: target.bounds.text.map(|most| most as usize),
                    },
                }
            }
        }
    }
}

/// Returns true for the message itself, and for a field of which parts are paired.
fn has_parts(path: &Path, pairs: &ByPath<'_>) -> bool {
    path.is_empty() || pairs.range::<Path, _>(path..).next().is_some_and(|(next, _)| next.starts_with(path))
}

fn text_form(version: RosVersion, primitive: Primitive) -> TextForm {
    match (version, primitive) {
        (_, Primitive::Wstring) => TextForm::Wide,
        (RosVersion::One, _) => TextForm::Packed,
        (RosVersion::Two, _) => TextForm::Terminated,
    }
}

impl Step {
    fn new(message: &MessageType, path: &[usize], action: Action) -> Step {
        Step { path: write_path(message, path).into(), action }
    }
}

/// A program under construction.
#[derive(Default)]
struct Assembly {
    program: Program,
}

impl Assembly {
    /// Appends a step, joined to the last one if both copy numbers of one width: there is no padding between them.
    fn push(&mut self, step: Step) {
        if let (
            Some(Step { action: Action::Copy { width, bytes }, .. }),
            Action::Copy { width: more_width, bytes: more },
        ) = (self.program.steps.last_mut(), &step.action)
        {
            if width == more_width && *bytes > 0 && *more > 0 {
                *bytes = bytes.saturating_add(*more);
                return;
            }
        }
        self.program.steps.push(step);
    }

    /// Appends a step, or those of the message that it carries.
    fn push_or_inline(&mut self, step: Step) {
        let Action::Message(inner) = &step.action else {
            self.push(step);
            return;
        };
        self.program.filled = self.program.filled.saturating_add(inner.filled);
        let is_short = inner.steps.len() <= MAX_INLINED
            && self.program.steps.len() <= MAX_STEPS
            && inner.steps.iter().all(|one| step.path.len() + one.path.len() < MAX_PATH);
        if !is_short || !inner.scan.is_empty() {
            self.push(step);
            return;
        }
        for Step { path, action } in &inner.steps {
            let names = [&*step.path, path].into_iter().filter(|name| !name.is_empty());
            let path = names.collect::<Vec<_>>().join(".").into();
            self.push(Step { path, action: action.clone() });
        }
    }

    fn fill(&mut self, pieces: Arc<[Piece]>) {
        for piece in pieces.iter() {
            let size = match piece {
                Piece::Bytes { bytes, .. } => bytes.len(),
                Piece::Zeros { count, .. } => *count,
            };
            self.program.filled = self.program.filled.saturating_add(size + 8);
        }
        self.program.steps.push(Step { path: "".into(), action: Action::Fill(pieces) });
    }
}

/// The defaults of a target's fields.
struct Fills(HashMap<usize, Arc<[Piece]>>);

impl Fills {
    /// Reads the defaults of those targets that the source has nothing for.
    fn new(message: &MessageType, targets: &[Target]) -> Fills {
        let mut fills = HashMap::new();
        if !targets.iter().any(|target| matches!(target, Target::Alone(_))) {
            return Fills(fills);
        }
        let bytes = default_message(message);
        let Some(mut cursor) = MessageCursor::new(message.version(), &bytes) else {
            return Fills(fills);
        };
        let mut shapes = Shapes::new(message.version());
        for (index, target) in targets.iter().enumerate() {
            let mut pieces = Vec::new();
            let walked = match target {
                Target::Alone(shape) => {
                    shape.walk(&mut cursor, &mut |width, bytes| add_piece(&mut pieces, width, bytes))
                }
                Target::Paired { target, .. } => match Slot::at_path(message, target) {
                    Some(slot) => shapes.slot(&slot).skip(&mut cursor),
                    None => Ok(()),
                },
            };
            // The default was written by this definition and can be read by it.
            if walked.is_ok() {
                fills.insert(index, pieces.into());
            }
        }
        Fills(fills)
    }

    fn get(&self, index: usize) -> Arc<[Piece]> {
        self.0.get(&index).cloned().unwrap_or_default()
    }
}

/// Adds bytes of a default. Zeros take no memory.
fn add_piece(pieces: &mut Vec<Piece>, width: usize, bytes: &[u8]) {
    if bytes.is_empty() {
        return;
    }
    if bytes.iter().any(|byte| *byte != 0) {
        pieces.push(Piece::Bytes { width, bytes: bytes.into() });
        return;
    }
    match pieces.last_mut() {
        Some(Piece::Zeros { width: last, count }) if *last == width => *count += bytes.len(),
        _ => pieces.push(Piece::Zeros { width, count: bytes.len() }),
    }
}
