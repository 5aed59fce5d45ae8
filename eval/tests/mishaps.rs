//! What can go wrong with an evaluation: each is named, costs nothing else, and leaves nothing for long. Needs root, as places do.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Mutex;

use eval::place::{Class, Network, Place};
use eval::rehearsal;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// Whoever begins takes away what is left of others: one after the other.
static ONE: Mutex<()> = Mutex::new(());
/// Longer than any test waits.
const LONG: f64 = 600.0;

/// An evaluation of nothing, with a target of its own.
struct Evaluation {
    child: Child,
    said: BufReader<std::process::ChildStderr>,
    heard: String,
}

impl Evaluation {
    fn begins(target: &Path, temporary: &Path, seconds: f64) -> Self {
        Self::of(
            Command::new(env!("CARGO_BIN_EXE_eval")),
            target,
            temporary,
            seconds,
        )
    }

    fn of(mut command: Command, target: &Path, temporary: &Path, seconds: f64) -> Self {
        let mut child = command
            .arg("--target")
            .arg(target)
            .args(["rehearse", &seconds.to_string()])
            .env("TMPDIR", temporary)
            .env("CLOUDROID_BIN", binaries())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .expect("the evaluation");
        let said = BufReader::new(child.stderr.take().expect("it is piped"));
        let heard = String::new();
        Self { child, said, heard }
    }

    /// Waits until it says these words.
    fn says(&mut self, words: &str) {
        while !self.heard.contains(words) {
            let read = self.said.read_line(&mut self.heard).expect("what it says");
            assert!(read > 0, "{words:?} was not said: {}", self.heard);
        }
    }

    fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id() as i32);
        kill(pid, signal).expect("it is there");
    }

    /// Its status, and all that it said.
    fn ends(mut self) -> (ExitStatus, String) {
        self.said
            .read_to_string(&mut self.heard)
            .expect("what it says");
        (self.child.wait().expect("its end"), self.heard)
    }

    /// Places that it has made and that are there.
    fn places(pid: u32) -> Vec<String> {
        let prefix = format!("cloudroid-cable-{pid}-");
        let mut found = support::leftovers::cgroups(std::slice::from_ref(&prefix))
            .iter()
            .map(|path| path.display().to_string())
            .collect::<Vec<_>>();
        for entry in std::fs::read_dir("/run/netns")
            .into_iter()
            .flatten()
            .flatten()
        {
            let name = entry.file_name().to_string_lossy().into_owned();
            found.extend(name.starts_with(&prefix).then_some(name));
        }
        found
    }
}

/// Where the daemon is: beside the evaluation, as cargo builds them.
/// Where the programs are that are built for all tests, the robot's among them.
fn binaries() -> PathBuf {
    let beside = Path::new(env!("CARGO_BIN_EXE_eval")).parent();
    std::env::var_os("CLOUDROID_BIN")
        .map_or_else(|| beside.expect("a directory").to_owned(), PathBuf::from)
}

fn directories() -> (tempfile::TempDir, PathBuf, PathBuf) {
    let place = tempfile::tempdir().expect("a directory");
    let [target, temporary] = ["target", "tmp"].map(|name| place.path().join(name));
    std::fs::create_dir(&temporary).expect("a directory");
    (place, target, temporary)
}

fn report(target: &Path) -> String {
    std::fs::read_to_string(target.join("report.html")).expect("a report")
}

fn one_at_a_time() -> std::sync::MutexGuard<'static, ()> {
    ONE.lock()
        .unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[test]
fn asked_to_end_it_reports_what_it_has_and_goes_on_later() {
    let _one = one_at_a_time();
    let (_place, target, temporary) = directories();
    for signal in [Signal::SIGINT, Signal::SIGTERM] {
        let mut evaluation = Evaluation::begins(&target, &temporary, LONG);
        let pid = evaluation.child.id();
        evaluation.says("rehearsal robot\n");
        waits_for(|| robot_of(pid));
        assert!(!Evaluation::places(pid).is_empty());
        evaluation.signal(signal);
        let (status, said) = evaluation.ends();
        assert_eq!(status.code(), Some(1), "{said}");
        let report = report(&target);
        assert!(report.contains("made"), "{report}");
        assert!(report.contains("asked to end"), "{report}");
        assert_eq!(Evaluation::places(pid), Vec::<String>::new());
        let left = std::fs::read_dir(&temporary).expect("a directory").count();
        assert_eq!(left, 0, "{said}");
    }
    // What was half written counts as not measured.
    std::fs::write(target.join("cells/rehearsal-robot.json"), "{\"of\": [").expect("ours");
    let (status, said) = Evaluation::begins(&target, &temporary, 0.0).ends();
    assert!(status.success(), "{said}");
    assert!(said.contains("rehearsal place: measured before"), "{said}");
    let report = report(&target);
    assert!(report.contains("the node has ended"), "{report}");
    assert!(!report.contains("asked to end"), "{report}");
}

#[test]
fn what_a_killed_evaluation_leaves_the_next_takes_away() {
    let _one = one_at_a_time();
    let (_place, target, temporary) = directories();
    for with_daemon in [false, true] {
        let mut evaluation = Evaluation::begins(&target, &temporary, LONG);
        let pid = evaluation.child.id();
        evaluation.says("rehearsal robot\n");
        // The place, once the robot is in it.
        let robot = waits_for(|| robot_of(pid));
        let daemon = daemon_below(&temporary).expect("its daemon");
        evaluation.signal(Signal::SIGKILL);
        let (status, _) = evaluation.ends();
        assert_eq!(status.signal(), Some(9));
        if with_daemon {
            kill(Pid::from_raw(daemon), Signal::SIGKILL).expect("it is there");
        }
        assert!(!Evaluation::places(pid).is_empty());
        let (status, said) = Evaluation::begins(&target, &temporary, 0.0).ends();
        assert!(status.success(), "{said}");
        assert!(said.contains("taken away"), "{said}");
        assert_eq!(Evaluation::places(pid), Vec::<String>::new(), "{said}");
        assert!(support::procfs::command_line(robot).is_none_or(|line| line.is_empty()));
        assert_eq!(daemon_below(&temporary), None);
        let left = std::fs::read_dir(&temporary).expect("a directory").count();
        assert_eq!(left, 0, "{said}");
        std::fs::remove_file(target.join("cells/rehearsal-robot.json")).expect("it is measured");
    }
}

#[test]
fn a_robot_or_a_node_that_is_killed_is_named_and_others_go_on() {
    let _one = one_at_a_time();
    let place = Place::new("127.0.0.1:9", Class::PI, Network::Lan);
    let mut place = place.expect("a place");
    place.program = env!("CARGO_BIN_EXE_eval").into();
    let directory = tempfile::tempdir().expect("a directory");
    let plan = rehearsal::plan(directory.path(), LONG).expect("a plan");
    let kills = |who: fn(u32) -> Option<i32>| {
        std::thread::scope(|scope| {
            let run = scope.spawn(|| place.runs(&plan, directory.path()));
            let pid = waits_for(|| who(std::process::id()));
            kill(Pid::from_raw(pid), Signal::SIGKILL).expect("it is there");
            run.join().expect("it does not panic")
        })
    };
    let killed = kills(robot_of).expect_err("the robot was killed");
    assert!(killed.to_string().contains("signal 9"), "{killed:#}");
    let (trace, _) = kills(node_of).expect("the robot goes on");
    let ended = trace.node_ended.expect("the node was killed");
    assert!(ended.contains("the node has ended"), "{ended}");
}

#[test]
fn without_control_groups_a_place_says_so() {
    let _one = one_at_a_time();
    let (_place, target, temporary) = directories();
    // As in a container that has none of its own; for this process alone.
    let mut command = Command::new("unshare");
    let script = "mount -t tmpfs -o ro none /sys/fs/cgroup && exec \"$0\" \"$@\"";
    command.args(["--mount", "sh", "-c", script, env!("CARGO_BIN_EXE_eval")]);
    let (status, said) = Evaluation::of(command, &target, &temporary, 0.0).ends();
    assert_eq!(status.code(), Some(1), "{said}");
    let report = report(&target);
    assert!(report.contains("control groups"), "{report}");
    assert!(report.contains("Next step"), "{report}");
}

#[test]
fn recordings_that_are_not_there_are_named() {
    let _one = one_at_a_time();
    let (_place, target, temporary) = directories();
    let mut command = Command::new("unshare");
    // Hidden from this process alone; on a fresh machine the first was never there.
    let script = "for place in /usr/share/mrpt /usr/share/doc; do \
                      if [ -d $place ]; then mount -t tmpfs none $place || exit; fi; \
                  done; exec \"$0\" --quick --only 3,7 --target \"$2\"";
    command.args(["--mount", "sh", "-c", script, env!("CARGO_BIN_EXE_eval")]);
    let (status, said) = Evaluation::of(command, &target, &temporary, 0.0).ends();
    assert_eq!(status.code(), Some(1), "{said}");
    let report = report(&target);
    for package in ["mrpt-common", "opencv-doc"] {
        let words = format!("is missing; it comes with Debian&#39;s {package}");
        assert!(report.contains(&words), "{words}: {said}");
    }
}

/// The child of a process that runs a robot, once it is one.
fn robot_of(pid: u32) -> Option<i32> {
    children(pid as i32).into_iter().find(|child| {
        let line = support::procfs::command_line(*child).unwrap_or_default();
        line.contains(" robot ") && !line.starts_with("nsenter")
    })
}

fn node_of(pid: u32) -> Option<i32> {
    children(robot_of(pid)?).into_iter().find(|child| {
        let line = support::procfs::command_line(*child).unwrap_or_default();
        line.starts_with("sleep ")
    })
}

fn children(pid: i32) -> Vec<i32> {
    let of = |child: &i32| {
        let status = support::procfs::status(*child)?;
        Some(status.get("PPid")?.parse() == Ok(pid))
    };
    let all = support::procfs::pids().into_iter();
    all.filter(|child| of(child) == Some(true)).collect()
}

fn daemon_below(temporary: &Path) -> Option<i32> {
    let home = format!("cloudroidd --home {}", temporary.display());
    let is =
        |pid: &i32| support::procfs::command_line(*pid).is_some_and(|line| line.contains(&home));
    support::procfs::pids().into_iter().find(is)
}

fn waits_for<T>(mut find: impl FnMut() -> Option<T>) -> T {
    support::until("it", || Ok(find().ok_or_else(String::new))).expect("it comes about")
}
