//! Who is there beside us, with which ends and which nodes, seen at one moment.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::sync::Arc;

use rtps::{Discovered, EndpointData, EntityId, Guid, GuidPrefix, ParticipantData};

use super::entities::{Entities, GidSize};
use super::{names, type_hash};
use crate::bus::{PeerId, WireFormat, WireType};

/// Before the name of its enclave in a participant's user data, which `;` ends.
const ENCLAVE: &[u8] = b"enclave=";
/// The longest name of an enclave that rmw allows.
const MAX_ENCLAVE: usize = 255;

/// What was discovered, and what participants told of their nodes.
#[derive(Debug, Clone, Default)]
pub(super) struct Seen {
    pub(super) discovered: Arc<Discovered>,
    /// Node → its participant.
    pub(super) nodes: BTreeMap<Arc<str>, Guid>,
    /// Whether some participant writes gids as distributions before Iron do.
    pub(super) gids: GidSize,
    /// Enclave → the nodes of its participants, for all but the root.
    pub(super) enclaves: BTreeMap<String, BTreeSet<Arc<str>>>,
    owners: HashMap<Guid, Arc<str>>,
    /// Ends of whose node nothing was told in time.
    pub(super) late: HashSet<Guid>,
    writers: HashMap<String, Vec<Arc<EndpointData>>>,
    readers: HashMap<String, Vec<Arc<EndpointData>>>,
}

impl Seen {
    pub(super) fn new(
        discovered: Arc<Discovered>,
        told: &HashMap<GuidPrefix, Arc<Entities>>,
    ) -> Self {
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
                enclaves
                    .entry(enclave.to_owned())
                    .or_default()
                    .extend(names);
            }
            for node in &entities.nodes {
                nodes.insert(Arc::clone(&node.name), participant(*prefix));
                // Nobody can tell of the ends of others.
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

    /// The writers of a topic of DDS, whatever their types.
    pub(super) fn writers(&self, topic: &str) -> &[Arc<EndpointData>] {
        self.writers
            .get(topic)
            .map(Vec::as_slice)
            .unwrap_or_default()
    }

    /// The readers of a topic of DDS, whatever their types.
    pub(super) fn readers(&self, topic: &str) -> &[Arc<EndpointData>] {
        self.readers
            .get(topic)
            .map(Vec::as_slice)
            .unwrap_or_default()
    }

    /// The node that an end belongs to; none where nobody has said.
    pub(super) fn owner(&self, end: Guid) -> Option<&Arc<str>> {
        self.owners.get(&end)
    }

    /// The name of the node that an end belongs to, or the GUID of its participant.
    pub(super) fn node(&self, end: Guid) -> Arc<str> {
        match self.owner(end) {
            Some(node) => Arc::clone(node),
            None => participant(end.prefix).to_string().into(),
        }
    }

    /// How an end is told from others.
    pub(super) fn peer(&self, end: Guid) -> PeerId {
        PeerId::new(self.node(end), end.number())
    }

    /// Whether all is known of an end that is to be known: its node, where its participant is one of ROS, which tells of its nodes
    /// a moment after it has told of the end.
    pub(super) fn is_named(&self, end: Guid) -> bool {
        let participant = self.discovered.participants.get(&end.prefix);
        let of_ros = |it: &ParticipantData| behind_enclave(&it.user_data).is_some();
        self.owners.contains_key(&end)
            || self.late.contains(&end)
            || participant.is_some_and(|it| !of_ros(it))
    }

    /// Ends of topics and services that are not named.
    pub(super) fn unnamed(&self) -> impl Iterator<Item = Guid> + '_ {
        let ends = self.discovered.writers.values();
        let ends = ends.chain(self.discovered.readers.values());
        let of_ros = ends.filter(|end| names::named(&end.topic).is_some());
        of_ros
            .map(|end| end.guid)
            .filter(|end| !self.is_named(*end))
    }
}

/// What stands behind `enclave=` in a participant's user data; none where it is none of ROS.
fn behind_enclave(user_data: &[u8]) -> Option<&[u8]> {
    let mut windows = user_data.windows(ENCLAVE.len());
    let at = windows.position(|at| at == ENCLAVE)?;
    user_data.get(at + ENCLAVE.len()..)
}

/// The enclave that a participant is in.
fn enclave(user_data: &[u8]) -> Option<&str> {
    let name = behind_enclave(user_data)?
        .split(|byte| *byte == b';')
        .next()?;
    let name = std::str::from_utf8(name).ok();
    name.filter(|name| name.len() <= MAX_ENCLAVE)
}

/// The GUID of a participant itself.
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

/// What an end's messages are.
pub(super) fn wire_type(end: &EndpointData) -> WireType {
    WireType {
        format: WireFormat::Cdr,
        ..WireType::new(
            names::type_of(&end.type_name),
            type_hash::of_message(&end.user_data),
            "",
        )
    }
}
