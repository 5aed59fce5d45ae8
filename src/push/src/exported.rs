//! A revision as it goes from one server to another: its image as an OCI image layout, and beside it this record, which says what image
//! tools have no words for. `GET /api/v1/services/NAME/record` gives it, `cloudroidctl export` puts it into the archive as a blob that the
//! annotation [`RECORD`] of the image names, and a push of the archive reads it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use api::PushOptions;
use api::dictionary::{NewRows, Row};
use foreign::Tree;
use image::Received;
use package::interface::Interface;
use package::inventory::{Inventory, Published};
use package::names::{is_graph_name, is_package};
use package::requests::Reason;
use rootfs_builder::{
    BuildOutcome, BuiltLayer, LaunchNode, LaunchPlan, blocking, wrong_with_components,
};
use ros::flavour::Flavour;
use serde::{Deserialize, Serialize};
use servant::spec::NodeSpec;
use store::{Plan, RevisionRecord};

use super::request::Reporter;
use super::{Error, HOME_INSIDE, Made, Options, Pusher};

/// The annotation of the image's entry whose value is the digest of the record.
pub const RECORD: &str = "org.cloudroid.record";
/// Of this module's form.
const FORMAT: u32 = 1;
/// Characters of what was pushed, in words, that are kept: each export and import adds some.
const LONGEST_SOURCE: usize = 200;
/// Bytes of a record at most: as values in memory it takes many times as much.
const LARGEST_RECORD: usize = 4 << 20;
/// Nodes of a service at most.
const MOST_NODES: usize = 256;

/// What of a revision is not in its image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServiceRecord {
    /// Of the record; 1.
    pub format: u32,
    /// The service.
    pub service: String,
    /// The ROS package.
    pub package: String,
    /// What was pushed, in words.
    pub source: String,
    /// The ROS that its image is built for.
    pub flavour: Flavour,
    /// How its servants are started.
    pub plan: Plan,
    /// Its interface, definitions included.
    pub interface: Interface,
    /// What a measure of an SLA costs, as it was measured there.
    pub dictionary: Vec<Row>,
}

impl ServiceRecord {
    /// Of a revision, with the rows of its service.
    pub fn of(revision: &RevisionRecord, rows: Vec<Row>) -> Self {
        ServiceRecord {
            format: FORMAT,
            service: revision.service.clone(),
            package: revision.package.clone(),
            source: revision.source.clone(),
            flavour: revision.flavour.clone(),
            plan: revision.plan.clone(),
            interface: revision.interface.clone(),
            dictionary: rows,
        }
    }

    /// Reads the record that an image's entry names.
    fn read(layout: &Tree, annotations: &BTreeMap<String, String>) -> Result<Self, Error> {
        let Some(digest) = annotations.get(RECORD) else {
            return Err(refused(
                "the image was not exported from a service, and does not say how its nodes are started".to_owned(),
                "push the package itself, or what cloudroidctl export has written",
            ));
        };
        let bytes = digest
            .parse()
            .and_then(|digest| image::document(layout, &digest))
            .map_err(unreceivable)?;
        if bytes.len() > LARGEST_RECORD {
            return Err(unreadable(&format!(
                "it has {} bytes, and at most {LARGEST_RECORD} are read",
                bytes.len()
            )));
        }
        let record: Self =
            serde_json::from_slice(&bytes).map_err(|error| unreadable(&error.to_string()))?;
        if record.format != FORMAT {
            return Err(refused(
                format!(
                    "the record of the exported service is of form {}, and {FORMAT} is read here",
                    record.format
                ),
                "export it with the version of cloudroidctl that is used here",
            ));
        }
        record.check().map_err(|problem| unreadable(&problem))?;
        Ok(record)
    }

    /// What a push would have made sure of.
    fn check(&self) -> Result<(), String> {
        if !is_package(&self.package) {
            return Err(format!("{:?} is no name of a package", self.package));
        }
        let word = |text: &str| {
            let is_of_it = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
            !text.is_empty() && text.len() < 100 && text.chars().all(is_of_it)
        };
        if !word(&self.flavour.base) || !word(&self.flavour.distribution) {
            return Err("its base or distribution is no name".to_owned());
        }
        if self.plan.nodes.is_empty() {
            return Err("it starts no node".to_owned());
        }
        if self.plan.nodes.len() > MOST_NODES {
            return Err(format!(
                "it starts {} nodes, and at most {MOST_NODES} can be",
                self.plan.nodes.len()
            ));
        }
        environment(&self.plan.environment)?;
        for node in &self.plan.nodes {
            check_node(node)?;
        }
        let is_node = |name: &String| self.plan.nodes.iter().any(|node| node.name == *name);
        if let Some(problem) = wrong_with_components(&self.plan.components, &is_node) {
            return Err(problem);
        }
        if let Some(name) = self
            .plan
            .parameters
            .keys()
            .find(|name| !is_graph_name(name))
        {
            return Err(format!("{name:?} is no name of a parameter"));
        }
        Ok(())
    }

    /// As options of a push, of which `asked` may say the name, the source and the rollout.
    fn options(&self, asked: &PushOptions) -> Result<PushOptions, Error> {
        let plan = &self.plan;
        let interface = serde_json::to_string(&self.interface);
        let interface = interface.map_err(|error| unreadable(&error.to_string()))?;
        let printable = self.source.chars().filter(|c| !c.is_control());
        let before: String = printable.take(LONGEST_SOURCE).collect();
        let source = match asked.source.is_empty() {
            true => before,
            false => format!("{}, exported from {before}", asked.source),
        };
        Ok(PushOptions {
            name: Some(asked.name.clone().unwrap_or_else(|| self.service.clone())),
            limits: plan.limits,
            caps: plan.caps,
            sla: plan.sla,
            grants: plan.grants.clone(),
            stateful: plan.stateful,
            stateless: !plan.stateful,
            requests: {
                let requests = self.interface.requests.iter().flatten();
                let stated = requests.filter(|request| request.reason == Reason::Stated);
                stated.map(|request| request.pair.to_string()).collect()
            },
            shared: plan.shared,
            rollout: asked.rollout,
            interface: Some(interface),
            source,
            ..PushOptions::default()
        })
    }

    /// Rows that are written where the service has none yet.
    pub(super) fn rows(&self) -> NewRows {
        NewRows {
            rows: self.dictionary.clone(),
            replace: false,
        }
    }
}

fn check_node(node: &NodeSpec) -> Result<(), String> {
    if !is_graph_name(&node.name) {
        return Err(format!("{:?} is no name of a node", node.name));
    }
    let argv = &node.argv;
    let is_program = argv.first().is_some_and(|program| program.starts_with('/'));
    if !is_program || argv.iter().any(|word| word.contains('\0')) {
        return Err(format!(
            "node {} has no program that can be started",
            node.name
        ));
    }
    if !(0.0..=1e6).contains(&node.respawn_delay) {
        return Err(format!(
            "node {} comes again after no time that can be",
            node.name
        ));
    }
    environment(&node.environment)
}

fn environment(variables: &BTreeMap<String, String>) -> Result<(), String> {
    let is_good = |(name, value): &(&String, &String)| {
        !name.is_empty() && !name.contains(['=', '\0']) && !value.contains('\0')
    };
    match variables.iter().find(|variable| !is_good(variable)) {
        Some((name, _)) => Err(format!("{name:?} is no variable of an environment")),
        None => Ok(()),
    }
}

/// An exported service whose image is in the store.
pub(super) struct Imported {
    pub(super) record: ServiceRecord,
    pub(super) options: PushOptions,
    pub(super) built: BuildOutcome,
}

impl Pusher {
    /// An exported service, whose image is there already.
    pub(super) async fn taken_in(
        &self,
        options: &PushOptions,
        tree: PathBuf,
        report: &Reporter,
    ) -> Result<Made, Error> {
        check_options(options)?;
        report.step("taking in the exported service").await;
        let store = Arc::clone(self.catalogue.images());
        let (asked, limits) = (options.clone(), self.options.clone());
        let work = blocking::cancelled_with_this(move || take_in(&store, &tree, &asked, &limits));
        let imported = privilege::blocking(work)
            .await
            .map_err(|_| Error::Internal("taking in an exported service"))??;
        Ok(Made::Imported(Box::new(imported)))
    }

    /// Writes the rows of an exported service, where there are none: those that were measured here are better. The
    /// service is published without them, too.
    pub(super) fn take_over_rows(&self, name: &str, record: &ServiceRecord, report: &Reporter) {
        let rows = record.rows();
        if rows.rows.is_empty() {
            return;
        }
        let outcome = match rows.rows.iter().try_for_each(choreographer::check_row) {
            _ if rows.rows.len() > choreographer::MOST_ROWS => Err("there are too many".to_owned()),
            Err(reason) => Err(reason),
            Ok(()) => {
                (self.catalogue.take_over_rows(name, &rows)).map_err(|error| error.to_string())
            }
        };
        let count = rows.rows.len();
        let words = match outcome {
            Ok(true) => format!(
                "its dictionary has {count} rows that were measured on another machine; measure them here with: cloudroidctl calibrate {name}"
            ),
            Ok(false) => format!(
                "{name} has a dictionary already, which stays; the exported one of {count} rows is left out"
            ),
            Err(reason) => format!("the exported dictionary is left out: {reason}"),
        };
        report.last_warning(words);
    }
}

/// Whether what was sent is an exported service.
pub(super) fn is_exported(tree: &Path) -> bool {
    Tree::open(tree).is_ok_and(|tree| image::is_layout(&tree))
}

/// Refuses options that an exported service says itself.
fn check_options(asked: &PushOptions) -> Result<(), Error> {
    let left = PushOptions {
        name: None,
        rollout: None,
        source: String::new(),
        ..asked.clone()
    };
    if left != PushOptions::default() {
        return Err(Error::Options(
            "an exported service says itself how it is started and limited; only its name and the terms of its rollout can be given"
                .to_owned(),
        ));
    }
    Ok(())
}

/// Takes an exported service into the store; blocks.
fn take_in(
    store: &image::Store,
    tree: &Path,
    asked: &PushOptions,
    limits: &Options,
) -> Result<Imported, Error> {
    let hold = store.hold()?;
    let layout = Tree::open(tree).map_err(|error| unreadable(&error.to_string()))?;
    let bounds = image::Limits {
        entries: limits.entries,
        bytes: limits.unpacked.0,
        ..image::Limits::default()
    };
    let received = store.receive(&layout, &bounds).map_err(unreceivable)?;
    let record = privilege::reading(|| ServiceRecord::read(&layout, &received.annotations))?;
    let inventory = inventory(store, &received, &record)?;
    let options = record.options(asked)?;
    let nodes = record.plan.nodes.iter().map(launched).collect();
    let built = BuildOutcome {
        package: record.package.clone(),
        version: String::new(),
        flavour: record.flavour.clone(),
        image: received.image.digest,
        layers: layers(&received),
        environment: record.plan.environment.clone(),
        plan: LaunchPlan {
            nodes,
            parameters: record.plan.parameters.clone(),
            components: record.plan.components.clone(),
        },
        inventory,
        hold,
    };
    Ok(Imported {
        record,
        options,
        built,
    })
}

/// What the image holds: looked for here, whatever the record says.
fn inventory(
    store: &image::Store,
    received: &Received,
    record: &ServiceRecord,
) -> Result<Inventory, Error> {
    let layers = received.image.spec.layers.iter();
    let trees: Result<Vec<_>, _> = layers
        .map(|layer| store.extracted(&layer.diff_id))
        .collect();
    let trees = trees.map_err(unreceivable)?;
    let nodes = &record.plan.nodes;
    let commands: Vec<&[String]> = nodes.iter().map(|node| node.argv.as_slice()).collect();
    let of = Published {
        package: &record.package,
        environment: &record.plan.environment,
        commands: &commands,
    };
    privilege::reading(|| Inventory::take(&trees, of)).map_err(|error| {
        refused(
            format!("what the image holds cannot be read: {error}"),
            "export the service again",
        )
    })
}

fn layers(received: &Received) -> Vec<BuiltLayer> {
    const NAMES: [&str; 3] = ["base", "dependencies", "package"];
    let layers = received.image.spec.layers.iter().zip(&received.known);
    let last = received.known.len().saturating_sub(1);
    let named = |at: usize| match at == last {
        true => NAMES[2],
        false => NAMES[at.min(1)],
    };
    let layer = |(at, (info, known)): (usize, (&image::LayerInfo, &bool))| BuiltLayer {
        name: named(at),
        info: *info,
        cached: *known,
    };
    layers.enumerate().map(layer).collect()
}

/// A node that was told its name when the service was pushed.
fn launched(node: &NodeSpec) -> LaunchNode {
    LaunchNode {
        name: node.name.clone(),
        package: String::new(),
        executable: String::new(),
        argv: node.argv.clone(),
        remaps: BTreeMap::new(),
        environment: node.environment.clone(),
        directory: (node.directory != HOME_INSIDE).then(|| node.directory.clone()),
        respawn: node.respawn,
        respawn_delay: node.respawn_delay,
        required: node.required,
        named: true,
    }
}

fn unreceivable(error: image::Error) -> Error {
    match error {
        image::Error::Unreceivable { .. }
        | image::Error::Archive { .. }
        | image::Error::BadDigest { .. } => refused(
            error.to_string(),
            "export the service again, and send the whole file",
        ),
        error => error.into(),
    }
}

fn unreadable(problem: &str) -> Error {
    refused(
        format!("the record of the exported service cannot be read: {problem}"),
        "export the service again",
    )
}

fn refused(message: String, next: &str) -> Error {
    Error::Failed {
        message,
        next: Some(next.to_owned()),
        log: Vec::new(),
    }
}
