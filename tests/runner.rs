//! Runs the stories: many at a time, the longest first, those that need the whole machine last. A story that fails is
//! repeated once at the end, on its own.
//!
//! ```text
//!   check the machine ─▶ clean up after killed runs ─▶ mount a disk ─▶ run ─▶ run alone ─▶ repeat failed ─▶ report
//! ```
//!
//! Test harnesses of libraries do not support this: stories share a daemon, so they are threads of one process, and how
//! many of them run at a time depends on what they do.

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
use support::story::{self, StoryRun};
use support::world::world;
use support::{Verdict, binaries, claim, evidence};

use record::StoryTimes;
use report::RunReport;
use watchdog::Watchdog;

/// Concurrent stories per core; stories mostly wait. Those that compile also wait for a core (`support::cores`).
const AT_A_TIME: usize = 4;
/// If more stories than this fail and then pass, the run fails, because that is not an accident of the machine.
const MOST_FLAKY: usize = 2;
/// If more stories than this fail, they are not repeated, because the run has failed anyway.
const MOST_TOLD_AGAIN: usize = 6;
/// Seed of the random cases in stories, so that a failure can be reproduced.
const SEED: &str = "PROPTEST_RNG_SEED";

/// A story with the name of its function.
pub struct RunnableStory {
    /// Module and function, such as `tls::a_robot_works_through_tls`.
    pub name: &'static str,
    /// Function that runs the story.
    pub tell: Box<dyn Fn() -> Verdict + Send + Sync>,
}

/// Run the stories of Cloudroid
#[derive(Debug, Parser)]
#[command(name = "stories")]
struct StoryArguments {
    /// Run only stories whose names contain one of these
    names: Vec<String>,
    /// Match whole names
    #[arg(long)]
    exact: bool,
    /// List the stories and exit
    #[arg(long)]
    list: bool,
    /// Number of concurrent stories (default: four per core)
    #[arg(long, value_name = "NUMBER")]
    test_threads: Option<NonZero<usize>>,
}

impl StoryArguments {
    fn is_selected(&self, story: &str) -> bool {
        let is_named = |name: &String| {
            if self.exact { story == name } else { story.contains(name) }
        };
        self.names.is_empty() || self.names.iter().any(is_named)
    }
}

/// Result of one run of a story.
struct StoryOutcome {
    name: &'static str,
    took: Duration,
    /// Time spent waiting for cores that other stories used.
    waited: Duration,
    failure: Option<String>,
}

/// Runs those of `stories` that the arguments select; `alone` lists stories that compare durations with each other and
/// therefore run on their own. A story that takes longer than `limit` ends the run with a failure.
pub fn run(stories: Vec<RunnableStory>, alone: &[&str], limit: Duration) -> ExitCode {
    let arguments = StoryArguments::parse();
    let stories: Vec<RunnableStory> = stories.into_iter().filter(|story| arguments.is_selected(story.name)).collect();
    if arguments.list {
        for story in &stories {
            println!("{}: test", story.name);
        }
        return ExitCode::SUCCESS;
    }
    if stories.is_empty() {
        eprintln!("no story is called {}; --list lists them", arguments.names.join(" or "));
        return ExitCode::FAILURE;
    }
    if let Err(lack) = machine::prepare(stories.len()) {
        eprintln!("the stories cannot be told here: {lack}");
        support::world::end();
        return ExitCode::FAILURE;
    }
    let record = StoryTimes::read();
    let is_strict = std::env::var("STRICT").is_ok_and(|strict| !strict.is_empty() && strict != "0");
    let runner = StoryRunner { is_strict, outcomes: Mutex::default(), watchdog: Watchdog::start(limit) };
    let cores = std::thread::available_parallelism().map_or(1, NonZero::get);
    let at_a_time = arguments.test_threads.map_or(AT_A_TIME * cores, NonZero::get);
    let (last, mut first): (Vec<&RunnableStory>, Vec<&RunnableStory>) =
        stories.iter().partition(|story| alone.contains(&story.name));
    first.sort_by_key(|story| std::cmp::Reverse(record.expected_time(story.name)));
    println!("telling {} stories, {at_a_time} at a time", stories.len());
    runner.run_all(first, at_a_time);
    runner.run_all(last, 1);
    let again = runner.repeat_failed(&stories);
    let told = runner.outcomes.into_inner().unwrap_or_else(PoisonError::into_inner);
    record.update(&told);
    let left = support::world::end();
    let report = RunReport::new(&stories, told, again, left, is_strict);
    report.print();
    if report.is_good() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

struct StoryRunner {
    is_strict: bool,
    outcomes: Mutex<Vec<StoryOutcome>>,
    watchdog: Watchdog,
}

impl StoryRunner {
    fn run_all(&self, stories: Vec<&RunnableStory>, at_a_time: usize) {
        let pending = Mutex::new(VecDeque::from(stories));
        std::thread::scope(|scope| {
            for _ in 0..at_a_time {
                scope.spawn(|| {
                    while let Some(story) = self.next_story(&pending) {
                        let outcome = self.run_story(story, 1);
                        self.outcomes().push(outcome);
                    }
                });
            }
        });
    }

    /// Returns the next story, unless the run has failed already.
    fn next_story<'a>(&self, pending: &Mutex<VecDeque<&'a RunnableStory>>) -> Option<&'a RunnableStory> {
        if self.is_strict && self.failure_count() > 0 {
            return None;
        }
        pending.lock().unwrap_or_else(PoisonError::into_inner).pop_front()
    }

    /// Repeats the failed stories, one at a time.
    fn repeat_failed(&self, stories: &[RunnableStory]) -> Vec<StoryOutcome> {
        let failed: Vec<&'static str> =
            self.outcomes().iter().filter(|outcome| outcome.failure.is_some()).map(|outcome| outcome.name).collect();
        if self.is_strict || failed.len() > MOST_TOLD_AGAIN {
            return Vec::new();
        }
        stories.iter().filter(|story| failed.contains(&story.name)).map(|story| self.run_story(story, 2)).collect()
    }

    fn run_story(&self, story: &RunnableStory, attempt: usize) -> StoryOutcome {
        self.watchdog.begin(story.name);
        let outcome = run_once(story, attempt);
        self.watchdog.end(story.name);
        outcome
    }

    fn failure_count(&self) -> usize {
        let outcomes = self.outcomes();
        outcomes.iter().filter(|outcome| outcome.failure.is_some()).count()
    }

    fn outcomes(&self) -> std::sync::MutexGuard<'_, Vec<StoryOutcome>> {
        self.outcomes.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Returns the directory for the evidence of a failed run of a story.
fn evidence_directory(story: &str, attempt: usize) -> std::path::PathBuf {
    let place = binaries::target().join("stories").join(story.replace("::", "/"));
    if attempt == 1 { place } else { place.join("again") }
}

/// Runs one story on a thread of its own, and keeps its files if it fails.
fn run_once(story: &RunnableStory, attempt: usize) -> StoryOutcome {
    let place = evidence_directory(story.name, attempt);
    let _ = std::fs::remove_dir_all(&place);
    let telling = StoryRun::new(story.name, attempt, place);
    let began = Instant::now();
    let failure = std::thread::scope(|scope| {
        let teller = std::thread::Builder::new().name(story.name.to_owned()).spawn_scoped(scope, || {
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
        // A killed daemon leaves servants behind, and the second run should not find anything of the first.
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
    println!("test {} ... {verdict} ({:.1} s)", story.name, took.as_secs_f64());
    StoryOutcome { name: story.name, took, waited: telling.waiting_time(), failure }
}

fn describe_panic(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str);
    let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
    format!("panicked: {}", text.unwrap_or("without words"))
}
