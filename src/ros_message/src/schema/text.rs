//! Texts composed of several definitions: the sections of a service or an action, and the full text that a publisher
//! sends, in which a message is followed by all its dependencies.

use std::collections::HashSet;

use crate::schema::SchemaError;
use crate::schema::types::{Base, MessageType};

/// Number of `=` in the line between the definitions of a full text.
const RULE: usize = 80;

/// Splits at lines that begin with `---`; returns exactly `N` texts.
pub(crate) fn sections<const N: usize>(name: &str, text: &str) -> Result<[String; N], SchemaError> {
    let mut parts = vec![String::new()];
    for line in text.split('\n') {
        if line.starts_with("---") {
            parts.push(String::new());
        } else if let Some(part) = parts.last_mut() {
            part.push_str(line);
            part.push('\n');
        }
    }
    let found = parts.len() - 1;
    parts.try_into().map_err(|_| SchemaError::Sections { name: name.to_owned(), expected: N - 1, found })
}

/// Returns the message's text followed by that of each dependency, in order of first mention, depth first.
pub(crate) fn full_text(message: &MessageType) -> String {
    let mut out = message.text().to_owned();
    let mut seen = HashSet::new();
    append_dependencies(message, &mut seen, &mut out);
    out
}

fn append_dependencies<'a>(message: &'a MessageType, seen: &mut HashSet<&'a str>, out: &mut String) {
    for field in message.fields() {
        let Base::Message(dependency) = &field.base else {
            continue;
        };
        if !seen.insert(dependency.name()) {
            continue;
        }
        out.push('\n');
        out.extend(std::iter::repeat_n('=', RULE));
        out.push_str("\nMSG: ");
        // In ROS 2 too, the kind between package and type is omitted: readers of such texts (Foxglove's) look up the
        // names as fields write them.
        out.push_str(&dependency.name().replacen("/msg/", "/", 1));
        out.push('\n');
        out.push_str(dependency.text());
        append_dependencies(dependency, seen, out);
    }
}

/// Splits a full text into the message's own text and (name, text) of each dependency.
pub(crate) fn split_full_text(text: &str) -> (String, Vec<(String, String)>) {
    let mut own = String::new();
    let mut others: Vec<(String, String)> = Vec::new();
    let mut lines = text.split_inclusive('\n').peekable();
    while let Some(line) = lines.next() {
        let rule = line.trim_end();
        if rule.len() == RULE && rule.bytes().all(|byte| byte == b'=') {
            if let Some(name) = lines.peek().and_then(|next| next.strip_prefix("MSG:")) {
                others.push((name.trim().to_owned(), String::new()));
                lines.next();
                continue;
            }
        }
        match others.last_mut() {
            Some((_, part)) => part.push_str(line),
            None => own.push_str(line),
        }
    }
    // Every text but the last is followed by one newline that the concatenation added.
    let count = others.len();
    for part in std::iter::once(&mut own).chain(others.iter_mut().map(|(_, part)| part)).take(count) {
        if part.ends_with('\n') {
            part.pop();
        }
    }
    (own, others)
}
