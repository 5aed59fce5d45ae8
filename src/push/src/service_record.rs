//! Transfer of a revision from one server to another: its image as an OCI image layout, together with this record of
//! what OCI images cannot express. `GET /api/v1/services/NAME/record` returns it, `cloudroidctl export` adds it to the
//! archive as a blob named by the image's annotation [`RECORD`], and a push of the archive reads it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use api::PushOptions;
use api::dictionary::{NewRows, Row};
use foreign::Tree;
use image::ReceivedImage;
use package::interface::Interface;
use package::inventory::{Inventory, SearchHints};
use package::names::{is_graph_name, is_package};
use package::requests::Reason;
use rootfs_builder::{BuildOutcome, BuiltLayer, LaunchNode, LaunchPlan, blocking, find_components_problem};
use ros::flavour::{Flavour, Version};
use ros::ros2::middleware::{self, UnsupportedMiddleware};
use serde::{Deserialize, Serialize};
use servant::spec::NodeSpec;
use store::{Plan, RevisionRecord};

use super::building::PushedImage;
use super::pusher::HOME_INSIDE;
use super::reporter::Reporter;
use super::{Error, Options, OptionsError, Pusher};

/// Annotation of the image's index entry with the digest of the record.
pub const RECORD: &str = "org.cloudroid.record";
/// Format version of the record.
const FORMAT: u32 = 1;
/// Maximum length of the description of what was pushed, in characters; each export and import extends it.
const LONGEST_SOURCE: usize = 200;
/// Maximum size of a record in bytes; decoded it takes many times as much memory.
const LARGEST_RECORD: usize = 4 << 20;
/// Maximum number of nodes of a service.
const MOST_NODES: usize = 256;

/// Properties of a revision that are not part of its image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServiceRecord {
    /// Format version of the record; 1.
    pub format: u32,
    /// Name of the service.
    pub service: String,
    /// ROS package.
    pub package: String,
    /// Human-readable description of what was pushed.
    pub source: String,
    /// ROS flavour that the image is built for.
    pub flavour: Flavour,
    /// Launch plan of its servants.
    pub plan: Plan,
    /// Interface, with message definitions.
    pub interface: Interface,
    /// Dictionary rows, as measured on the exporting server.
    pub dictionary: Vec<Row>,
}

impl ServiceRecord {
    /// Creates the record of a revision with the dictionary rows of its service.
    pub fn from_revision(revision: &RevisionRecord, rows: Vec<Row>) -> Self {
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

    /// Reads the record named by the annotations of an image's index entry.
    fn read(layout: &Tree, annotations: &BTreeMap<String, String>) -> Result<Self, Error> {
        let Some(digest) = annotations.get(RECORD) else {
            return Err(refusal(
                "the image is not an exported service: it does not state how its nodes are started".to_owned(),
                "push the package itself, or a file of cloudroidctl export",
            ));
        };
        let bytes =
            digest.parse().and_then(|digest| image::read_layout_document(layout, &digest)).map_err(receive_error)?;
        if bytes.len() > LARGEST_RECORD {
            return Err(unreadable_record(&format!("it has {} bytes; the limit is {LARGEST_RECORD}", bytes.len())));
        }
        let record: Self = serde_json::from_slice(&bytes).map_err(|error| unreadable_record(&error.to_string()))?;
        if record.format != FORMAT {
            return Err(refusal(
                format!("the record of the exported service has format {}; supported is {FORMAT}", record.format),
                "export it with this server's version of cloudroidctl",
            ));
        }
        record.check().map_err(|error| unreadable_record(&error.to_string()))?;
        Ok(record)
    }

    /// Checks what a regular push would have ensured.
    fn check(&self) -> Result<(), RecordError> {
        if !is_package(&self.package) {
            return Err(RecordError::Package(self.package.clone()));
        }
        let word = |text: &str| {
            let is_of_it = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
            !text.is_empty() && text.len() < 100 && text.chars().all(is_of_it)
        };
        if !word(&self.flavour.base) || !word(&self.flavour.distribution) {
            return Err(RecordError::Flavour);
        }
        if self.plan.nodes.is_empty() {
            return Err(RecordError::NoNodes);
        }
        if self.plan.nodes.len() > MOST_NODES {
            return Err(RecordError::TooManyNodes(self.plan.nodes.len()));
        }
        check_environment(&self.plan.environment)?;
        for node in &self.plan.nodes {
            check_node(node)?;
        }
        if self.flavour.ros == Version::Ros2 {
            middleware::check_environment(&self.plan.environment)?;
            for node in &self.plan.nodes {
                middleware::check_process(&node.environment, &node.argv)?;
            }
        }
        let is_node = |name: &String| self.plan.nodes.iter().any(|node| node.name == *name);
        if let Some(problem) = find_components_problem(&self.plan.components, &is_node) {
            return Err(RecordError::Components(problem));
        }
        if let Some(name) = self.plan.parameters.keys().find(|name| !is_graph_name(name)) {
            return Err(RecordError::Parameter(name.clone()));
        }
        Ok(())
    }

    /// Returns the equivalent push options; `asked` may give the name, source and rollout.
    fn push_options(&self, asked: &PushOptions) -> Result<PushOptions, Error> {
        let plan = &self.plan;
        let interface = serde_json::to_string(&self.interface);
        let interface = interface.map_err(|error| unreadable_record(&error.to_string()))?;
        let printable = self.source.chars().filter(|c| !c.is_control());
        let before: String = printable.take(LONGEST_SOURCE).collect();
        let source = if asked.source.is_empty() { before } else { format!("{}, exported from {before}", asked.source) };
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

    /// Returns the rows to write if the service has no dictionary yet.
    pub(super) fn new_rows(&self) -> NewRows {
        NewRows { rows: self.dictionary.clone(), replace: false }
    }
}

/// Reason why the record of an exported service cannot be used.
#[derive(Debug, thiserror::Error)]
enum RecordError {
    #[error("{0:?} is not a valid package name")]
    Package(String),
    #[error("its base or distribution is not a valid name")]
    Flavour,
    #[error("it starts no nodes")]
    NoNodes,
    #[error("it starts {0} nodes; the limit is {MOST_NODES}")]
    TooManyNodes(usize),
    #[error("{0:?} is not a valid node name")]
    NodeName(String),
    #[error("node {0} has no valid program")]
    Program(String),
    #[error("node {0} has an invalid respawn delay")]
    RespawnDelay(String),
    #[error("{0}")]
    Components(String),
    #[error("{0:?} is not a valid parameter name")]
    Parameter(String),
    #[error("{0:?} is not a valid environment variable")]
    Environment(String),
    #[error("robots would not reach its nodes: {0}; push the package for rmw_fastrtps_cpp or rmw_cyclonedds_cpp")]
    Middleware(#[from] UnsupportedMiddleware),
}

fn check_node(node: &NodeSpec) -> Result<(), RecordError> {
    if !is_graph_name(&node.name) {
        return Err(RecordError::NodeName(node.name.clone()));
    }
    let argv = &node.argv;
    let is_program = argv.first().is_some_and(|program| program.starts_with('/'));
    if !is_program || argv.iter().any(|word| word.contains('\0')) {
        return Err(RecordError::Program(node.name.clone()));
    }
    if !(0.0..=1e6).contains(&node.respawn_delay) {
        return Err(RecordError::RespawnDelay(node.name.clone()));
    }
    check_environment(&node.environment)
}

fn check_environment(variables: &BTreeMap<String, String>) -> Result<(), RecordError> {
    let is_good =
        |(name, value): &(&String, &String)| !name.is_empty() && !name.contains(['=', '\0']) && !value.contains('\0');
    match variables.iter().find(|variable| !is_good(variable)) {
        Some((name, _)) => Err(RecordError::Environment(name.clone())),
        None => Ok(()),
    }
}

/// An exported service whose image has been imported into the store.
pub(super) struct ImportedService {
    pub(super) record: ServiceRecord,
    pub(super) options: PushOptions,
    pub(super) built: BuildOutcome,
}

impl Pusher {
    /// Imports an exported service from the unpacked archive.
    pub(super) async fn import(
        &self,
        options: &PushOptions,
        tree: PathBuf,
        report: &Reporter,
    ) -> Result<PushedImage, Error> {
        check_options(options)?;
        report.step("importing the exported service").await;
        let store = Arc::clone(self.catalogue.images());
        let (asked, limits) = (options.clone(), self.options.clone());
        let work = blocking::cancel_with_caller(move || import_image(&store, &tree, &asked, &limits));
        let imported =
            privilege::spawn_blocking(work).await.map_err(|_| Error::Internal("importing an exported service"))??;
        Ok(PushedImage::Imported(Box::new(imported)))
    }

    /// Writes the dictionary rows of an exported service if the service has none; rows measured here are better.
    /// Failures are only warnings.
    pub(super) fn import_dictionary(&self, name: &str, record: &ServiceRecord, report: &Reporter) {
        let rows = record.new_rows();
        if rows.rows.is_empty() {
            return;
        }
        let outcome = match rows.rows.iter().try_for_each(choreographer::check_row) {
            _ if rows.rows.len() > choreographer::MOST_ROWS => Err("it has too many entries".to_owned()),
            Err(error) => Err(error.to_string()),
            Ok(()) => (self.catalogue.initialize_dictionary(name, &rows)).map_err(|error| error.to_string()),
        };
        let count = rows.rows.len();
        let words = match outcome {
            Ok(true) => format!(
                "its SLA table has {count} entries that were measured on another machine; measure again here with: \
                    cloudroidctl calibrate {name}"
            ),
            Ok(false) => format!("{name} keeps its existing SLA table; the {count} exported entries were not imported"),
            Err(reason) => format!("the exported SLA table was not imported: {reason}"),
        };
        report.try_warning(words);
    }
}

/// Returns whether an unpacked archive is an exported service.
pub(super) fn is_exported(tree: &Path) -> bool {
    Tree::open(tree).is_ok_and(|tree| image::is_layout(&tree))
}

/// Rejects options that are determined by the exported service.
fn check_options(asked: &PushOptions) -> Result<(), Error> {
    let left = PushOptions { name: None, rollout: None, source: String::new(), ..asked.clone() };
    if left != PushOptions::default() {
        return Err(OptionsError::Exported.into());
    }
    Ok(())
}

/// Imports an exported service into the store. Blocking.
fn import_image(
    store: &image::Store,
    tree: &Path,
    asked: &PushOptions,
    limits: &Options,
) -> Result<ImportedService, Error> {
    let hold = store.hold()?;
    let layout = Tree::open(tree).map_err(|error| unreadable_record(&error.to_string()))?;
    let bounds = image::Limits { entries: limits.entries, bytes: limits.unpacked.0, ..image::Limits::default() };
    let received = store.receive(&layout, &bounds).map_err(receive_error)?;
    let record = privilege::run_as_reader(|| ServiceRecord::read(&layout, &received.annotations))?;
    let inventory = take_inventory(store, &received, &record)?;
    let options = record.push_options(asked)?;
    let nodes = record.plan.nodes.iter().map(launch_node).collect();
    let built = BuildOutcome {
        package: record.package.clone(),
        version: String::new(),
        flavour: record.flavour.clone(),
        image: received.image.digest,
        layers: built_layers(&received),
        environment: record.plan.environment.clone(),
        plan: LaunchPlan {
            nodes,
            parameters: record.plan.parameters.clone(),
            components: record.plan.components.clone(),
        },
        inventory,
        hold,
    };
    Ok(ImportedService { record, options, built })
}

/// Takes the inventory of the image, regardless of the record.
fn take_inventory(store: &image::Store, received: &ReceivedImage, record: &ServiceRecord) -> Result<Inventory, Error> {
    let layers = received.image.spec.layers.iter();
    let trees: Result<Vec<_>, _> = layers.map(|layer| store.ensure_extracted(&layer.diff_id)).collect();
    let trees = trees.map_err(receive_error)?;
    let nodes = &record.plan.nodes;
    let commands: Vec<&[String]> = nodes.iter().map(|node| node.argv.as_slice()).collect();
    let of = SearchHints { package: &record.package, environment: &record.plan.environment, commands: &commands };
    privilege::run_as_reader(|| Inventory::scan(&trees, of))
        .map_err(|error| refusal(format!("cannot read the image's contents: {error}"), "export the service again"))
}

fn built_layers(received: &ReceivedImage) -> Vec<BuiltLayer> {
    const NAMES: [&str; 3] = ["base", "dependencies", "package"];
    let layers = received.image.spec.layers.iter().zip(&received.known);
    let last = received.known.len().saturating_sub(1);
    let named = |at: usize| {
        if at == last { NAMES[2] } else { NAMES[at.min(1)] }
    };
    let layer = |(at, (info, known)): (usize, (&image::LayerInfo, &bool))| BuiltLayer {
        name: named(at),
        info: *info,
        cached: *known,
    };
    layers.enumerate().map(layer).collect()
}

/// Converts a node that was given its name when the service was pushed.
fn launch_node(node: &NodeSpec) -> LaunchNode {
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

fn receive_error(error: image::Error) -> Error {
    match error {
        image::Error::Unreceivable { .. } | image::Error::Archive { .. } | image::Error::BadDigest { .. } => {
            refusal(error.to_string(), "export the service again, and send the whole file")
        }
        error => error.into(),
    }
}

fn unreadable_record(problem: &str) -> Error {
    refusal(format!("cannot read the record of the exported service: {problem}"), "export the service again")
}

fn refusal(message: String, next: &str) -> Error {
    Error::Failed { message, next: Some(next.to_owned()), log: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nodes_that_robots_would_not_reach_are_refused() {
        let node = |value: &str| NodeSpec {
            name: "/talker".to_owned(),
            argv: vec!["/opt/talker".to_owned()],
            environment: [(middleware::VARIABLE.to_owned(), value.to_owned())].into(),
            directory: HOME_INSIDE.to_owned(),
            respawn: false,
            respawn_delay: 0.0,
            required: false,
        };
        let record = |ros: Version, value: &str| ServiceRecord {
            format: FORMAT,
            service: "talk".to_owned(),
            package: "talk".to_owned(),
            source: String::new(),
            flavour: Flavour { base: "lab".to_owned(), ros, distribution: "kilted".to_owned() },
            plan: Plan { nodes: vec![node(value)], ..Plan::default() },
            interface: Interface::default(),
            dictionary: Vec::new(),
        };
        record(Version::Ros2, "rmw_fastrtps_cpp").check().expect("DDS");
        record(Version::Ros1, "rmw_zenoh_cpp").check().expect("ROS 1 has no middlewares");
        let refused = record(Version::Ros2, "rmw_zenoh_cpp").check().expect_err("it is not DDS").to_string();
        assert!(refused.contains("rmw_zenoh_cpp speaks Zenoh") && refused.contains("push the package"), "{refused}");
    }
}
