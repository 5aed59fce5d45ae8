//! What a robot would state, as flags: of `fit` and `sla explain`.

use std::collections::BTreeMap;

use anyhow::bail;
use api::Stated;
use api::sla::{AUX, check_aux};

use crate::client::escaped;

/// Each flag is a key that a robot states, with its value.
#[derive(Debug, Clone, Default, clap::Args)]
pub struct StatedFlags {
    /// Response time that is wished for, such as 100ms.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    rrt: Option<String>,
    /// The longest that is acceptable.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    max_rrt: Option<String>,
    /// Frames per second that are wished for.
    #[arg(long, value_name = "RATE", allow_hyphen_values = true)]
    fps: Option<String>,
    /// The least that is acceptable.
    #[arg(long, value_name = "RATE", allow_hyphen_values = true)]
    min_fps: Option<String>,
    /// Age of an output that is wished for.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    age: Option<String>,
    /// The greatest that is acceptable.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    max_age: Option<String>,
    /// Class of the daemon's configuration.
    #[arg(long, value_name = "NAME")]
    class: Option<String>,
    /// Cores outright.
    #[arg(long, value_name = "N", allow_hyphen_values = true)]
    cpus: Option<String>,
    /// Memory outright, such as 512M.
    #[arg(long, value_name = "SIZE", allow_hyphen_values = true)]
    memory: Option<String>,
    /// Auxiliary parameter; may be given several times.
    #[arg(long = "aux", value_name = "KEY=VALUE", value_parser = aux)]
    aux: Vec<(String, String)>,
}

/// Reads an auxiliary parameter.
pub fn aux(text: &str) -> Result<(String, String), String> {
    let (key, value) = text.split_once('=').ok_or("write KEY=VALUE")?;
    check_aux(key, value)?;
    Ok((key.to_owned(), value.to_owned()))
}

/// Auxiliary parameters, each once.
pub fn once(given: &[(String, String)]) -> anyhow::Result<BTreeMap<String, String>> {
    let mut all = BTreeMap::new();
    for (key, value) in given {
        if let Some(other) = all.insert(key.clone(), value.clone()) {
            bail!("--aux {key}={other} and --aux {key}={value} contradict each other; name one");
        }
    }
    Ok(all)
}

impl StatedFlags {
    /// Reads them as the daemon reads what a robot states.
    ///
    /// # Errors
    /// The key that cannot be as it is, and what to write.
    pub fn stated(&self) -> anyhow::Result<Stated> {
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
        let given = given
            .into_iter()
            .filter_map(|(key, value)| Some((key.to_owned(), value.clone()?)));
        let aux = once(&self.aux)?.into_iter();
        let aux = aux.map(|(key, value)| (format!("{AUX}{key}"), value));
        Ok(Stated::read(given.chain(aux))?)
    }
}

/// The query of an address, with its question mark; nothing where nothing is stated.
pub fn query(stated: &Stated) -> String {
    let pairs: Vec<String> = stated
        .pairs()
        .iter()
        .map(|(key, value)| format!("{}={}", escaped(key), escaped(value)))
        .collect();
    match pairs.is_empty() {
        true => String::new(),
        false => format!("?{}", pairs.join("&")),
    }
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

    fn refused(line: &[&str]) -> String {
        let line = Line::try_parse_from([&["fit"], line].concat()).expect("flags");
        line.stated.stated().expect_err("wrong").to_string()
    }

    #[test]
    fn what_contradicts_itself_or_is_negative_is_refused_in_words() {
        let twice = refused(&["--aux", "width=1", "--aux", "width=2"]);
        assert!(
            twice.contains("--aux width=1 and --aux width=2 contradict"),
            "{twice}"
        );
        let negative = refused(&["--rrt", "-1"]);
        assert!(
            negative.contains("rrt") && negative.contains("-1"),
            "{negative}"
        );
    }
}
