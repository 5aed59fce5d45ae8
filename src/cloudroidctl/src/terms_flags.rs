//! Flags for the terms that a robot would state, of `fit` and `sla explain`.

use std::collections::BTreeMap;

use anyhow::{Context, bail};
use api::Stated;
use api::sla::{AUX, check_aux};

use crate::client::percent_encode;

/// The terms that a robot states, one flag for each key.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct StatedFlags {
    /// Desired response time, such as 100ms.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    rrt: Option<String>,
    /// Longest acceptable response time.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    max_rrt: Option<String>,
    /// Desired frame rate in Hz.
    #[arg(long, value_name = "RATE", allow_hyphen_values = true)]
    fps: Option<String>,
    /// Lowest acceptable frame rate in Hz.
    #[arg(long, value_name = "RATE", allow_hyphen_values = true)]
    min_fps: Option<String>,
    /// Desired age of an output.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    age: Option<String>,
    /// Greatest acceptable age of an output.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    max_age: Option<String>,
    /// Class of the daemon's configuration.
    #[arg(long, value_name = "NAME")]
    class: Option<String>,
    /// Requested cores, instead of those of an entry.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    cpus: Option<String>,
    /// Requested memory, such as 512M, instead of that of an entry.
    #[arg(long, value_name = "SIZE", allow_hyphen_values = true)]
    memory: Option<String>,
    /// Auxiliary parameter; may be given several times.
    #[arg(long = "aux", value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
}

/// Parses an auxiliary parameter.
pub fn aux(text: &str) -> anyhow::Result<(String, String)> {
    let (key, value) = text.split_once('=').context("write KEY=VALUE")?;
    check_aux(key, value)?;
    Ok((key.to_owned(), value.to_owned()))
}

/// Returns the auxiliary parameters as a map; a key with two values is an error.
pub fn unique_aux(given: &[(String, String)]) -> anyhow::Result<BTreeMap<String, String>> {
    let mut all = BTreeMap::new();
    for (key, value) in given {
        if let Some(other) = all.insert(key.clone(), value.clone()) {
            bail!("--aux {key}={other} and --aux {key}={value} contradict each other; pass one");
        }
    }
    Ok(all)
}

impl StatedFlags {
    /// Parses the flags as the daemon parses the terms of a robot.
    ///
    /// # Errors
    /// A key has an invalid value; the error says what to write.
    pub fn to_stated(&self) -> anyhow::Result<Stated> {
        let given = [
            ("rrt", &self.rrt),
            ("max_rrt", &self.max_rrt),
            ("fps", &self.fps),
            ("min_fps", &self.min_fps),
            ("age", &self.age),
            ("max_age", &self.max_age),
            ("class", &self.class),
            ("cpus", &self.cpus),
            ("memory", &self.memory),
        ];
        let given = given.into_iter().filter_map(|(key, value)| Some((key.to_owned(), value.clone()?)));
        let aux = unique_aux(&self.aux)?.into_iter();
        let aux = aux.map(|(key, value)| (format!("{AUX}{key}"), value));
        Ok(Stated::read(given.chain(aux))?)
    }
}

/// Returns the terms as a query with its question mark; an empty string if there are none.
pub fn to_query(stated: &Stated) -> String {
    let pairs: Vec<String> = stated
        .to_pairs()
        .iter()
        .map(|(key, value)| format!("{}={}", percent_encode(key), percent_encode(value)))
        .collect();
    if pairs.is_empty() { String::new() } else { format!("?{}", pairs.join("&")) }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        stated: StatedFlags,
    }

    fn refusal(line: &[&str]) -> String {
        let line = Line::try_parse_from([&["fit"], line].concat()).expect("flags");
        line.stated.to_stated().expect_err("wrong").to_string()
    }

    #[test]
    fn what_contradicts_itself_or_is_negative_is_refused_in_words() {
        let twice = refusal(&["--aux", "width=1", "--aux", "width=2"]);
        assert!(twice.contains("--aux width=1 and --aux width=2 contradict"), "{twice}");
        let negative = refusal(&["--rrt", "-1"]);
        assert!(negative.contains("rrt") && negative.contains("-1"), "{negative}");
    }
}
