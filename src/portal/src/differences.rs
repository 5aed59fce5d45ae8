//! `/api/v1/services/{name}/differences`: for a deployer before a rollback, or a reviewer after a push.

use std::collections::{BTreeMap, BTreeSet};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;

use api::differences::{Difference, Differences, RevisionPart as Part};
use api::rollout::RolloutState;
use axum::Json;
use axum::extract::{Path, State};
use package::interface::Interface;
use package::inventory::Inventory;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use store::{EventFilter, RevisionRecord};
use utoipa::IntoParams;

use crate::app::App;
use crate::errors::Error;
use crate::json::JsonResult;
use crate::query::Query;

/// Query: which revisions.
#[derive(Debug, Deserialize, IntoParams)]
pub struct DifferencesQuery {
    /// Number of the revision to compare with (default: after a rollback, the one that was rolled back; otherwise the
    /// one published before `to`).
    from: Option<u64>,
    /// Number of the revision to compare (default: the current one).
    to: Option<u64>,
}

/// Compares two revisions of a service.
pub async fn differences(
    State(app): State<Arc<App>>,
    Path(name): Path<String>,
    Query(between): Query<DifferencesQuery>,
) -> JsonResult<Differences> {
    let revisions = app.state.revisions(&name)?;
    let to = match between.to {
        Some(to) => to,
        None => app.catalogue.current_revision(&name)?.number,
    };
    let from = match between.from {
        Some(from) => Some(from),
        None => {
            let numbers: Vec<u64> = revisions.iter().map(|line| line.number).collect();
            let is_rolled_back = between.to.is_none() && was_rolled_back(&app, &name)?;
            default_from(&numbers, to, is_rolled_back, untried_candidate(&app, &name))
        }
    };
    let unknown = |revision: String| -> Error {
        let exists = revisions.iter().map(|line| line.number.to_string());
        catalogue::Error::UnknownRevision { service: name.clone(), revision, exists: exists.collect() }.into()
    };
    let record = |number: u64| {
        let found = app.state.revision(&name, number)?;
        found.ok_or_else(|| unknown(number.to_string()))
    };
    // A missing service is reported rather than its missing revision.
    app.catalogue.current_revision(&name)?;
    let to = record(to)?;
    let from = record(from.ok_or_else(|| unknown(format!("before {}", to.number)))?)?;
    let before = revision_parts(&from, &app.catalogue.revision_contents(&from).await?.inventory);
    let after = revision_parts(&to, &app.catalogue.revision_contents(&to).await?.inventory);
    Ok(Json(Differences { service: name, from: from.number, to: to.number, differences: compare(before, after) }))
}

/// Returns whether the journal has a rollback of the service.
fn was_rolled_back(app: &App, service: &str) -> Result<bool, Error> {
    let filter = EventFilter { kind: Some("rolled-back"), service: Some(service), ..EventFilter::default() };
    Ok(!app.state.filtered_events(filter, 0, 1)?.is_empty())
}

/// Returns the candidate of the last rollout if it never became the current revision.
fn untried_candidate(app: &App, service: &str) -> Option<u64> {
    let rollout = app.choreographer.rollout(service).ok()?;
    let was_current = matches!(rollout.state, RolloutState::Promoted | RolloutState::Draining);
    (!was_current).then_some(rollout.candidate)
}

/// Returns the revision to compare with `to`, of those with these numbers, newest first: after a rollback the newest
/// one that was current, otherwise the one published before.
fn default_from(numbers: &[u64], to: u64, is_rolled_back: bool, untried: Option<u64>) -> Option<u64> {
    let mut later = numbers.iter().filter(|number| **number > to && Some(**number) != untried);
    let before = numbers.iter().find(|number| **number < to);
    later.next().filter(|_| is_rolled_back).or(before).copied()
}

/// Parts of a revision: each with a text and, where the text does not show every change, a number that differs.
type RevisionParts = BTreeMap<(Part, String), (String, u64)>;

fn compare(before: RevisionParts, mut after: RevisionParts) -> Vec<Difference> {
    let difference = |(part, name): (Part, String), before, after| Difference { part, name, before, after };
    let mut found = Vec::new();
    for (key, was) in before {
        match after.remove(&key) {
            Some(is) if is == was => {}
            is => found.push(difference(key, Some(was.0), is.map(|is| is.0))),
        }
    }
    let new = after.into_iter();
    found.extend(new.map(|(key, is)| difference(key, None, Some(is.0))));
    found.sort_by(|a, b| (a.part, &a.name).cmp(&(b.part, &b.name)));
    found
}

fn revision_parts(of: &RevisionRecord, inventory: &Inventory) -> RevisionParts {
    let mut parts = RevisionParts::new();
    let mut add = |part: Part, name: &str, words: String, all: u64| {
        parts.insert((part, name.to_owned()), (words, all));
    };
    add(Part::Push, "package", of.package.clone(), 0);
    add(Part::Push, "source", of.source.clone(), 0);
    for (name, set) in [("restart", of.plan.restart), ("stateful", of.plan.stateful)] {
        if set {
            add(Part::Push, name, "yes".to_owned(), 0);
        }
    }
    for node in &of.plan.nodes {
        add(Part::Node, &node.name, node.argv.join(" "), 0);
        let mut more = serde_json::to_value(node).unwrap_or_default();
        if let Some(fields) = more.as_object_mut() {
            fields.retain(|field, _| !["name", "argv", "environment"].contains(&&**field));
        }
        let name = |field: &str| format!("{} {field}", node.name);
        for (field, value) in meaningful_fields(&more) {
            add(Part::Node, &name(&field), value, 0);
        }
        for (variable, value) in &node.environment {
            add(Part::Environment, &name(variable), "set".to_owned(), hash(value));
        }
    }
    for (container, components) in &of.plan.components {
        for (index, component) in components.iter().enumerate() {
            let name = component.full_name();
            let name = name.unwrap_or_else(|| format!("{} (number {})", component.plugin, index + 1));
            let loaded = serde_json::to_string(component).unwrap_or_default();
            add(Part::Node, &format!("{container} loads {name}"), loaded, 0);
        }
    }
    for (variable, value) in &of.plan.environment {
        add(Part::Environment, variable, "set".to_owned(), hash(value));
    }
    add_interface(&of.interface, &mut add);
    for (name, value) in &of.plan.parameters {
        let value = serde_json::to_value(value).unwrap_or_default();
        add(Part::Parameter, name, value_text(&value), 0);
    }
    for (part, value) in [
        (Part::Limit, to_json(&of.plan.limits)),
        (Part::Cap, to_json(&of.plan.caps)),
        (Part::Sla, to_json(&of.plan.sla)),
        (Part::Grant, to_json(&of.plan.grants)),
        (Part::Shared, to_json(&of.plan.shared)),
    ] {
        for (field, value) in meaningful_fields(&value) {
            add(part, &field, value, 0);
        }
    }
    for (name, installed) in &inventory.packages {
        let programs: BTreeSet<&str> = installed.executables.iter().map(String::as_str).collect();
        let words = match programs.len() {
            0 => installed.share.clone(),
            count => format!("{}, {count} programs", installed.share),
        };
        add(Part::Package, name, words, hash(&programs));
    }
    parts
}

fn add_interface(of: &Interface, add: &mut impl FnMut(Part, &str, String, u64)) {
    for topic in &of.topics {
        let direction = match topic.direction {
            package::interface::Direction::Input => "input",
            package::interface::Direction::Output => "output",
        };
        let marks = [(topic.latched, ", latched"), (topic.lazy, ", lazy")];
        let marks = marks.iter().filter(|(set, _)| *set).map(|(_, mark)| *mark);
        let words = format!("{}, {direction}{}", topic.type_name, marks.collect::<String>());
        add(Part::Topic, &topic.name, words, 0);
    }
    for service in &of.services {
        add(Part::Service, &service.name, service.type_name.clone(), 0);
    }
    for action in &of.actions {
        add(Part::Action, &action.name, action.type_name.clone(), 0);
    }
    for need in &of.needs {
        let nodes = format!("called by {}", need.nodes.join(", "));
        add(Part::Need, &need.name, nodes, 0);
    }
    for (name, definition) in &of.definitions {
        let lines = definition.lines().count();
        add(Part::Definition, name, format!("{lines} lines"), hash(definition));
    }
}

fn hash(of: &(impl Hash + ?Sized)) -> u64 {
    let mut hasher = DefaultHasher::new();
    of.hash(&mut hasher);
    hasher.finish()
}

fn to_json(of: &impl Serialize) -> Value {
    serde_json::to_value(of).unwrap_or_default()
}

fn value_text(value: &Value) -> String {
    match value {
        Value::String(text) => text.clone(),
        Value::Array(all) => all.iter().map(value_text).collect::<Vec<_>>().join(", "),
        other => other.to_string(),
    }
}

/// Returns the fields of an object that are set, each value as text.
fn meaningful_fields(of: &Value) -> Vec<(String, String)> {
    let says_nothing = |value: &Value| match value {
        Value::Null | Value::Bool(false) => true,
        Value::String(text) => text.is_empty(),
        Value::Array(all) => all.is_empty(),
        Value::Number(number) => number.as_f64() == Some(0.0),
        _ => false,
    };
    let all = of.as_object().into_iter().flatten();
    all.filter(|(_, value)| !says_nothing(value)).map(|(name, value)| (name.clone(), value_text(value))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn revision() -> RevisionRecord {
        RevisionRecord {
            service: "s".into(),
            number: 1,
            image: String::new(),
            published: 0,
            package: "p".into(),
            owner: None,
            source: "/p".into(),
            flavour: ros::flavour::Flavour::default(),
            plan: store::Plan {
                nodes: serde_json::from_str(r#"[{"name": "/n", "argv": ["/n", "-v"]}]"#).expect("a node"),
                environment: [("TOKEN".to_owned(), "secret".to_owned())].into(),
                ..store::Plan::default()
            },
            interface: Interface::default(),
        }
    }

    #[test]
    fn a_revision_is_compared_with_the_one_that_it_replaced() {
        for (to, is_rolled_back, untried, expected) in [
            (3, false, None, Some(2)),
            (1, false, None, None),
            // Rolled back from 3 to 1, or to 2; once it is pushed again there is nothing later.
            (1, true, None, Some(3)),
            (2, true, None, Some(3)),
            (3, true, None, Some(2)),
            // Revision 3 is or was a canary.
            (2, false, Some(3), Some(1)),
            (2, true, Some(3), Some(1)),
            (1, true, Some(3), Some(2)),
        ] {
            let from = default_from(&[3, 2, 1], to, is_rolled_back, untried);
            assert_eq!(from, expected, "{to} {is_rolled_back} {untried:?}");
        }
    }

    #[test]
    fn what_was_added_removed_and_changed_is_told_and_nothing_else() {
        let before = revision();
        let mut after = revision();
        after.number = 2;
        after.plan.limits.cpus = Some(1.5);
        after.plan.nodes[0].respawn = true;
        after.plan.nodes[0].argv.pop();
        after.plan.environment.insert("TOKEN".into(), "other".into());
        let nothing = Inventory::default();
        let told = |from: &RevisionRecord, to: &RevisionRecord| -> Vec<String> {
            let found = compare(revision_parts(from, &nothing), revision_parts(to, &nothing));
            let lines = found.iter().map(|one| {
                let side = |side: &Option<String>| side.clone().unwrap_or_else(|| "-".into());
                let (before, after) = (side(&one.before), side(&one.after));
                format!("{:?} {}: {before} > {after}", one.part, one.name)
            });
            lines.collect()
        };
        assert!(told(&before, &before).is_empty());
        assert_eq!(
            told(&before, &after),
            ["Node /n: /n -v > /n", "Node /n respawn: - > true", "Limit cpus: - > 1.5", "Environment TOKEN: set > set",]
        );
        assert_eq!(told(&after, &before)[2], "Limit cpus: 1.5 > -");
    }
}
