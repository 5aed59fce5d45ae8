//! Failures of an evaluation: each is reported, affects nothing else, and leaves nothing behind for long. Needs root,
//! as sandboxes do.

use std::io::{BufRead, BufReader, Read};
use std::os::unix::process::ExitStatusExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Mutex;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// Serializes the tests, because each evaluation removes the leftovers of others when it starts.
static ONE: Mutex<()> = Mutex::new(());
/// Longer than any test waits, in seconds.
const LONG: f64 = 600.0;

/// A running evaluation without experiments, with a target directory of its own.
struct RehearsedEvaluation {
    child: Child,
    said: BufReader<std::process::ChildStderr>,
    heard: String,
}

impl RehearsedEvaluation {
    fn start(target: &Path, temporary: &Path, seconds: f64) -> Self {
        Self::spawn(Command::new(env!("CARGO_BIN_EXE_eval")), target, temporary, seconds)
    }

    fn spawn(mut command: Command, target: &Path, temporary: &Path, seconds: f64) -> Self {
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

    /// Waits until the output contains `words`.
    fn wait_for_output(&mut self, words: &str) {
        while !self.heard.contains(words) {
            let read = self.said.read_line(&mut self.heard).expect("what it says");
            assert!(read > 0, "{words:?} was not said: {}", self.heard);
        }
    }

    fn signal(&self, signal: Signal) {
        let pid = Pid::from_raw(self.child.id() as i32);
        kill(pid, signal).expect("it is there");
    }

    /// Waits for its end; returns its status and all output.
    fn wait(mut self) -> (ExitStatus, String) {
        self.said.read_to_string(&mut self.heard).expect("what it says");
        (self.child.wait().expect("its end"), self.heard)
    }

    /// Returns the sandboxes that it has created and that exist.
    fn sandboxes_of(pid: u32) -> Vec<String> {
        let prefix = format!("cloudroid-cable-{pid}-");
        let mut found = support::leftovers::cgroups(std::slice::from_ref(&prefix))
            .iter()
            .map(|path| path.display().to_string())
            .collect::<Vec<_>>();
        for entry in std::fs::read_dir("/run/netns").into_iter().flatten().flatten() {
            let name = entry.file_name().to_string_lossy().into_owned();
            found.extend(name.starts_with(&prefix).then_some(name));
        }
        found
    }
}

/// Returns the directory of the daemon and the other programs: `CLOUDROID_BIN`, or the directory of the evaluation,
/// into which cargo builds them.
fn binaries() -> PathBuf {
    let beside = Path::new(env!("CARGO_BIN_EXE_eval")).parent();
    std::env::var_os("CLOUDROID_BIN").map_or_else(|| beside.expect("a directory").to_owned(), PathBuf::from)
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

fn serialize_tests() -> std::sync::MutexGuard<'static, ()> {
    ONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

#[test]
fn asked_to_end_it_reports_what_it_has_and_goes_on_later() {
    let _one = serialize_tests();
    let (_place, target, temporary) = directories();
    for signal in [Signal::SIGINT, Signal::SIGTERM] {
        let mut evaluation = RehearsedEvaluation::start(&target, &temporary, LONG);
        let pid = evaluation.child.id();
        evaluation.wait_for_output("rehearsal robot\n");
        wait_until_found(|| find_robot(pid));
        assert!(!RehearsedEvaluation::sandboxes_of(pid).is_empty());
        evaluation.signal(signal);
        let (status, said) = evaluation.wait();
        assert_eq!(status.code(), Some(1), "{said}");
        let report = report(&target);
        assert!(report.contains("made"), "{report}");
        assert!(report.contains("asked to end"), "{report}");
        assert_eq!(RehearsedEvaluation::sandboxes_of(pid), Vec::<String>::new());
        let left = std::fs::read_dir(&temporary).expect("a directory").count();
        assert_eq!(left, 0, "{said}");
    }
    // A partially written file counts as not measured.
    std::fs::write(target.join("cells/rehearsal-robot.json"), "{\"of\": [").expect("ours");
    let (status, said) = RehearsedEvaluation::start(&target, &temporary, 0.0).wait();
    assert!(status.success(), "{said}");
    assert!(said.contains("rehearsal place: measured before"), "{said}");
    let report = report(&target);
    assert!(report.contains("the node has ended"), "{report}");
    assert!(!report.contains("asked to end"), "{report}");
}

#[test]
fn what_a_killed_evaluation_leaves_the_next_takes_away() {
    let _one = serialize_tests();
    let (_place, target, temporary) = directories();
    for with_daemon in [false, true] {
        let mut evaluation = RehearsedEvaluation::start(&target, &temporary, LONG);
        let pid = evaluation.child.id();
        evaluation.wait_for_output("rehearsal robot\n");
        // The sandbox, once the robot runs in it.
        let robot = wait_until_found(|| find_robot(pid));
        let daemon = find_daemon(&temporary).expect("its daemon");
        evaluation.signal(Signal::SIGKILL);
        let (status, _) = evaluation.wait();
        assert_eq!(status.signal(), Some(9));
        if with_daemon {
            kill(Pid::from_raw(daemon), Signal::SIGKILL).expect("it is there");
        }
        assert!(!RehearsedEvaluation::sandboxes_of(pid).is_empty());
        let (status, said) = RehearsedEvaluation::start(&target, &temporary, 0.0).wait();
        assert!(status.success(), "{said}");
        assert!(said.contains("taken away"), "{said}");
        assert_eq!(RehearsedEvaluation::sandboxes_of(pid), Vec::<String>::new(), "{said}");
        assert!(support::procfs::command_line(robot).is_none_or(|line| line.is_empty()));
        assert_eq!(find_daemon(&temporary), None);
        let left = std::fs::read_dir(&temporary).expect("a directory").count();
        assert_eq!(left, 0, "{said}");
        std::fs::remove_file(target.join("cells/rehearsal-robot.json")).expect("it is measured");
    }
}

#[test]
fn a_robot_or_a_node_that_is_killed_is_named_and_others_go_on() {
    let _one = serialize_tests();
    let (_place, target, temporary) = directories();
    let kill_and_report = |who: fn(u32) -> Option<i32>| {
        let mut evaluation = RehearsedEvaluation::start(&target, &temporary, LONG);
        let pid = evaluation.child.id();
        evaluation.wait_for_output("rehearsal robot\n");
        let victim = wait_until_found(|| who(pid));
        kill(Pid::from_raw(victim), Signal::SIGKILL).expect("it is there");
        let (status, _) = evaluation.wait();
        (status.code(), report(&target))
    };
    let (status, report) = kill_and_report(find_robot);
    assert!(status == Some(1) && report.contains("signal 9"), "{report}");
    // The robot goes on.
    let (status, report) = kill_and_report(find_node);
    assert!(status == Some(0) && report.contains("the node has ended"), "{report}");
}

#[test]
fn without_control_groups_a_place_says_so() {
    let _one = serialize_tests();
    let (_place, target, temporary) = directories();
    // As in a container that has no cgroups of its own; for this process only.
    let mut command = Command::new("unshare");
    let script = "mount -t tmpfs -o ro none /sys/fs/cgroup && exec \"$0\" \"$@\"";
    command.args(["--mount", "sh", "-c", script, env!("CARGO_BIN_EXE_eval")]);
    let (status, said) = RehearsedEvaluation::spawn(command, &target, &temporary, 0.0).wait();
    assert_eq!(status.code(), Some(1), "{said}");
    let report = report(&target);
    assert!(report.contains("control groups"), "{report}");
    assert!(report.contains("Next step"), "{report}");
}

#[test]
fn recordings_that_are_not_there_are_named() {
    let _one = serialize_tests();
    let (_place, target, temporary) = directories();
    let mut command = Command::new("unshare");
    // Hidden from this process only; on a fresh machine the first directory does not exist.
    let script = "for place in /usr/share/mrpt /usr/share/doc; do \
                      if [ -d $place ]; then mount -t tmpfs none $place || exit; fi; \
                  done; exec \"$0\" --quick --only 3,7 --target \"$2\"";
    command.args(["--mount", "sh", "-c", script, env!("CARGO_BIN_EXE_eval")]);
    let (status, said) = RehearsedEvaluation::spawn(command, &target, &temporary, 0.0).wait();
    assert_eq!(status.code(), Some(1), "{said}");
    let report = report(&target);
    for package in ["mrpt-common", "opencv-doc"] {
        let words = format!("is missing; it comes with Debian&#39;s {package}");
        assert!(report.contains(&words), "{words}: {said}");
    }
}

/// Returns the process that runs a robot, once there is one.
fn find_robot(pid: u32) -> Option<i32> {
    find_descendant(pid, |line| line.contains(" robot ") && !line.starts_with("nsenter"))
}

fn find_node(pid: u32) -> Option<i32> {
    find_descendant(pid, |line| line.starts_with("sleep "))
}

fn find_descendant(pid: u32, is: impl Fn(&str) -> bool) -> Option<i32> {
    let all = support::procfs::with_descendants(&[pid as i32]).into_iter().skip(1);
    all.into_iter().find(|child| is(&support::procfs::command_line(*child).unwrap_or_default()))
}

fn find_daemon(temporary: &Path) -> Option<i32> {
    let home = format!("cloudroidd --home {}", temporary.display());
    let is = |pid: &i32| support::procfs::command_line(*pid).is_some_and(|line| line.contains(&home));
    support::procfs::pids().into_iter().find(is)
}

fn wait_until_found<T>(mut find: impl FnMut() -> Option<T>) -> T {
    support::wait_until("it", || Ok(find().ok_or_else(String::new))).expect("it comes about")
}
