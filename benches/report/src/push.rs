//! A push as a deployer sees it: `cloudroidctl push`, its events, and the times at which they arrived.

use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};
use serde_json::Value;
use support::binaries;

use crate::BenchDaemon;

/// Events and duration of a push.
#[derive(Debug)]
pub struct TimedPush {
    /// Events of the response (`api::PushEvent`), each with the time since the command was started.
    pub events: Vec<(Duration, Value)>,
    /// Duration of the command.
    pub total: Duration,
}

impl BenchDaemon {
    /// Runs `cloudroidctl push ARGUMENTS` to its end.
    pub fn push(&self, arguments: &[&str]) -> Result<TimedPush> {
        let mut command = Command::new(binaries::path("cloudroidctl"));
        command.args(["--format", "json", "push"]).args(arguments);
        command.env("CLOUDROID_HOME", &self.home).env_remove("CLOUDROID_SERVER");
        let begun = Instant::now();
        let mut child = command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn()?;
        let mut events = Vec::new();
        for line in BufReader::new(child.stdout.take().context("piped")?).lines() {
            let event: Value = serde_json::from_str(&line?)?;
            if event["type"] == "error" {
                let _ = child.wait();
                bail!("the push of {} failed: {}", arguments.join(" "), event["problem"]);
            }
            events.push((begun.elapsed(), event));
        }
        let status = child.wait()?;
        let total = begun.elapsed();
        ensure!(status.success(), "the push of {} ended with {status}", arguments.join(" "));
        Ok(TimedPush { events, total })
    }
}

/// Beginnings of the titles of steps before the build.
const PREPARING: [&str; 4] =
    ["receiving", "looking at what was pushed", "reading the package lists", "preparing the build"];

impl TimedPush {
    /// Returns the final event.
    pub fn done_event(&self) -> Result<&Value> {
        let done = self.events.iter().map(|(_, event)| event).find(|event| event["type"] == "done");
        done.context("a push that succeeded ends with done")
    }

    /// Returns the names of the layers that were built rather than taken from the cache.
    pub fn built_layers(&self) -> Result<Vec<String>> {
        let layers = self.done_event()?["layers"].as_array().context("done names the layers")?;
        ensure!(!layers.is_empty(), "an image has layers");
        let made = layers.iter().filter(|layer| layer["cached"] != true);
        Ok(made.map(|layer| layer["name"].as_str().unwrap_or_default().to_owned()).collect())
    }

    /// Returns the time until the first step of the build, in which the daemon receives and opens what it needs.
    pub fn time_to_first_step(&self) -> Duration {
        let prepares = |event: &Value| {
            let title = event["title"].as_str().unwrap_or_default();
            PREPARING.iter().any(|beginning| title.starts_with(beginning))
        };
        let first = self.events.iter().find(|(_, event)| event["type"] == "step" && !prepares(event));
        first.map_or(Duration::ZERO, |(time, _)| *time)
    }

    /// Returns the total time of the steps whose titles start with `title`; a step lasts until the next one.
    pub fn step_duration(&self, title: &str) -> Option<Duration> {
        let ends = |event: &Value| event["type"] == "step" || event["type"] == "done";
        let marks: Vec<_> = self.events.iter().filter(|(_, event)| ends(event)).collect();
        let is_named = |event: &Value| event["title"].as_str().is_some_and(|found| found.starts_with(title));
        let spans = marks.windows(2).filter(|pair| is_named(&pair[0].1)).map(|pair| pair[1].0 - pair[0].0);
        spans.reduce(|sum, span| sum + span)
    }
}
