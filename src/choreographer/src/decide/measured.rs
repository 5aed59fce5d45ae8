//! Auxiliary parameters that are measured: how large what a robot sends to nodes is.
//!
//! | key | is |
//! |---|---|
//! | `bytes` | the largest message or request of all inputs |
//! | `width`, `height` | the greatest of all inputs whose types say them: pictures, clouds, grids |
//! | `NAME.bytes`, `NAME.width`, `NAME.height` | the same of one topic or service; `/` within its name is written `.` |
//! | `NAME.typical` | what half of its messages do not exceed |
//!
//! Each is known once [`ENOUGH`] messages have passed, or [`PATIENCE`] after the first; of all inputs, once each of them is. What
//! was measured only grows: a servant is not made small between two large pictures.

use std::collections::BTreeMap;
use std::time::Duration;

use api::dictionary::Row;
use api::sla::check_aux;
use ros::sizes::Seen;

use super::dictionary::Aux;

/// So many messages of an input tell how large the others are.
pub const ENOUGH: u64 = 8;
/// After the first message of an input that sends fewer, such as a map.
pub const PATIENCE: Duration = Duration::from_secs(5);

/// What was seen of one input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Input {
    /// Topic or service.
    pub name: String,
    /// Its messages.
    pub seen: Seen,
    /// Since the first of them.
    pub known: Duration,
}

/// The parameters that follow, of those that rows name.
pub fn measured(inputs: &[Input], rows: &[Row]) -> Aux {
    let mut all = BTreeMap::new();
    let used: Vec<&Input> = inputs.iter().filter(|input| input.seen.count > 0).collect();
    let settled = |input: &Input| input.seen.count >= ENOUGH || input.known >= PATIENCE;
    let whole = used.iter().all(|input| settled(input));
    for input in used {
        if !settled(input) {
            continue;
        }
        let seen = &input.seen;
        let name = input.name.trim_matches('/').replace('/', ".");
        let sides = [
            ("bytes", Some(seen.largest)),
            ("width", seen.width),
            ("height", seen.height),
        ];
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

/// What was measured `before` with what is `now`: the greater of both.
pub fn grown(before: &Aux, now: Aux) -> Aux {
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
        row.aux = aux
            .iter()
            .map(|key| ((*key).to_owned(), "1".to_owned()))
            .collect();
        row
    }

    fn input(name: &str, count: u64, largest: u64, width: Option<u64>) -> Input {
        Input {
            name: name.to_owned(),
            seen: Seen {
                count,
                largest,
                typical: largest / 2,
                width,
                height: width.map(|width| width / 2),
            },
            known: Duration::ZERO,
        }
    }

    fn of(pairs: &[(&str, &str)]) -> Aux {
        let pairs = pairs.iter();
        pairs
            .map(|(key, value)| ((*key).to_owned(), (*value).to_owned()))
            .collect()
    }

    #[test]
    fn what_rows_name_is_told_once_it_is_known() {
        let camera = input("/camera/image", 8, 1000, Some(640));
        let few = input("/map", 7, 5000, Some(900));
        let map = Input {
            known: PATIENCE,
            ..few.clone()
        };
        let silent = input("/other", 0, 0, None);
        let text = input("/text", 9, 10, None);
        let keys = ["width", "bytes", "camera.image.typical", "text.width"];
        for (inputs, told) in [
            (vec![], of(&[])),
            (vec![silent.clone()], of(&[])),
            (
                vec![camera.clone(), silent],
                of(&[
                    ("bytes", "1000"),
                    ("camera.image.typical", "500"),
                    ("width", "640"),
                ]),
            ),
            // Of the map it is not known yet how large it is.
            (
                vec![camera.clone(), few],
                of(&[("camera.image.typical", "500")]),
            ),
            (
                vec![camera.clone(), map, text],
                of(&[
                    ("bytes", "5000"),
                    ("camera.image.typical", "500"),
                    ("width", "900"),
                ]),
            ),
        ] {
            assert_eq!(measured(&inputs, &[row(&keys)]), told, "{inputs:?}");
        }
        assert_eq!(measured(std::slice::from_ref(&camera), &[]), of(&[]));
        // A name that no row can have.
        let odd = input("/a b", 8, 1, None);
        assert_eq!(measured(&[odd], &[row(&["a b.bytes"])]), of(&[]));
    }

    #[test]
    fn what_was_measured_stays_until_it_is_more() {
        let before = of(&[("bytes", "1000"), ("width", "640")]);
        let now = of(&[("bytes", "999"), ("height", "7"), ("width", "1280")]);
        let after = of(&[("bytes", "1000"), ("height", "7"), ("width", "1280")]);
        assert_eq!(grown(&before, now), after);
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
                let inputs: Vec<Input> = names.iter().zip(look)
                    .map(|(name, (count, largest, width))| input(name, count, largest, width))
                    .collect();
                let now = measured(&inputs, &rows);
                let number = |aux: &Aux, key: &str| aux.get(key).map(|text| text.parse::<u64>().expect("a number"));
                if let (Some(all), Some(one)) = (number(&now, "bytes"), number(&now, "a.bytes")) {
                    prop_assert!(one <= all);
                }
                let after = grown(&known, now.clone());
                for key in rows[0].aux.keys() {
                    prop_assert!(number(&after, key) >= number(&known, key));
                    prop_assert!(number(&after, key) >= number(&now, key));
                }
                known = after;
            }
        }
    }
}
