//! `requests`: inputs and the outputs that answer them, with times for single requests.

use std::collections::BTreeMap;

use anyhow::{Context, bail, ensure};
use qos::TopicPair;
use serde::{Deserialize, Serialize};

/// The requests as written: a list, or one line separated by semicolons (an environment variable is a text).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(
    untagged,
    expecting = "a list such as [\"/image -> /found\", { request = \"/plan\", desire = 1.0, max = 5.0 }]"
)]
pub enum RequestsSetting {
    /// One line, without times.
    Line(String),
    /// A list of requests.
    List(Vec<RequestSetting>),
}

/// A request as written.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged, expecting = "\"/input -> /output\", or a table with request, desire and max")]
pub enum RequestSetting {
    /// `INPUT -> OUTPUT, …`, with the times that hold for all.
    Line(String),
    /// A request with its own times.
    Timed(TimedRequest),
}

/// A request with its own times.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimedRequest {
    /// `INPUT -> OUTPUT, …`, or the name of an input, a service or an action.
    pub request: String,
    /// T_desire in seconds.
    pub desire: f64,
    /// T_max in seconds.
    pub max: f64,
}

/// The parsed requests.
#[derive(Debug, Default, PartialEq)]
pub struct ParsedRequests {
    /// Pairs that replace those that are determined automatically; `None` if no pair is named.
    pub answers: Option<Vec<TopicPair>>,
    /// T_desire and T_max by input, service or action.
    pub times: BTreeMap<String, (f64, f64)>,
}

impl RequestsSetting {
    /// Parses the pairs and the times.
    ///
    /// # Errors
    /// A request is invalid; the error names it and the reason.
    pub fn read(&self) -> anyhow::Result<ParsedRequests> {
        self.parse().context("requests")
    }

    fn parse(&self) -> anyhow::Result<ParsedRequests> {
        let lines = |text: &String| -> Vec<RequestSetting> {
            let lines = text.split(';').map(str::trim);
            let lines = lines.filter(|line| !line.is_empty());
            lines.map(|line| RequestSetting::Line(line.to_owned())).collect()
        };
        let all = match self {
            Self::Line(text) => lines(text),
            Self::List(all) => all.clone(),
        };
        let mut meaning = ParsedRequests::default();
        for request in all {
            let (text, times) = match request {
                RequestSetting::Line(text) => (text, None),
                RequestSetting::Timed(timed) => (timed.request, Some((timed.desire, timed.max))),
            };
            let name = if text.contains("->") {
                let pair: TopicPair = text.parse()?;
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
                    "{text:?} has neither an output nor times; write \"/input -> /output\" or {{ request = {text:?}, \
                        desire = SECONDS, max = SECONDS }}"
                ),
                None => {}
                Some(times) => {
                    ensure!(
                        name.len() > 1 && name.starts_with('/'),
                        "{name:?} is not an absolute name; begin it with a slash"
                    );
                    let before = meaning.times.insert(name, times);
                    ensure!(before.is_none(), "the times of {text:?} are given twice");
                }
            }
        }
        Ok(meaning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse_requests(toml: &str) -> anyhow::Result<ParsedRequests> {
        #[derive(Deserialize)]
        struct File {
            requests: RequestsSetting,
        }
        toml::from_str::<File>(toml)?.requests.read()
    }

    fn pair_texts(meaning: &ParsedRequests) -> Vec<String> {
        let pairs = meaning.answers.iter().flatten();
        pairs.map(ToString::to_string).collect()
    }

    #[test]
    fn pairs_and_times_are_told_apart() {
        let all = parse_requests(
            "requests = [\"/image -> /found, /marked\",
                 { request = \"/scan -> /pose by stamp\", desire = 0.5, max = 2 },
                 { request = \"/plan\", desire = 1, max = 5.5 }]",
        )
        .unwrap();
        assert_eq!(pair_texts(&all), ["/image -> /found, /marked", "/scan -> /pose by stamp"]);
        let times = [("/plan", (1.0, 5.5)), ("/scan", (0.5, 2.0))];
        let times = times.map(|(name, times)| (name.to_owned(), times));
        assert_eq!(all.times, BTreeMap::from(times));
        let only = parse_requests("requests = [{ request = \"/plan\", desire = 1, max = 5 }]").unwrap();
        assert_eq!(only.answers, None, "what answers what is still found");
        let none = parse_requests("requests = []").unwrap();
        assert_eq!(none, ParsedRequests::default());
    }

    #[test]
    fn one_line_will_do() {
        let all = parse_requests("requests = \"/a -> /b; /c -> /d by arrival;\"").unwrap();
        assert_eq!(pair_texts(&all), ["/a -> /b", "/c -> /d by arrival"]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        for (toml, named) in [
            ("requests = [\"/a\"]", "neither an output nor times"),
            ("requests = [\"a -> /b\"]", "\"a\""),
            ("requests = [\"/a -> /b\", \"/a -> /c\"]", "/a appears twice"),
            ("requests = [{ request = \"plan\", desire = 1, max = 2 }]", "begin it with a slash"),
            ("requests = [{ request = \"/plan\", desire = 1 }]", "a list such as"),
            ("requests = 5", "a list such as"),
            (
                "requests = [{ request = \"/p\", desire = 1, max = 2 }, { request = \"/p\", desire = 1, max = 2 }]",
                "given twice",
            ),
        ] {
            let error = format!("{:#}", parse_requests(toml).unwrap_err());
            assert!(error.contains(named), "{toml}: {error}");
        }
    }
}
