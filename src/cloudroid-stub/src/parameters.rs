//! The robot's parameters, all at once. A Master answers for all or for none: one value that XML-RPC cannot carry (an
//! integer of more than 32 bits, nothing at all) spoils the whole answer. Then they are asked for one by one.

use std::collections::{BTreeMap, BTreeSet};

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, ParamValue};

/// Those of a Master itself.
pub const OWN: [&str; 4] = ["run_id", "rosdistro", "rosversion", "roslaunch"];

/// Named once for each life of the stub.
static TOLD: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// All parameters as a tree, without the Master's own. Those that cannot be read are left out, and named in the log.
pub async fn all(bus: &dyn Bus) -> Result<BTreeMap<String, ParamValue>, BusError> {
    let mut all = match bus.get_param("/").await {
        Ok(ParamValue::Map(all)) => all,
        Ok(_) => BTreeMap::new(),
        Err(error) if is_of_values(&error) => one_by_one(bus).await?,
        Err(error) => return Err(error),
    };
    all.retain(|name, _| !OWN.contains(&name.as_str()));
    Ok(all)
}

/// The Master was reached, and what it said cannot be used.
fn is_of_values(error: &BusError) -> bool {
    matches!(
        error,
        BusError::Master { .. } | BusError::Protocol { .. } | BusError::NoParam(_)
    )
}

async fn one_by_one(bus: &dyn Bus) -> Result<BTreeMap<String, ParamValue>, BusError> {
    let mut all = BTreeMap::new();
    for name in bus.param_names().await? {
        match bus.get_param(&name).await {
            Ok(value) => insert(&mut all, name.trim_start_matches('/'), value),
            // Deleted meanwhile.
            Err(BusError::NoParam(_)) => {}
            Err(error) if is_of_values(&error) => {
                if TOLD.lock().insert(name.clone()) {
                    tracing::warn!(
                        "parameter {name} has a value that XML-RPC cannot carry ({error}): the node in the cloud does not get it; set it otherwise, or remove it with: rosparam delete {name}"
                    );
                }
            }
            Err(error) => return Err(error),
        }
    }
    Ok(all)
}

fn insert(tree: &mut BTreeMap<String, ParamValue>, path: &str, value: ParamValue) {
    let Some((first, rest)) = path.split_once('/') else {
        tree.insert(path.to_owned(), value);
        return;
    };
    let below = tree
        .entry(first.to_owned())
        .or_insert_with(|| ParamValue::Map(BTreeMap::new()));
    if let ParamValue::Map(below) = below {
        insert(below, rest, value);
    }
}
