//! The compiled codec plan of a message type.
//!
//! For output ([`CodecPlan::steps`]), nested messages are flattened and the literals between values (`,"stamp":`) are
//! prepared in JSON and in CBOR. For input ([`CodecPlan::members`]), fields stay grouped by message, because they may
//! come in any order.

use std::ops::Range;

use crate::RosVersion;
use crate::cbor_head::{MAP, TEXT, write_head};
use crate::schema::initial::Initial;
use crate::schema::{Arity, Base, Field};

pub(crate) use crate::schema::kind::{Count, Kind, Scalar, Text};

/// Maximum number of steps of a nested message to be flattened; larger ones are called, as are all once the plan has
/// grown to `MAX_FLATTENED_JSON` bytes of literals. Otherwise a plan could grow exponentially with the depth of its
/// definition.
const MAX_FLATTENED: usize = 32;
const MAX_FLATTENED_JSON: usize = 4096;

/// The compiled form of a message type.
#[derive(Debug, Default)]
pub(crate) struct CodecPlan {
    /// Minimum size of a message in bytes, excluding padding; in ROS 1 the default message is this many zeros.
    pub(crate) min_size: usize,
    /// True if every message takes `min_size` bytes plus padding.
    pub(crate) fixed_size: bool,
    /// True for ROS 2 types without fields, which are serialized as one byte.
    pub(crate) placeholder: bool,
    /// Set for ROS 2's time and duration types, which within other messages are values rather than messages.
    pub(crate) scalar: Option<Scalar>,
    /// Number of values in an otherwise empty message.
    pub(crate) values: usize,
    /// Nesting of messages; 1 for a message that contains none.
    pub(crate) depth: usize,
    /// True for `std_msgs/Header`.
    pub(crate) header: bool,
    /// Entries for input: one per field.
    pub(crate) members: Members,
    /// Steps for output: one per value after flattening.
    pub(crate) steps: Vec<PlanStep>,
    /// The literal after the last value.
    pub(crate) tail: Literal,
    json: Pool,
    cbor: Pool,
    /// Names of fields and of the flattened fields that contain them.
    names: Vec<Name>,
}

/// A segment of a step's path.
#[derive(Debug)]
struct Name {
    outer: Option<usize>,
    name: Box<str>,
}

/// The field that headers have in ROS 1 alone.
pub(crate) const SEQ: &str = "seq";

/// The fields of a message, for input.
#[derive(Debug, Default)]
pub(crate) struct Members {
    list: Vec<Member>,
    /// Indices into `list`, sorted by name.
    sorted: Vec<usize>,
    /// True for the header of ROS 2: clients made for ROS 1 write `seq`, too, which is read and dropped.
    drops_seq: bool,
}

/// A field, for input.
#[derive(Debug)]
pub(crate) struct Member {
    pub(crate) name: Box<str>,
    /// `"name":`, in its usual spelling.
    pub(crate) json_key: Box<[u8]>,
    /// The name as a CBOR string.
    pub(crate) cbor_key: Box<[u8]>,
    pub(crate) kind: Kind,
    pub(crate) min_size: usize,
    /// Default value; otherwise zeros, empty texts and arrays.
    pub(crate) initial: Option<Initial>,
}

/// A value, for output.
#[derive(Debug)]
pub(crate) struct PlanStep {
    /// The literal before the value.
    pub(crate) before: Literal,
    pub(crate) kind: Kind,
    name: usize,
}

/// Ranges in a plan's prepared JSON and CBOR.
#[derive(Debug, Clone, Default)]
pub(crate) struct Literal {
    json: Range<usize>,
    cbor: Range<usize>,
}

/// Prepared bytes. Padding follows the last piece, so that a short piece can be copied as a block of a size known at
/// compile time: a third of the time.
#[derive(Debug, Default)]
struct Pool(Vec<u8>);

const BLOCK: usize = 32;

impl Pool {
    #[inline]
    fn append_to(&self, piece: &Range<usize>, out: &mut Vec<u8>) {
        match self.0[piece.start..].first_chunk::<BLOCK>() {
            Some(block) if piece.len() <= BLOCK => {
                let end = out.len() + piece.len();
                out.extend_from_slice(block);
                out.truncate(end);
            }
            _ => out.extend_from_slice(&self.0[piece.clone()]),
        }
    }
}

impl CodecPlan {
    /// Compiles the plan of message `name`.
    pub(crate) fn compile(version: RosVersion, name: &str, fields: &[Field]) -> CodecPlan {
        let depths = fields.iter().map(|field| match &field.base {
            Base::Message(inner) => inner.plan.depth + 1,
            Base::Primitive(_) => 1,
        });
        let placeholder = version == RosVersion::Two && fields.is_empty();
        let min_size: usize = fields.iter().map(Field::min_size).sum();
        let mut plan = CodecPlan {
            min_size: min_size + usize::from(placeholder),
            placeholder,
            scalar: scalar(version, name, fields),
            fixed_size: fields.iter().all(Field::is_fixed_size),
            values: CodecPlan::count_values(fields),
            depth: depths.max().unwrap_or(1),
            header: is_header(version, name, fields),
            members: Members::new(fields.iter().map(member).collect()),
            ..CodecPlan::default()
        };
        plan.members.drops_seq = plan.header && version == RosVersion::Two;
        let mut pending = Pending::default();
        plan.flatten(fields, None, &mut pending);
        plan.tail = plan.literal(&mut pending);
        for pool in [&mut plan.json, &mut plan.cbor] {
            pool.0.extend_from_slice(&[0; BLOCK]);
        }
        plan
    }

    /// Returns the number of values that a message with these fields always holds; each element of a fixed array of
    /// messages counts.
    pub(crate) fn count_values(fields: &[Field]) -> usize {
        fields.iter().fold(0, |sum: usize, field| {
            let values = match (&field.base, field.arity) {
                (Base::Message(inner), Arity::One) => inner.plan.values + 1,
                (Base::Message(inner), Arity::Fixed(count)) => (inner.plan.values + 1).saturating_mul(count as usize),
                _ => 1,
            };
            sum.saturating_add(values)
        })
    }

    /// Appends a literal's JSON.
    #[inline]
    pub(crate) fn push_json(&self, literal: &Literal, out: &mut Vec<u8>) {
        self.json.append_to(&literal.json, out);
    }

    /// Appends a literal's CBOR.
    #[inline]
    pub(crate) fn push_cbor(&self, literal: &Literal, out: &mut Vec<u8>) {
        self.cbor.append_to(&literal.cbor, out);
    }

    /// Returns the path of a step's field from the top of the message: `header.stamp`.
    #[cold]
    pub(crate) fn path(&self, step: &PlanStep) -> String {
        let mut parts = Vec::new();
        let mut next = Some(step.name);
        while let Some(index) = next {
            parts.push(&*self.names[index].name);
            next = self.names[index].outer;
        }
        parts.reverse();
        parts.join(".")
    }

    fn flatten(&mut self, fields: &[Field], outer: Option<usize>, pending: &mut Pending) {
        pending.json.push(b'{');
        write_head(&mut pending.cbor, MAP, fields.len() as u64);
        for (index, field) in fields.iter().enumerate() {
            if index > 0 {
                pending.json.push(b',');
            }
            pending.json.extend_from_slice(&json_key(&field.name));
            pending.cbor.extend_from_slice(&cbor_key(&field.name));
            self.names.push(Name { outer, name: field.name.as_str().into() });
            let name = self.names.len() - 1;
            match Kind::from_field(field) {
                Kind::Struct(inner) if self.can_flatten(&inner.plan) => {
                    self.flatten(inner.fields(), Some(name), pending);
                }
                kind => {
                    let before = self.literal(pending);
                    self.steps.push(PlanStep { before, kind, name });
                }
            }
        }
        pending.json.push(b'}');
    }

    fn can_flatten(&self, inner: &CodecPlan) -> bool {
        let small = inner.values <= MAX_FLATTENED && inner.json.0.len() <= MAX_FLATTENED_JSON;
        small && !inner.placeholder && self.json.0.len() <= MAX_FLATTENED_JSON
    }

    fn literal(&mut self, pending: &mut Pending) -> Literal {
        let (json, cbor) = (self.json.0.len(), self.cbor.0.len());
        self.json.0.append(&mut pending.json);
        self.cbor.0.append(&mut pending.cbor);
        Literal { json: json..self.json.0.len(), cbor: cbor..self.cbor.0.len() }
    }
}

/// Literals collected since the last value.
#[derive(Default)]
struct Pending {
    json: Vec<u8>,
    cbor: Vec<u8>,
}

impl Members {
    pub(crate) fn new(list: Vec<Member>) -> Members {
        let mut sorted: Vec<usize> = (0..list.len()).collect();
        sorted.sort_unstable_by_key(|index| list[*index].name.as_bytes());
        Members { list, sorted, drops_seq: false }
    }

    /// Returns the fields in order of serialization.
    #[inline]
    pub(crate) fn list(&self) -> &[Member] {
        &self.list
    }

    /// Returns the index of the field of this name; for a `seq` that is to be dropped, the number of fields.
    pub(crate) fn find(&self, name: &[u8]) -> Option<usize> {
        match self.sorted.binary_search_by_key(&name, |index| self.list[*index].name.as_bytes()) {
            Ok(at) => Some(self.sorted[at]),
            Err(_) => (self.drops_seq && name == SEQ.as_bytes()).then_some(self.list.len()),
        }
    }
}

impl Member {
    pub(crate) fn new(name: &str, kind: Kind, min_size: usize) -> Member {
        Member {
            name: name.into(),
            json_key: json_key(name).into(),
            cbor_key: cbor_key(name).into(),
            kind,
            min_size,
            initial: None,
        }
    }
}

/// Returns the key in JSON. Field names are plain ASCII, so there is nothing to escape.
fn json_key(name: &str) -> Vec<u8> {
    format!("\"{name}\":").into_bytes()
}

fn cbor_key(name: &str) -> Vec<u8> {
    let mut key = Vec::with_capacity(name.len() + 2);
    write_head(&mut key, TEXT, name.len() as u64);
    key.extend_from_slice(name.as_bytes());
    key
}

fn member(field: &Field) -> Member {
    Member { initial: field.initial.clone(), ..Member::new(&field.name, Kind::from_field(field), field.min_size()) }
}

/// Returns true if the fields have exactly these names and types and none is an array.
fn is_shape(fields: &[Field], shape: &[(&str, &str)]) -> bool {
    let alike = |(field, (name, type_name)): (&Field, &(&str, &str))| {
        field.name == *name && field.type_name == *type_name && field.arity == Arity::One
    };
    fields.len() == shape.len() && fields.iter().zip(shape).all(alike)
}

/// Returns true for the standard `std_msgs/Header`, with its stamp at byte 4: after the sequence number in ROS 1, after
/// the encapsulation header in ROS 2.
fn is_header(version: RosVersion, name: &str, fields: &[Field]) -> bool {
    const TIME: &str = "builtin_interfaces/msg/Time";
    match version {
        RosVersion::One => {
            let shape = [("seq", "uint32"), ("stamp", "time"), ("frame_id", "string")];
            name == "std_msgs/Header" && is_shape(fields, &shape)
        }
        RosVersion::Two => {
            let shape = [("stamp", TIME), ("frame_id", "string")];
            let stamps = || matches!(Kind::from_field(&fields[0]), Kind::Scalar(Scalar::Time2));
            name == "std_msgs/msg/Header" && is_shape(fields, &shape) && stamps()
        }
    }
}

/// Returns the scalar for the standard time and duration types of ROS 2.
fn scalar(version: RosVersion, name: &str, fields: &[Field]) -> Option<Scalar> {
    let scalar = match (version, name) {
        (RosVersion::Two, "builtin_interfaces/msg/Time") => Scalar::Time2,
        (RosVersion::Two, "builtin_interfaces/msg/Duration") => Scalar::Duration2,
        _ => return None,
    };
    let known = is_shape(fields, &[("sec", "int32"), ("nanosec", "uint32")])
        && fields.iter().all(|field| field.initial.is_none());
    known.then_some(scalar)
}
