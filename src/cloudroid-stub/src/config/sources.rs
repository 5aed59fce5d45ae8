//! Where a configuration comes from: `stub.toml`, and what the environment and ROS parameters say instead.

use std::path::Path;

use anyhow::Context;
use toml::{Table, Value};

use super::{Config, FILE};
use crate::address::Address;

/// Reads `stub.toml` in `share` with what the environment says instead.
pub fn read(
    share: &Path,
    environment: impl Iterator<Item = (String, String)>,
) -> anyhow::Result<Config> {
    let path = share.join(FILE);
    let text = std::fs::read_to_string(&path).with_context(|| {
        format!(
            "cannot read {}: the stub's package is not complete; install it again",
            path.display()
        )
    })?;
    let table: Table = toml::from_str(&text).with_context(|| format!("{}", path.display()))?;
    with(
        table,
        environment.filter_map(|(name, value)| Some((key_of(&name)?, value))),
    )
    .with_context(|| format!("{} with CLOUDROID_* of the environment", path.display()))
}

/// The key that an environment variable stands for.
pub(super) fn key_of(variable: &str) -> Option<String> {
    let key = variable.strip_prefix("CLOUDROID_")?.to_ascii_lowercase();
    KEYS.contains(&key.as_str()).then_some(key)
}

/// All keys. Other variables that begin with CLOUDROID_ are not the stub's.
const KEYS: [&str; 33] = [
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
    "frames_per_second",
    "desired_frames_per_second",
    "age",
    "desired_age",
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

/// The file's table with some keys given otherwise, as text.
pub(super) fn with(
    mut table: Table,
    instead: impl Iterator<Item = (String, String)>,
) -> anyhow::Result<Config> {
    for (key, text) in instead {
        table.insert(key, value_of(&text));
    }
    let mut config: Config = table.try_into()?;
    // The parts that share them write them as whole numbers too.
    while config.server.ends_with('/') {
        config.server.pop();
    }
    Address::parse(&config.server).map_err(anyhow::Error::msg)?;
    config.check()?;
    Ok(config)
}

/// A value as TOML would read it, or else as text.
fn value_of(text: &str) -> Value {
    match text.trim() {
        "true" => Value::Boolean(true),
        "false" => Value::Boolean(false),
        other => other.parse().map_or_else(
            |_| Value::String(text.to_owned()),
            |number: f64| Value::Float(number),
        ),
    }
}
