//! `requests`: which input is answered by which outputs, and the times of single ones.

use std::collections::BTreeMap;

use anyhow::{Context, bail, ensure};
use qos::Pair;
use serde::{Deserialize, Serialize};

/// As written: a list, or on one line with semicolons between (the environment has only text).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "a list such as [\"/image -> /found\", { request = \"/plan\", desire = 1.0, max = 5.0 }]"
)]
pub enum Requests {
    /// Without times.
    Line(String),
    /// A list of requests.
    List(Vec<Request>),
}

/// One of them.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "\"/input -> /output\", or a table with request, desire and max"
)]
pub enum Request {
    /// `INPUT -> OUTPUT, …`, with the times that hold for all.
    Line(String),
    /// With times of its own.
    Timed(Timed),
}

/// A request with times of its own.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timed {
    /// `INPUT -> OUTPUT, …`, or the name of an input, a service or an action.
    pub request: String,
    /// T_desire, seconds.
    pub desire: f64,
    /// T_max, seconds.
    pub max: f64,
}

/// What they mean.
#[derive(Debug, Default, PartialEq)]
pub struct Meaning {
    /// Instead of what is found by itself; none where no pair is named.
    pub answers: Option<Vec<Pair>>,
    /// T_desire and T_max by input, service or action.
    pub times: BTreeMap<String, (f64, f64)>,
}

impl Requests {
    /// Reads the pairs and the times.
    ///
    /// # Errors
    /// The request that cannot be as it is, and why.
    pub fn read(&self) -> anyhow::Result<Meaning> {
        self.meaning().context("requests")
    }

    fn meaning(&self) -> anyhow::Result<Meaning> {
        let lines = |text: &String| -> Vec<Request> {
            let lines = text.split(';').map(str::trim);
            let lines = lines.filter(|line| !line.is_empty());
            lines.map(|line| Request::Line(line.to_owned())).collect()
        };
        let all = match self {
            Self::Line(text) => lines(text),
            Self::List(all) => all.clone(),
        };
        let mut meaning = Meaning::default();
        for request in all {
            let (text, times) = match request {
                Request::Line(text) => (text, None),
                Request::Timed(timed) => (timed.request, Some((timed.desire, timed.max))),
            };
            let name = if text.contains("->") {
                let pair: Pair = text.parse().map_err(anyhow::Error::msg)?;
                let name = pair.input.clone();
                let known = meaning.answers.get_or_insert_with(Vec::new);
                ensure!(
                    known.iter().all(|known| known.input != name),
                    "{name} appears twice; name all its outputs in one request"
                );
                known.push(pair);
                name
            } else {
                text.trim().to_owned()
            };
            match times {
                None if !text.contains("->") => bail!(
                    "{text:?} says neither what answers it nor in what time; write \"/input -> /output\" or \
                     {{ request = {text:?}, desire = SECONDS, max = SECONDS }}"
                ),
                None => {}
                Some(times) => {
                    ensure!(
                        name.len() > 1 && name.starts_with('/'),
                        "{name:?} is not an absolute name; begin it with a slash"
                    );
                    let before = meaning.times.insert(name, times);
                    ensure!(before.is_none(), "{text:?} is given times twice");
                }
            }
        }
        Ok(meaning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn meaning(toml: &str) -> anyhow::Result<Meaning> {
        #[derive(Deserialize)]
        struct File {
            requests: Requests,
        }
        toml::from_str::<File>(toml)?.requests.read()
    }

    fn shown(meaning: &Meaning) -> Vec<String> {
        let pairs = meaning.answers.iter().flatten();
        pairs.map(ToString::to_string).collect()
    }

    #[test]
    fn pairs_and_times_are_told_apart() {
        let all = meaning(
            "requests = [\"/image -> /found, /marked\",
                 { request = \"/scan -> /pose by stamp\", desire = 0.5, max = 2 },
                 { request = \"/plan\", desire = 1, max = 5.5 }]",
        )
        .unwrap();
        assert_eq!(
            shown(&all),
            ["/image -> /found, /marked", "/scan -> /pose by stamp"]
        );
        let times = [("/plan", (1.0, 5.5)), ("/scan", (0.5, 2.0))];
        let times = times.map(|(name, times)| (name.to_owned(), times));
        assert_eq!(all.times, BTreeMap::from(times));
        let only = meaning("requests = [{ request = \"/plan\", desire = 1, max = 5 }]").unwrap();
        assert_eq!(only.answers, None, "what answers what is still found");
        let none = meaning("requests = []").unwrap();
        assert_eq!(none, Meaning::default());
    }

    #[test]
    fn one_line_will_do() {
        let all = meaning("requests = \"/a -> /b; /c -> /d by arrival;\"").unwrap();
        assert_eq!(shown(&all), ["/a -> /b", "/c -> /d by arrival"]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (toml, named) in [
            ("requests = [\"/a\"]", "neither what answers it"),
            ("requests = [\"a -> /b\"]", "\"a\""),
            (
                "requests = [\"/a -> /b\", \"/a -> /c\"]",
                "/a appears twice",
            ),
            (
                "requests = [{ request = \"plan\", desire = 1, max = 2 }]",
                "begin it with a slash",
            ),
            (
                "requests = [{ request = \"/plan\", desire = 1 }]",
                "a list such as",
            ),
            ("requests = 5", "a list such as"),
            (
                "requests = [{ request = \"/p\", desire = 1, max = 2 }, { request = \"/p\", desire = 1, max = 2 }]",
                "times twice",
            ),
        ] {
            let error = format!("{:#}", meaning(toml).unwrap_err());
            assert!(error.contains(named), "{toml}: {error}");
        }
    }
}
