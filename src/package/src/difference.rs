//! Comparison of the interfaces of two revisions of a service with regard to the compatibility of robots.

use std::collections::BTreeMap;
use std::fmt;

use crate::interface::{Action, Direction, Interface, Parameter, Qos, Service, Topic};
use crate::names;

/// A single difference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Change {
    /// True if a robot built for the old interface works with the new one in this respect.
    pub compatible: bool,
    /// Human-readable description, such as "output topic /found is gone".
    pub text: String,
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

/// Differences between two interfaces: incompatible ones first, then by text.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Difference {
    /// Differences; empty if there are none.
    pub changes: Vec<Change>,
}

impl Difference {
    /// Returns whether nothing has changed that a robot relies on.
    pub fn compatible(&self) -> bool {
        self.changes.iter().all(|change| change.compatible)
    }

    /// Compares `old` with `new`. Additions are compatible; removed objects, other types and topics that are no longer
    /// latched are not; changes of parameters are always compatible.
    pub fn compare(old: &Interface, new: &Interface) -> Self {
        let mut changes = ChangeList::default();
        changes.compare_topics(&old.topics, &new.topics);
        changes.compare_services(&old.services, &new.services);
        changes.compare_actions(old, new);
        changes.compare_parameters(&old.parameters, &new.parameters);
        let mut changes = changes.0;
        changes.sort_by(|a, b| (a.compatible, &a.text).cmp(&(b.compatible, &b.text)));
        changes.dedup();
        Self { changes }
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for change in &self.changes {
            let mark = if change.compatible { ' ' } else { '!' };
            writeln!(f, "{mark} {change}")?;
        }
        Ok(())
    }
}

#[derive(Default)]
struct ChangeList(Vec<Change>);

impl ChangeList {
    fn add_compatible(&mut self, text: String) {
        self.0.push(Change { compatible: true, text });
    }

    fn add_breaking(&mut self, text: String) {
        self.0.push(Change { compatible: false, text });
    }

    /// Matches two lists by key, records removed and added items, and passes the others to `both`.
    fn compare_by_key<'a, T>(
        &mut self,
        old: &'a [T],
        new: &'a [T],
        key: impl Fn(&T) -> String,
        mut both: impl FnMut(&mut Self, &str, &'a T, &'a T),
    ) {
        let old: BTreeMap<String, &T> = old.iter().map(|item| (key(item), item)).collect();
        let mut new: BTreeMap<String, &T> = new.iter().map(|item| (key(item), item)).collect();
        for (key, old) in old {
            match new.remove(&key) {
                Some(new) => both(self, &key, old, new),
                None => self.add_breaking(format!("{key} was removed")),
            }
        }
        for key in new.into_keys() {
            self.add_compatible(format!("{key} is new"));
        }
    }

    fn compare_type(&mut self, what: &str, old: (&str, &str), new: (&str, &str)) {
        if old.0 != new.0 {
            self.add_breaking(format!("{what} was a {} and is a {}", old.0, new.0));
        } else if old.1 != new.1 && !old.1.is_empty() && !new.1.is_empty() {
            self.add_breaking(format!("{what} has a different definition of {} (md5 {} was {})", new.0, new.1, old.1));
        }
    }

    fn compare_topics(&mut self, old: &[Topic], new: &[Topic]) {
        self.compare_by_key(old, new, topic_key, |changes, what, old, new| {
            changes.compare_type(what, (&old.type_name, &old.md5), (&new.type_name, &new.md5));
            match (old.latched, new.latched) {
                (true, false) => changes.add_breaking(format!("{what} is no longer latched")),
                (false, true) => changes.add_compatible(format!("{what} is now latched")),
                _ => {}
            }
            if let (Some(before), Some(after)) = (old.qos, new.qos) {
                changes.compare_qos(what, new.direction, before, after);
            }
        });
    }

    /// Compares QoS: if the package offers less or requests more than before, robots that were compatible may no longer
    /// exchange messages with it.
    fn compare_qos(&mut self, what: &str, direction: Direction, before: Qos, after: Qos) {
        if before == after {
            return;
        }
        let suits = match direction {
            Direction::Output => before.common_offer(after) == before,
            Direction::Input => before.common_request(after) == before,
        };
        let text = format!("the quality of service of {what} is {after} and was {before}");
        if suits { self.add_compatible(text) } else { self.add_breaking(text) }
    }

    fn compare_services(&mut self, old: &[Service], new: &[Service]) {
        let key = |service: &Service| format!("service {}", service.name);
        self.compare_by_key(old, new, key, |changes, what, old, new| {
            changes.compare_type(what, (&old.type_name, &old.md5), (&new.type_name, &new.md5));
        });
    }

    fn compare_actions(&mut self, old_all: &Interface, new_all: &Interface) {
        let key = |action: &Action| format!("action {}", action.name);
        let definition = |all: &Interface, action: &Action| {
            let text = all.definitions.get(&names::definition_key(&action.type_name, "action"));
            text.map(|text| normalize(text))
        };
        self.compare_by_key(&old_all.actions, &new_all.actions, key, |changes, what, old, new| {
            changes.compare_type(what, (&old.type_name, ""), (&new.type_name, ""));
            let (before, after) = (definition(old_all, old), definition(new_all, new));
            if old.type_name == new.type_name && before.is_some() && after.is_some() && before != after {
                changes.add_breaking(format!("{what} has a different definition of {}", new.type_name));
            }
        });
    }

    fn compare_parameters(&mut self, old: &[Parameter], new: &[Parameter]) {
        let key = |parameter: &Parameter| format!("parameter {}", parameter.name);
        let mut notes = Self::default();
        notes.compare_by_key(old, new, key, |changes, what, old, new| {
            if let (Some(before), Some(after)) = (&old.value, &new.value) {
                if before != after {
                    changes.add_compatible(format!("{what} is {after} and was {before}"));
                }
            }
        });
        self.0.extend(notes.0.into_iter().map(|change| Change { compatible: true, ..change }));
    }
}

fn topic_key(topic: &Topic) -> String {
    let direction = match topic.direction {
        Direction::Input => "input",
        Direction::Output => "output",
    };
    format!("{direction} topic {}", topic.name)
}

/// Returns a definition without comments and insignificant white space.
fn normalize(text: &str) -> Vec<String> {
    let lines = text.lines().map(|line| line.split('#').next().unwrap_or_default());
    let folded = lines.map(|line| line.split_whitespace().collect::<Vec<_>>().join(" "));
    folded.filter(|line| !line.is_empty()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::interface::Reliability;

    fn old() -> Interface {
        let topic = |name: &str, direction, latched| Topic {
            name: name.into(),
            type_name: "std_msgs/String".into(),
            md5: "aa".into(),
            direction,
            nodes: vec!["/n".into()],
            latched,
            lazy: false,
            qos: None,
        };
        let parameter =
            |name: &str, value: i64| Parameter { name: name.into(), value: Some(value.into()), ..Parameter::default() };
        Interface {
            late: Vec::new(),
            topics: vec![topic("/in", Direction::Input, false), topic("/out", Direction::Output, true)],
            services: vec![Service { name: "/s".into(), type_name: "a/S".into(), md5: "bb".into(), node: "/n".into() }],
            actions: vec![Action { name: "/act".into(), type_name: "a/Go".into(), node: "/n".into() }],
            parameters: vec![parameter("/p", 1)],
            needs: Vec::new(),
            lifecycle: Vec::new(),
            requests: None,
            definitions: [("a/action/Go".to_owned(), "int32 x # goal\n---\n---\n".to_owned())].into(),
        }
    }

    fn texts(difference: &Difference) -> Vec<String> {
        difference.to_string().lines().map(str::to_owned).collect()
    }

    #[test]
    fn the_same_is_no_difference() {
        let mut new = old();
        new.topics.reverse();
        new.topics[0].nodes = vec!["/renamed".into()];
        new.definitions.insert("a/action/Go".into(), "int32   x\n\n---\n---".into());
        let difference = Difference::compare(&old(), &new);
        assert_eq!(difference, Difference::default());
        assert!(difference.compatible());
    }

    #[test]
    fn what_is_new_breaks_nothing() {
        let mut before = old();
        before.topics.remove(0);
        before.services.clear();
        before.parameters[0].value = Some(2.into());
        let difference = Difference::compare(&before, &old());
        assert!(difference.compatible());
        assert_eq!(
            texts(&difference),
            ["  input topic /in is new", "  parameter /p is 1 and was 2", "  service /s is new"]
        );
    }

    #[test]
    fn an_output_that_offers_less_and_an_input_that_asks_for_more_break() {
        let with = |at: usize, qos: Qos| {
            let mut interface = old();
            interface.topics[at].qos = Some(qos);
            interface
        };
        let (weak, strong) = (Qos { reliability: Reliability::BestEffort, ..Qos::default() }, Qos::default());
        for (at, from, to, compatible) in
            [(1, strong, weak, false), (1, weak, strong, true), (0, weak, strong, false), (0, strong, weak, true)]
        {
            let difference = Difference::compare(&with(at, from), &with(at, to));
            assert_eq!(difference.changes.len(), 1, "{difference}");
            assert_eq!(difference.compatible(), compatible, "{difference}");
        }
        let text = Difference::compare(&with(1, strong), &with(1, weak)).to_string();
        assert_eq!(
            text,
            "! the quality of service of output topic /out is best_effort, volatile and was reliable, volatile\n"
        );
    }

    #[test]
    fn actions_of_ros_2_are_compared_by_their_definitions() {
        let go = |text: &str| Interface {
            actions: vec![Action { name: "/go".into(), type_name: "a/action/Go".into(), node: "/n".into() }],
            definitions: [("a/action/Go".to_owned(), text.to_owned())].into(),
            ..Interface::default()
        };
        let difference = Difference::compare(&go("---\n---\n"), &go("int8 x\n---\n---\n"));
        assert!(!difference.compatible(), "{difference}");
    }

    #[test]
    fn what_is_gone_or_of_another_type_breaks() {
        let mut new = old();
        new.topics[0].type_name = "std_msgs/Int32".into();
        new.topics[1].direction = Direction::Input;
        new.services[0].md5 = "cc".into();
        new.definitions.insert("a/action/Go".into(), "int64 x\n---\n---\n".into());
        new.parameters.clear();
        let difference = Difference::compare(&old(), &new);
        assert!(!difference.compatible());
        let expected = [
            "! action /act has a different definition of a/Go",
            "! input topic /in was a std_msgs/String and is a std_msgs/Int32",
            "! output topic /out was removed",
            "! service /s has a different definition of a/S (md5 cc was bb)",
            "  input topic /out is new",
            "  parameter /p was removed",
        ];
        assert_eq!(texts(&difference), expected);
        let mut unlatched = old();
        unlatched.topics[1].latched = false;
        assert_eq!(texts(&Difference::compare(&old(), &unlatched)), ["! output topic /out is no longer latched"]);
        assert!(Difference::compare(&unlatched, &old()).compatible());
    }
}
