//! Auxiliary parameters that are measured: the size of what a robot sends to nodes.
//!
//! | key | value |
//! |---|---|
//! | `bytes` | size of the largest message or request of all inputs |
//! | `width`, `height` | maximum over all inputs whose types have them: pictures, clouds, grids |
//! | `NAME.bytes`, `NAME.width`, `NAME.height` | the same for one topic or service; `/` in its name is written `.` |
//! | `NAME.typical` | median size of its messages |
//!
//! Each is known after [`MIN_MESSAGES`] messages, or [`PATIENCE`] after the first; those over all inputs, once each
//! input is known. Measured values only grow: a servant is not shrunk between two large pictures.

use std::collections::BTreeMap;
use std::time::Duration;

use api::dictionary::Row;
use api::sla::check_aux;
use ros::sizes::SizeSummary;

use super::dictionary::Aux;

/// Number of messages of an input after which its sizes are known.
pub const MIN_MESSAGES: u64 = 8;
/// Time after the first message at which the sizes of an input that sends fewer, such as a map, are known.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// Measurements of one input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MeasuredInput {
    /// Name of the topic or service.
    pub name: String,
    /// Sizes of its messages.
    pub seen: SizeSummary,
    /// Time since the first message.
    pub known: Duration,
}

/// Returns the resulting parameters, as far as rows name them.
pub fn aux_from_inputs(inputs: &[MeasuredInput], rows: &[Row]) -> Aux {
    let mut all = BTreeMap::new();
    let used: Vec<&MeasuredInput> = inputs.iter().filter(|input| input.seen.count > 0).collect();
    let settled = |input: &MeasuredInput| input.seen.count >= MIN_MESSAGES || input.known >= PATIENCE;
    let whole = used.iter().all(|input| settled(input));
    for input in used {
        if !settled(input) {
            continue;
        }
        let seen = &input.seen;
        let name = input.name.trim_matches('/').replace('/', ".");
        let sides = [("bytes", Some(seen.largest)), ("width", seen.width), ("height", seen.height)];
        for (key, value) in sides {
            let Some(value) = value else { continue };
            all.insert(format!("{name}.{key}"), value);
            if whole {
                let most = all.entry(key.to_owned()).or_default();
                *most = value.max(*most);
            }
        }
        all.insert(format!("{name}.typical"), seen.typical);
    }
    let named = |key: &str| rows.iter().any(|row| row.aux.contains_key(key));
    all.into_iter()
        .map(|(key, value)| (key, value.to_string()))
        .filter(|(key, value)| named(key) && check_aux(key, value).is_ok())
        .collect()
}

/// Merges the parameters measured `before` and `now`: the larger value of each.
pub fn merge_max(before: &Aux, now: Aux) -> Aux {
    let mut all = before.clone();
    for (key, value) in now {
        let number = |text: &String| text.parse::<u64>().ok();
        let greater = all.get(&key).is_none_or(|had| number(&value) > number(had));
        if greater {
            all.insert(key, value);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn row(aux: &[&str]) -> Row {
        let mut row: Row = serde_json::from_value(serde_json::json!({
            "id": 1, "measure": "rrt", "value": 0.1, "limits": {},
        }))
        .expect("a row");
        row.aux = aux.iter().map(|key| ((*key).to_owned(), "1".to_owned())).collect();
        row
    }

    fn input(name: &str, count: u64, largest: u64, width: Option<u64>) -> MeasuredInput {
        MeasuredInput {
            name: name.to_owned(),
            seen: SizeSummary { count, largest, typical: largest / 2, width, height: width.map(|width| width / 2) },
            known: Duration::ZERO,
        }
    }

    fn aux_of(pairs: &[(&str, &str)]) -> Aux {
        let pairs = pairs.iter();
        pairs.map(|(key, value)| ((*key).to_owned(), (*value).to_owned())).collect()
    }

    #[test]
    fn what_rows_name_is_told_once_it_is_known() {
        let camera = input("/camera/image", 8, 1000, Some(640));
        let few = input("/map", 7, 5000, Some(900));
        let map = MeasuredInput { known: PATIENCE, ..few.clone() };
        let silent = input("/other", 0, 0, None);
        let text = input("/text", 9, 10, None);
        let keys = ["width", "bytes", "camera.image.typical", "text.width"];
        for (inputs, told) in [
            (vec![], aux_of(&[])),
            (vec![silent.clone()], aux_of(&[])),
            (
                vec![camera.clone(), silent],
                aux_of(&[("bytes", "1000"), ("camera.image.typical", "500"), ("width", "640")]),
            ),
            // The size of the map is not known yet.
            (vec![camera.clone(), few], aux_of(&[("camera.image.typical", "500")])),
            (
                vec![camera.clone(), map, text],
                aux_of(&[("bytes", "5000"), ("camera.image.typical", "500"), ("width", "900")]),
            ),
        ] {
            assert_eq!(aux_from_inputs(&inputs, &[row(&keys)]), told, "{inputs:?}");
        }
        assert_eq!(aux_from_inputs(std::slice::from_ref(&camera), &[]), aux_of(&[]));
        // A name that no row can have.
        let odd = input("/a b", 8, 1, None);
        assert_eq!(aux_from_inputs(&[odd], &[row(&["a b.bytes"])]), aux_of(&[]));
    }

    #[test]
    fn what_was_measured_stays_until_it_is_more() {
        let before = aux_of(&[("bytes", "1000"), ("width", "640")]);
        let now = aux_of(&[("bytes", "999"), ("height", "7"), ("width", "1280")]);
        let after = aux_of(&[("bytes", "1000"), ("height", "7"), ("width", "1280")]);
        assert_eq!(merge_max(&before, now), after);
    }

    proptest! {
        #[test]
        fn it_only_grows_and_one_input_never_exceeds_all(
            looks in prop::collection::vec(
                prop::collection::vec((0u64..20, 1u64..1_000_000, prop::option::of(1u64..5000)), 3), 1..8),
        ) {
            let names = ["/a", "/b/c", "/d"];
            let rows = [row(&["bytes", "width", "a.bytes", "b.c.width", "d.typical"])];
            let mut known = Aux::new();
            for look in looks {
                let inputs: Vec<MeasuredInput> = names.iter().zip(look)
                    .map(|(name, (count, largest, width))| input(name, count, largest, width))
                    .collect();
                let now = aux_from_inputs(&inputs, &rows);
                let number = |aux: &Aux, key: &str| aux.get(key).map(|text| text.parse::<u64>().expect("a number"));
                if let (Some(all), Some(one)) = (number(&now, "bytes"), number(&now, "a.bytes")) {
                    prop_assert!(one <= all);
                }
                let after = merge_max(&known, now.clone());
                for key in rows[0].aux.keys() {
                    prop_assert!(number(&after, key) >= number(&known, key));
                    prop_assert!(number(&after, key) >= number(&now, key));
                }
                known = after;
            }
        }
    }
}
