//! Sources of a configuration: `stub.toml`, overridden by the environment and by ROS parameters.

use std::path::Path;

use anyhow::Context;
use toml::{Table, Value};

use super::{Config, FILE, OUTPUT_MEASURES};
use crate::address::Address;

/// Reads `stub.toml` in `share`, with the overrides of the environment.
pub fn load(share: &Path, environment: impl Iterator<Item = (String, String)>) -> anyhow::Result<Config> {
    let path = share.join(FILE);
    let text = std::fs::read_to_string(&path).with_context(|| {
        format!("cannot read {}: the stub's package is incomplete; install it again", path.display())
    })?;
    let table: Table = toml::from_str(&text).with_context(|| format!("{}", path.display()))?;
    apply_overrides(table, environment.filter_map(|(name, value)| Some((key_for_variable(&name)?, value))))
        .with_context(|| format!("{} with CLOUDROID_* environment variables", path.display()))
}

/// Returns the key that an environment variable sets.
pub(super) fn key_for_variable(variable: &str) -> Option<String> {
    let key = variable.strip_prefix("CLOUDROID_")?.to_ascii_lowercase();
    let is_measure = OUTPUT_MEASURES.iter().any(|measure| [measure.key, measure.desired_key].contains(&key.as_str()));
    (is_measure || KEYS.contains(&key.as_str())).then_some(key)
}

/// All keys but those of [`OUTPUT_MEASURES`]. Other variables with the prefix CLOUDROID_ are not the stub's.
const KEYS: [&str; 29] = [
    "server",
    "service",
    "token",
    "token_file",
    "ca_file",
    "fingerprint",
    "known_servers",
    "identity",
    "robot",
    "desire",
    "max",
    "threshold",
    "initial",
    "cap",
    "output",
    "request",
    "requests",
    "fallback_after",
    "call_limit",
    "local",
    "stateful",
    "safe_stop",
    "class",
    "cpus",
    "memory",
    "aux",
    "stamps",
    "codec",
    "quality",
];

/// Builds a configuration from a table with overrides, which are texts.
pub(super) fn apply_overrides(
    mut table: Table,
    instead: impl Iterator<Item = (String, String)>,
) -> anyhow::Result<Config> {
    for (key, text) in instead {
        table.insert(key, parse_value(&text));
    }
    let mut config: Config = table.try_into()?;
    // Normalize the server's address: no trailing slashes.
    while config.server.ends_with('/') {
        config.server.pop();
    }
    Address::parse(&config.server)?;
    config.check()?;
    Ok(config)
}

/// Parses a value as TOML would; anything else is a text.
fn parse_value(text: &str) -> Value {
    match text.trim() {
        "true" => Value::Boolean(true),
        "false" => Value::Boolean(false),
        other => other.parse().map_or_else(|_| Value::String(text.to_owned()), |number: f64| Value::Float(number)),
    }
}
