//! The robot's parameters, all at once. A Master answers for all or for none: one value that XML-RPC cannot carry (an
//! integer of more than 32 bits, nothing at all) spoils the whole answer. Then they are asked for one by one.

use std::collections::{BTreeMap, BTreeSet};

use parking_lot::Mutex;
use ros::bus::{Bus, BusError, ParamValue};
use ros::ros1::own_parameters::is_of_master;

/// Named once for each life of the stub.
static TOLD: Mutex<BTreeSet<String>> = Mutex::new(BTreeSet::new());

/// All parameters as a tree, without the Master's own. Those that cannot be read are left out, and named in the log.
pub async fn all(bus: &dyn Bus) -> Result<BTreeMap<String, ParamValue>, BusError> {
    let mut all = match bus.parameter("/").await {
        Ok(ParamValue::Map(all)) => all,
        Ok(_) => BTreeMap::new(),
        Err(error) if is_of_values(&error) => one_by_one(bus).await?,
        Err(error) => return Err(error),
    };
    all.retain(|name, _| !is_of_master(name));
    without_nothing(&mut all, "");
    Ok(all)
}

/// Takes what is no value out of a tree, and names it.
fn without_nothing(tree: &mut BTreeMap<String, ParamValue>, above: &str) {
    tree.retain(|name, value| {
        let name = format!("{above}/{name}");
        if is_nothing(value) {
            report(&name, &"it is nothing");
            return false;
        }
        if let ParamValue::Map(below) = value {
            without_nothing(below, &name);
        }
        true
    });
}

fn is_nothing(value: &ParamValue) -> bool {
    match value {
        ParamValue::Nil => true,
        ParamValue::List(items) => items.iter().any(is_nothing),
        _ => false,
    }
}

/// Whether a parameter that has changed can be carried; names it if not.
pub fn can_be_carried(name: &str, value: &mut Option<ParamValue>) -> bool {
    match value {
        Some(ParamValue::Map(below)) => without_nothing(below, name),
        Some(value) if is_nothing(value) => {
            report(name, &"it is nothing");
            return false;
        }
        _ => {}
    }
    true
}

fn report(name: &str, reason: &dyn std::fmt::Display) {
    if TOLD.lock().insert(name.to_owned()) {
        tracing::warn!(
            "parameter {name} has a value that XML-RPC cannot carry ({reason}): the node in the cloud does not get it; set it otherwise, or remove it with: rosparam delete {name}"
        );
    }
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
    for name in bus.parameters()?.names().await? {
        match bus.parameter(&name).await {
            Ok(value) => insert(&mut all, name.trim_start_matches('/'), value),
            // Deleted meanwhile.
            Err(BusError::NoParam(_)) => {}
            Err(error) if is_of_values(&error) => {
                report(&name, &error);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_value_is_left_out_and_the_rest_stays() {
        let map = |members: &[(&str, ParamValue)]| {
            let members = members.iter().cloned();
            ParamValue::Map(
                members
                    .map(|(name, value)| (name.to_owned(), value))
                    .collect(),
            )
        };
        let list = |items: &[ParamValue]| ParamValue::List(items.to_vec());
        let (one, bytes) = (ParamValue::Int(1), ParamValue::Binary(vec![0]));
        let mut value = Some(map(&[
            ("one", one.clone()),
            ("nothing", ParamValue::Nil),
            ("holes", list(&[one.clone(), ParamValue::Nil])),
            (
                "below",
                map(&[("nothing", ParamValue::Nil), ("bytes", bytes.clone())]),
            ),
        ]));
        assert!(can_be_carried("/n", &mut value));
        let rest = map(&[("one", one), ("below", map(&[("bytes", bytes)]))]);
        assert_eq!(value, Some(rest));
        assert!(!can_be_carried("/n", &mut Some(ParamValue::Nil)));
        assert!(can_be_carried("/n", &mut None), "deleted");
        for name in ["/n/nothing", "/n/holes", "/n/below/nothing", "/n"] {
            assert!(TOLD.lock().contains(name), "{name}");
        }
    }
}
