//! The report at the end of a run, and its result.

use std::io::Write;
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::json;
use support::{binaries, patience};

use super::{MOST_FLAKY, RunnableStory, StoryOutcome, evidence_directory};

/// Number of longest stories to print, as candidates for faster tests.
const LONGEST: usize = 20;
/// Maximum number of characters printed of an error.
const REASON: usize = 2000;

/// Maximum number of characters of each end of a reason in the line about a flaky story.
const LINE: usize = 300;

/// Result of a run.
pub(super) struct RunReport {
    told: Vec<StoryOutcome>,
    not_told: usize,
    /// Stories that failed and then passed, with the first error.
    flaky: Vec<(&'static str, String)>,
    /// Stories that failed twice, with the last error.
    failed: Vec<(&'static str, String)>,
    left: Vec<String>,
    is_strict: bool,
}

impl RunReport {
    pub(super) fn new(
        stories: &[RunnableStory],
        told: Vec<StoryOutcome>,
        again: Vec<StoryOutcome>,
        left: Vec<String>,
        is_strict: bool,
    ) -> RunReport {
        let mut report = RunReport {
            not_told: stories.len() - told.len(),
            flaky: Vec::new(),
            failed: Vec::new(),
            told: Vec::new(),
            left,
            is_strict,
        };
        for outcome in &told {
            let Some(reason) = &outcome.failure else {
                continue;
            };
            let second = again.iter().find(|second| second.name == outcome.name);
            match second.map(|second| &second.failure) {
                Some(None) => report.flaky.push((outcome.name, reason.clone())),
                Some(Some(reason)) => report.failed.push((outcome.name, reason.clone())),
                None => report.failed.push((outcome.name, reason.clone())),
            }
        }
        report.told = told;
        report
    }

    /// Returns whether the run succeeded.
    pub(super) fn is_good(&self) -> bool {
        self.failed.is_empty()
            && self.left.is_empty()
            && self.not_told == 0
            && self.flaky.len() <= MOST_FLAKY
            && (!self.is_strict || self.flaky.is_empty())
    }

    /// Prints the report, most important part last, because that is what remains visible of a long log.
    pub(super) fn print(&self) {
        let mut longest: Vec<&StoryOutcome> = self.told.iter().collect();
        longest.sort_by_key(|outcome| std::cmp::Reverse(outcome.took));
        println!("== the longest stories, in seconds, and how long of that they waited for a core");
        for outcome in longest.iter().take(LONGEST) {
            println!("{:8.1} {:7.1}  {}", outcome.took.as_secs_f64(), outcome.waited.as_secs_f64(), outcome.name);
        }
        let all: Duration = self.told.iter().map(|outcome| outcome.took).sum();
        println!(
            "== {:.0} s of stories in all; the machine was {:.1} times as slow as it can be, at most",
            all.as_secs_f64(),
            patience::busiest()
        );
        for (name, reason) in &self.flaky {
            println!("FLAKY {name}: {}", shorten_to_line(reason));
            println!("      kept below {}", evidence_directory(name, 1).display());
            note_flaky(name, reason);
        }
        if self.flaky.len() > MOST_FLAKY {
            println!("more than {MOST_FLAKY} stories failed and then passed: the run has failed");
        }
        for (name, reason) in &self.failed {
            println!("== failed: {name}\n{}\nkept below {}", shorten(reason), evidence_directory(name, 1).display());
        }
        for thing in &self.left {
            println!("left behind: {thing}");
        }
        if self.not_told > 0 {
            println!("{} stories were not told after the first failure", self.not_told);
        }
        println!("{} passed, {} failed", self.told.len() - self.failed.len(), self.failed.len());
    }
}

/// Returns the begin and the end of a reason in one line: it begins with what was done, and ends with what a program
/// said.
fn shorten_to_line(reason: &str) -> String {
    let words = reason.split_whitespace().collect::<Vec<&str>>().join(" ");
    let length = words.chars().count();
    if length <= 2 * LINE {
        return words;
    }
    let begin: String = words.chars().take(LINE).collect();
    let end: String = words.chars().skip(length - LINE).collect();
    format!("{begin} […] {end}")
}

fn shorten(reason: &str) -> String {
    reason.chars().take(REASON).collect()
}

/// Adds a line to the list of flaky stories that need to be fixed.
fn note_flaky(name: &str, reason: &str) {
    let time = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let line = json!({"time": time, "story": name, "reason": shorten(reason)});
    let path = binaries::target().join("flaky.json");
    let file = std::fs::File::options().create(true).append(true).open(path);
    if let Err(error) = file.and_then(|mut file| writeln!(file, "{line}")) {
        eprintln!("target/flaky.json: {error}");
    }
}
