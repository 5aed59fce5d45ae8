//! Reads all parameters of the robot at once. A Master answers for all or for none: one value that XML-RPC cannot carry
//! (an integer of more than 32 bits, nil) makes the whole request fail. In this case they are read one by one.

use std::collections::{BTreeMap, BTreeSet};

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, ParamValue};
use ros::ros1::own_parameters::is_set_by_master;

/// Parameters already reported; each is reported once per run of the stub.
static REPORTED_PARAMETERS: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// Returns all parameters as a tree, without the Master's own. Unreadable ones are omitted and reported in the log.
pub async fn read_all(bus: &dyn Bus) -> Result<BTreeMap<String, ParamValue>, BusError> {
    let mut all = match bus.parameter("/").await {
        Ok(ParamValue::Map(all)) => all,
        Ok(_) => BTreeMap::new(),
        Err(error) if is_value_error(&error) => read_one_by_one(bus).await?,
        Err(error) => return Err(error),
    };
    all.retain(|name, _| !is_set_by_master(name));
    remove_nil(&mut all, "");
    Ok(all)
}

/// Removes nil values from a tree and reports them.
fn remove_nil(tree: &mut BTreeMap<String, ParamValue>, above: &str) {
    tree.retain(|name, value| {
        let name = format!("{above}/{name}");
        if contains_nil(value) {
            warn_once(&name, &"it is null");
            return false;
        }
        if let ParamValue::Map(below) = value {
            remove_nil(below, &name);
        }
        true
    });
}

fn contains_nil(value: &ParamValue) -> bool {
    match value {
        ParamValue::Nil => true,
        ParamValue::List(items) => items.iter().any(contains_nil),
        _ => false,
    }
}

/// Returns whether a changed parameter can be transferred; reports it if not.
pub fn make_transferable(name: &str, value: &mut Option<ParamValue>) -> bool {
    match value {
        Some(ParamValue::Map(below)) => remove_nil(below, name),
        Some(value) if contains_nil(value) => {
            warn_once(name, &"it is null");
            return false;
        }
        _ => {}
    }
    true
}

fn warn_once(name: &str, reason: &dyn std::fmt::Display) {
    if REPORTED_PARAMETERS.lock().insert(name.to_owned()) {
        tracing::warn!(
            "parameter {name} has a value that XML-RPC cannot represent ({reason}), so the node in the cloud does not \
                get it; correct it, or remove it with: rosparam delete {name}"
        );
    }
}

/// Returns whether the Master was reached but its answer cannot be used.
fn is_value_error(error: &BusError) -> bool {
    matches!(error, BusError::Master { .. } | BusError::Protocol { .. } | BusError::NoParam(_))
}

async fn read_one_by_one(bus: &dyn Bus) -> Result<BTreeMap<String, ParamValue>, BusError> {
    let mut all = BTreeMap::new();
    for name in bus.parameters()?.names().await? {
        match bus.parameter(&name).await {
            Ok(value) => insert(&mut all, name.trim_start_matches('/'), value),
            // Deleted in the meantime.
            Err(BusError::NoParam(_)) => {}
            Err(error) if is_value_error(&error) => {
                warn_once(&name, &error);
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
    let below = tree.entry(first.to_owned()).or_insert_with(|| ParamValue::Map(BTreeMap::new()));
    if let ParamValue::Map(below) = below {
        insert(below, rest, value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_value_is_left_out_and_the_rest_stays() {
        let map = |members: &[(&str, ParamValue)]| {
            let members = members.iter().cloned();
            ParamValue::Map(members.map(|(name, value)| (name.to_owned(), value)).collect())
        };
        let list = |items: &[ParamValue]| ParamValue::List(items.to_vec());
        let (one, bytes) = (ParamValue::Int(1), ParamValue::Binary(vec![0]));
        let mut value = Some(map(&[
            ("one", one.clone()),
            ("nothing", ParamValue::Nil),
            ("holes", list(&[one.clone(), ParamValue::Nil])),
            ("below", map(&[("nothing", ParamValue::Nil), ("bytes", bytes.clone())])),
        ]));
        assert!(make_transferable("/n", &mut value));
        let rest = map(&[("one", one), ("below", map(&[("bytes", bytes)]))]);
        assert_eq!(value, Some(rest));
        assert!(!make_transferable("/n", &mut Some(ParamValue::Nil)));
        assert!(make_transferable("/n", &mut None), "deleted");
        for name in ["/n/nothing", "/n/holes", "/n/below/nothing", "/n"] {
            assert!(REPORTED_PARAMETERS.lock().contains(name), "{name}");
        }
    }
}
