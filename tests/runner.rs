//! Tells stories: many at a time, the longest first, those that need the machine alone last. One that fails is told once more, alone, at the end.
//!
//! ```text
//!   check the machine ─▶ remove what killed runs left ─▶ mount a disk ─▶ tell ─▶ tell alone ─▶ tell again ─▶ report
//! ```
//!
//! No test harness of a library does this: stories share a daemon, so they are threads of one process, and how many of them run depends on what
//! they do.

mod machine;
mod record;
mod report;
mod watchdog;

use std::collections::VecDeque;
use std::num::NonZero;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use clap::Parser;
use support::story::{self, Telling};
use support::world::world;
use support::{Verdict, binaries, claim, evidence};

use record::Record;
use report::Report;
use watchdog::Watchdog;

/// Stories told at a time for each core: most of a story is waiting. What compiles waits for a core besides (`support::cores`).
const AT_A_TIME: usize = 4;
/// More stories than this that fail and then pass fail the run: that is no accident of the machine.
const MOST_FLAKY: usize = 2;
/// Where more than this many fail, the run is lost, and telling them again would only take time.
const MOST_TOLD_AGAIN: usize = 6;
/// The cases of what is random in a story, so that a failure can be repeated.
const SEED: &str = "PROPTEST_RNG_SEED";

/// A story under its function's name.
pub struct Story {
    /// Its module and function, such as `tls::a_robot_works_through_tls`.
    pub name: &'static str,
    /// Tells it.
    pub tell: Box<dyn Fn() -> Verdict + Send + Sync>,
}

/// Tells the stories of Cloudroid.
#[derive(Debug, Parser)]
#[command(name = "stories")]
struct Arguments {
    /// Tell only stories whose names contain one of these.
    names: Vec<String>,
    /// Take the names as whole names.
    #[arg(long)]
    exact: bool,
    /// List the stories and end.
    #[arg(long)]
    list: bool,
    /// How many to tell at a time (default: four for each core).
    #[arg(long, value_name = "NUMBER")]
    test_threads: Option<NonZero<usize>>,
}

impl Arguments {
    fn wants(&self, story: &str) -> bool {
        let is_named = |name: &String| {
            if self.exact {
                story == name
            } else {
                story.contains(name)
            }
        };
        self.names.is_empty() || self.names.iter().any(is_named)
    }
}

/// One telling's end.
struct Outcome {
    name: &'static str,
    took: Duration,
    /// For a core that others' work took up.
    waited: Duration,
    failure: Option<String>,
}

/// Tells those of `stories` that the arguments name; `alone` lists those that compare times with each other, which are told while no other is. A
/// story that takes longer than `limit` ends the run with a failure.
pub fn run(stories: Vec<Story>, alone: &[&str], limit: Duration) -> ExitCode {
    let arguments = Arguments::parse();
    let stories: Vec<Story> = stories
        .into_iter()
        .filter(|story| arguments.wants(story.name))
        .collect();
    if arguments.list {
        for story in &stories {
            println!("{}: test", story.name);
        }
        return ExitCode::SUCCESS;
    }
    if stories.is_empty() {
        eprintln!(
            "no story is called {}; --list lists them",
            arguments.names.join(" or ")
        );
        return ExitCode::FAILURE;
    }
    if let Err(lack) = machine::prepare() {
        eprintln!("the stories cannot be told here: {lack}");
        support::world::end();
        return ExitCode::FAILURE;
    }
    let record = Record::read();
    let is_strict = std::env::var("STRICT").is_ok_and(|strict| !strict.is_empty() && strict != "0");
    let runner = Runner {
        is_strict,
        outcomes: Mutex::default(),
        watchdog: Watchdog::start(limit),
    };
    let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    let at_a_time = arguments
        .test_threads
        .map_or(AT_A_TIME * cores, NonZero::get);
    let (last, mut first): (Vec<&Story>, Vec<&Story>) = stories
        .iter()
        .partition(|story| alone.contains(&story.name));
    first.sort_by_key(|story| std::cmp::Reverse(record.expected(story.name)));
    println!("telling {} stories, {at_a_time} at a time", stories.len());
    runner.tell_all(first, at_a_time);
    runner.tell_all(last, 1);
    let again = runner.tell_again(&stories);
    let told = runner
        .outcomes
        .into_inner()
        .unwrap_or_else(PoisonError::into_inner);
    record.write(&told);
    let left = support::world::end();
    let report = Report::new(&stories, told, again, left, is_strict);
    report.print();
    if report.is_good() {
        ExitCode::SUCCESS
    } else {
        ExitCode::FAILURE
    }
}

struct Runner {
    is_strict: bool,
    outcomes: Mutex<Vec<Outcome>>,
    watchdog: Watchdog,
}

impl Runner {
    fn tell_all(&self, stories: Vec<&Story>, at_a_time: usize) {
        let pending = Mutex::new(VecDeque::from(stories));
        std::thread::scope(|scope| {
            for _ in 0..at_a_time {
                scope.spawn(|| {
                    while let Some(story) = self.next(&pending) {
                        let outcome = self.tell(story, 1);
                        self.outcomes().push(outcome);
                    }
                });
            }
        });
    }

    /// The next story, if there is a reason to tell one.
    fn next<'a>(&self, pending: &Mutex<VecDeque<&'a Story>>) -> Option<&'a Story> {
        if self.is_strict && self.failed() > 0 {
            return None;
        }
        pending
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .pop_front()
    }

    /// Tells what failed once more, one story at a time.
    fn tell_again(&self, stories: &[Story]) -> Vec<Outcome> {
        let failed: Vec<&'static str> = self
            .outcomes()
            .iter()
            .filter(|outcome| outcome.failure.is_some())
            .map(|outcome| outcome.name)
            .collect();
        if self.is_strict || failed.len() > MOST_TOLD_AGAIN {
            return Vec::new();
        }
        stories
            .iter()
            .filter(|story| failed.contains(&story.name))
            .map(|story| self.tell(story, 2))
            .collect()
    }

    fn tell(&self, story: &Story, attempt: usize) -> Outcome {
        self.watchdog.begin(story.name);
        let outcome = tell(story, attempt);
        self.watchdog.end(story.name);
        outcome
    }

    fn failed(&self) -> usize {
        let outcomes = self.outcomes();
        outcomes
            .iter()
            .filter(|outcome| outcome.failure.is_some())
            .count()
    }

    fn outcomes(&self) -> std::sync::MutexGuard<'_, Vec<Outcome>> {
        self.outcomes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Where what a failed telling leaves is kept.
fn evidence_of(story: &str, attempt: usize) -> std::path::PathBuf {
    let place = binaries::target()
        .join("stories")
        .join(story.replace("::", "/"));
    if attempt == 1 {
        place
    } else {
        place.join("again")
    }
}

/// Tells one story in a thread of its own, and keeps what it made where it fails.
fn tell(story: &Story, attempt: usize) -> Outcome {
    let place = evidence_of(story.name, attempt);
    let _ = std::fs::remove_dir_all(&place);
    let telling = Telling::new(story.name, attempt, place);
    let began = Instant::now();
    let failure = std::thread::scope(|scope| {
        let teller = std::thread::Builder::new()
            .name(story.name.to_owned())
            .spawn_scoped(scope, || {
                story::begin(telling.clone());
                catch_unwind(AssertUnwindSafe(|| (story.tell)()))
            });
        match teller.map(|teller| teller.join()) {
            Ok(Ok(Ok(verdict))) => verdict.err().map(|error| format!("{error:#}")),
            Ok(Ok(Err(panic)) | Err(panic)) => Some(describe_panic(&*panic)),
            Err(error) => Some(format!("no thread: {error}")),
        }
    });
    let took = began.elapsed();
    if let Some(reason) = &failure {
        let seed = std::env::var(SEED).unwrap_or_else(|_| "none".to_owned());
        let shared = world().shared_daemon();
        if let Err(error) = evidence::keep(&telling, reason, &seed, shared.as_deref()) {
            eprintln!("nothing is kept of {}: {error}", story.name);
        }
        // A daemon that was killed leaves servants, and the second telling is to find nothing of the first.
        for home in telling.homes() {
            if let Err(error) = claim::end_users(&home) {
                eprintln!("{}: {error:#}", story.name);
            }
        }
    }
    for directory in telling.directories() {
        let _ = std::fs::remove_dir_all(directory);
    }
    let verdict = if failure.is_some() { "FAILED" } else { "ok" };
    println!(
        "test {} ... {verdict} ({:.1} s)",
        story.name,
        took.as_secs_f64()
    );
    Outcome {
        name: story.name,
        took,
        waited: telling.waited(),
        failure,
    }
}

fn describe_panic(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    format!("panicked: {}", text.unwrap_or("without words"))
}
