//! A snapshot of the other participants with their endpoints and nodes.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use ros_bus::{PeerId, WireFormat, WireType};
use rtps::{DiscoveredGraph, EndpointData, EntityId, Guid, GuidPrefix, ParticipantData};

use super::entities::{GidSize, ParticipantEntities};
use super::{names, type_hash};

/// Key of the enclave in a participant's user data; its value ends with `;`.
const ENCLAVE: &[u8] = b"enclave=";
/// Maximum length of an enclave name in rmw.
const MAX_ENCLAVE: usize = 255;

/// Discovery results, and the nodes that participants have announced.
#[derive(Debug, Clone, Default)]
pub(super) struct DiscoverySnapshot {
    pub(super) discovered: Arc<DiscoveredGraph>,
    /// Node → its participant.
    pub(super) nodes: BTreeMap<Arc<str>, Guid>,
    /// Gid size; that of distributions before Iron if any participant uses it.
    pub(super) gids: GidSize,
    /// Enclave → the nodes of its participants, for all but the root.
    pub(super) enclaves: BTreeMap<String, BTreeSet<Arc<str>>>,
    owners: HashMap<Guid, Arc<str>>,
    /// Endpoints whose node was not announced in time.
    pub(super) late: HashSet<Guid>,
    writers: HashMap<String, Vec<Arc<EndpointData>>>,
    readers: HashMap<String, Vec<Arc<EndpointData>>>,
}

impl DiscoverySnapshot {
    pub(super) fn new(discovered: Arc<DiscoveredGraph>, told: &HashMap<GuidPrefix, Arc<ParticipantEntities>>) -> Self {
        let (mut nodes, mut owners) = (BTreeMap::new(), HashMap::new());
        let mut enclaves: BTreeMap<String, BTreeSet<Arc<str>>> = BTreeMap::new();
        let mut gids = GidSize::Sixteen;
        for (prefix, entities) in told {
            if entities.gids == GidSize::TwentyFour {
                gids = GidSize::TwentyFour;
            }
            let data = discovered.participants.get(prefix);
            let enclave = data.and_then(|data| enclave(&data.user_data));
            if let Some(enclave) = enclave.filter(|name| *name != "/") {
                let names = entities.nodes.iter().map(|node| Arc::clone(&node.name));
                enclaves.entry(enclave.to_owned()).or_default().extend(names);
            }
            for node in &entities.nodes {
                nodes.insert(Arc::clone(&node.name), participant(*prefix));
                // A participant cannot announce the endpoints of others.
                let ends = node.readers.iter().chain(&node.writers);
                for end in ends.filter(|end| end.prefix == *prefix) {
                    owners.insert(*end, Arc::clone(&node.name));
                }
            }
        }
        Self {
            writers: by_topic(&discovered.writers),
            readers: by_topic(&discovered.readers),
            discovered,
            nodes,
            gids,
            enclaves,
            owners,
            late: HashSet::new(),
        }
    }

    /// Returns the writers of a DDS topic, whatever their types.
    pub(super) fn writers(&self, topic: &str) -> &[Arc<EndpointData>] {
        self.writers.get(topic).map(Vec::as_slice).unwrap_or_default()
    }

    /// Returns the readers of a DDS topic, whatever their types.
    pub(super) fn readers(&self, topic: &str) -> &[Arc<EndpointData>] {
        self.readers.get(topic).map(Vec::as_slice).unwrap_or_default()
    }

    /// Returns the node that an endpoint belongs to; `None` if it was not announced.
    pub(super) fn owner(&self, end: Guid) -> Option<&Arc<str>> {
        self.owners.get(&end)
    }

    /// Returns the name of the node that an endpoint belongs to, or the GUID of its participant.
    pub(super) fn node(&self, end: Guid) -> Arc<str> {
        match self.owner(end) {
            Some(node) => Arc::clone(node),
            None => participant(end.prefix).to_string().into(),
        }
    }

    /// Returns the id of an endpoint.
    pub(super) fn peer(&self, end: Guid) -> PeerId {
        PeerId::new(self.node(end), end.number())
    }

    /// Returns true if everything that will be known of an endpoint is known: its node, if its participant belongs to
    /// ROS, which announces its nodes shortly after its endpoints.
    pub(super) fn is_named(&self, end: Guid) -> bool {
        let participant = self.discovered.participants.get(&end.prefix);
        let of_ros = |it: &ParticipantData| behind_enclave(&it.user_data).is_some();
        self.owners.contains_key(&end) || self.late.contains(&end) || participant.is_some_and(|it| !of_ros(it))
    }

    /// Returns the endpoints of topics and services whose node is not known yet.
    pub(super) fn unnamed_endpoints(&self) -> impl Iterator<Item = Guid> + '_ {
        let ends = self.discovered.writers.values();
        let ends = ends.chain(self.discovered.readers.values());
        let of_ros = ends.filter(|end| names::topic_role(&end.topic).is_some());
        of_ros.map(|end| end.guid).filter(|end| !self.is_named(*end))
    }
}

/// Returns the user data behind `enclave=`; `None` if the participant does not belong to ROS.
fn behind_enclave(user_data: &[u8]) -> Option<&[u8]> {
    let mut windows = user_data.windows(ENCLAVE.len());
    let at = windows.position(|at| at == ENCLAVE)?;
    user_data.get(at + ENCLAVE.len()..)
}

/// Returns the enclave of a participant.
fn enclave(user_data: &[u8]) -> Option<&str> {
    let name = behind_enclave(user_data)?.split(|byte| *byte == b';').next()?;
    let name = std::str::from_utf8(name).ok();
    name.filter(|name| name.len() <= MAX_ENCLAVE)
}

/// Returns the GUID of a participant itself.
fn participant(prefix: GuidPrefix) -> Guid {
    Guid::new(prefix, EntityId::PARTICIPANT)
}

fn by_topic(ends: &BTreeMap<Guid, Arc<EndpointData>>) -> HashMap<String, Vec<Arc<EndpointData>>> {
    let mut sorted: HashMap<String, Vec<Arc<EndpointData>>> = HashMap::new();
    for end in ends.values() {
        match sorted.get_mut(&end.topic) {
            Some(list) => list.push(Arc::clone(end)),
            None => drop(sorted.insert(end.topic.clone(), vec![Arc::clone(end)])),
        }
    }
    sorted
}

/// Returns the type of an endpoint's messages.
pub(super) fn wire_type(end: &EndpointData) -> WireType {
    WireType {
        format: WireFormat::Cdr,
        ..WireType::new(names::ros_type(&end.type_name), type_hash::message_hash(&end.user_data), "")
    }
}
