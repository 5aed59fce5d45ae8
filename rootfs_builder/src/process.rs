//! Programs of the host: started without a shell, killed when their future is dropped, with the last lines of their
//! output kept. Programs that mount file systems run in separate namespaces.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::path::Path;
use std::process::{ExitStatus, Stdio};

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use tokio::io::{AsyncBufReadExt, AsyncRead, BufReader};
use tokio::process::Command;

use crate::error::Error;

/// Number of last lines in an error.
pub(crate) const LAST_LINES: usize = 25;

/// The last lines of an output.
#[derive(Debug, Default)]
pub(crate) struct LastLines(VecDeque<String>);

impl LastLines {
    /// Adds a line; returns the one that no longer is among the last.
    pub(crate) fn push(&mut self, line: &str) -> Option<String> {
        let is_full = self.0.len() == LAST_LINES;
        self.0.push_back(line.to_owned());
        if is_full { self.0.pop_front() } else { None }
    }

    /// Returns the lines, joined by newlines.
    pub(crate) fn text(&self) -> String {
        self.0.iter().map(String::as_str).collect::<Vec<_>>().join("\n")
    }
}

/// Creates a command in the C locale with an empty standard input.
pub(crate) fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    command
        .env("LC_ALL", "C.UTF-8")
        .env("DEBIAN_FRONTEND", "noninteractive")
        .stdin(Stdio::null())
        // A separate process group, so that all its descendants can be killed with it.
        .process_group(0)
        .kill_on_drop(true);
    command
}

/// Process group of a program, killed if this is dropped before the program has ended: otherwise apt's methods and
/// mmdebstrap's dpkg would continue for a cancelled build.
struct ProcessGroup(Option<Pid>);

impl Drop for ProcessGroup {
    fn drop(&mut self) {
        if let Some(group) = self.0.take() {
            let _ = killpg(group, Signal::SIGKILL);
        }
    }
}

/// Runs a command to its end; each line of either stream is passed to `on_line`. The error contains the last lines, or
/// how to install the program.
pub(crate) async fn run(
    command: Command,
    package: &'static str,
    on_line: impl FnMut(Stream, &str),
) -> Result<(), Error> {
    let program = command.as_std().get_program().to_owned();
    let ended = run_to_end(command, package, on_line).await?;
    ended.outcome(&program)
}

/// Options of unshare(1). Mounts are invisible to other processes and disappear with the last process of the namespace;
/// all processes are killed when the first one ends, which is killed together with unshare itself.
const NAMESPACES: [&str; 5] = ["--mount", "--pid", "--fork", "--kill-child", "--mount-proc"];

/// Init process of the namespaces, which runs its arguments. It ends with them, or when the other end of its standard
/// input is closed, which happens however the daemon ends, even by SIGKILL. The init process of a namespace receives
/// only signals that it handles.
const FIRST_PROCESS: &str = r#"
exec 3<&0
trap 'exit 1' TERM
{ cat; kill -TERM $$; } <&3 >/dev/null 2>&1 &
"$@" </dev/null 3<&- &
wait $!
"#;

/// Exit status of the shell if the program does not exist.
const EXIT_NOT_FOUND: i32 = 127;

/// Runs a program that mounts file systems, in separate mount and PID namespaces: no other process of this machine can
/// keep its mounts busy, and neither mounts nor processes outlive it or the daemon.
pub(crate) async fn run_in_namespaces(
    command: Command,
    package: &'static str,
    on_line: impl FnMut(Stream, &str),
) -> Result<(), Error> {
    let command = command.as_std();
    let program = command.get_program();
    let mut inside = self::command("unshare");
    inside
        .args(NAMESPACES)
        .args(["--", "sh", "-c", FIRST_PROCESS, "sh"])
        .arg(program)
        .args(command.get_args())
        .stdin(Stdio::piped());
    for (name, value) in command.get_envs() {
        match value {
            Some(value) => inside.env(name, value),
            None => inside.env_remove(name),
        };
    }
    let ended = run_to_end(inside, "util-linux", on_line).await?;
    if ended.status.code() == Some(EXIT_NOT_FOUND) {
        return Err(missing_program(program, package));
    }
    ended.outcome(program)
}

/// Exit status of a program, and its last lines.
struct ProcessExit {
    status: ExitStatus,
    tail: LastLines,
}

impl ProcessExit {
    fn outcome(self, program: &OsStr) -> Result<(), Error> {
        if self.status.success() {
            return Ok(());
        }
        Err(exit_error(program, &self.status.to_string(), self.tail.text()))
    }
}

async fn run_to_end(
    mut command: Command,
    package: &'static str,
    mut on_line: impl FnMut(Stream, &str),
) -> Result<ProcessExit, Error> {
    let program = command.as_std().get_program().to_owned();
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(|error| spawn_error(&program, package, error))?;
    let id = child.id().and_then(|id| i32::try_from(id).ok());
    let mut group = ProcessGroup(id.map(Pid::from_raw));
    // If it is a pipe, it stays open until the program has ended; `wait` alone would close it.
    let _input = child.stdin.take();
    let out = child.stdout.take().map(BufReader::new);
    let err = child.stderr.take().map(BufReader::new);
    let mut tail = LastLines::default();
    let mut out = StreamLines::new(out);
    let mut err = StreamLines::new(err);
    while out.is_open() || err.is_open() {
        let (stream, line) = tokio::select! {
            line = out.next(), if out.is_open() => (Stream::Out, line),
            line = err.next(), if err.is_open() => (Stream::Err, line),
        };
        if let Some(line) = line {
            tail.push(&line);
            on_line(stream, &line);
        }
    }
    let status = child.wait().await.map_err(|error| spawn_error(&program, package, error))?;
    group.0 = None;
    Ok(ProcessExit { status, tail })
}

/// Runs a command and returns its standard output.
pub(crate) async fn output(command: Command, package: &'static str) -> Result<String, Error> {
    let mut text = String::new();
    run(command, package, |stream, line| {
        if stream == Stream::Out {
            text.push_str(line);
            text.push('\n');
        }
    })
    .await?;
    Ok(text)
}

/// Output stream of a line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stream {
    /// Standard output.
    Out,
    /// Standard error.
    Err,
}

fn exit_error(program: &OsStr, status: &str, last_lines: String) -> Error {
    if last_lines.contains("No space left on device") {
        return Error::DiskFull {
            path: Path::new(program).to_owned(),
            what: format!("running {}", program.to_string_lossy()),
        };
    }
    Error::Program { program: program.to_string_lossy().into_owned(), status: status.to_owned(), last_lines }
}

fn spawn_error(program: &OsStr, package: &'static str, error: std::io::Error) -> Error {
    if error.kind() == std::io::ErrorKind::NotFound {
        return missing_program(program, package);
    }
    Error::io("starting", program, error)
}

fn missing_program(program: &OsStr, package: &'static str) -> Error {
    // Programs are named by literals; these are the ones that this crate runs.
    let program = match program.to_str() {
        Some("mmdebstrap") => "mmdebstrap",
        Some("unshare") => "unshare",
        Some("dpkg-deb") => "dpkg-deb",
        Some("pip3") => "pip3",
        _ => "apt-get",
    };
    Error::MissingProgram { program, package }
}

/// Lines of a stream that may not be UTF-8 and may end with a carriage return.
struct StreamLines<R> {
    reader: Option<R>,
    buffer: Vec<u8>,
}

impl<R: AsyncRead + AsyncBufReadExt + Unpin> StreamLines<R> {
    fn new(reader: Option<R>) -> Self {
        Self { reader, buffer: Vec::new() }
    }

    fn is_open(&self) -> bool {
        self.reader.is_some()
    }

    /// Cancel-safe: data read so far stays in the buffer.
    async fn next(&mut self) -> Option<String> {
        let reader = self.reader.as_mut()?;
        match reader.read_until(b'\n', &mut self.buffer).await {
            Ok(read) if read > 0 => {}
            _ => self.reader = None,
        }
        if self.buffer.is_empty() {
            return None;
        }
        let line = String::from_utf8_lossy(&self.buffer).trim_end_matches(['\n', '\r']).to_owned();
        self.buffer.clear();
        Some(line)
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::io::Read;

    use super::*;

    fn shell(script: &str) -> Command {
        let mut shell = command("sh");
        shell.args(["-c", script]);
        shell
    }

    #[tokio::test]
    async fn lines_of_both_streams_come_and_the_last_are_kept() {
        let mut seen = Vec::new();
        let error = run(shell("echo a; echo b >&2; exit 3"), "dash", |_, line| seen.push(line.to_owned()))
            .await
            .expect_err("status 3");
        seen.sort();
        assert_eq!(seen, ["a", "b"]);
        let text = error.to_string();
        assert!(text.contains("sh failed (exit status: 3)") && text.contains('b'), "{text}");
    }

    #[tokio::test]
    async fn what_a_program_has_started_ends_with_it() {
        let place = tempfile::tempdir().expect("a directory");
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).expect("made");
        // The grandchild keeps the pipe open for writing as long as it lives.
        let script = format!("(sleep 1000 > '{}') & wait", pipe.display());
        let running = tokio::spawn(run(shell(&script), "dash", |_, _| {}));
        let (opened, open) = tokio::sync::oneshot::channel();
        let reading = tokio::task::spawn_blocking(move || {
            let mut file = std::fs::File::open(pipe).expect("opened with the other end");
            let _ = opened.send(());
            std::io::Read::read(&mut file, &mut [0]).expect("read")
        });
        open.await.expect("the grandchild runs");
        running.abort();
        assert_eq!(reading.await.expect("no panic"), 0, "the other end is closed");
    }

    /// Starts a script that mounts; its last command opens `pipe` for writing.
    async fn begin_mounting(script: &str, pipe: &Path) -> (tokio::task::JoinHandle<()>, File) {
        nix::unistd::mkfifo(pipe, nix::sys::stat::Mode::S_IRWXU).expect("made");
        let command = shell(script);
        let running = tokio::spawn(async move {
            let outcome = run_in_namespaces(command, "dash", |_, _| {}).await;
            panic!("it is to go on until it is killed: {outcome:?}");
        });
        let pipe = pipe.to_owned();
        let opening = tokio::task::spawn_blocking(move || File::open(pipe).expect("opened"));
        (running, opening.await.expect("no panic"))
    }

    /// Waits until all writers have closed the pipe.
    async fn wait_closed(mut pipe: File) {
        let read = tokio::task::spawn_blocking(move || pipe.read(&mut [0]).expect("read"));
        assert_eq!(read.await.expect("no panic"), 0, "the other end is closed");
    }

    #[tokio::test]
    async fn what_a_program_mounts_is_seen_by_nobody_else() {
        let place = tempfile::tempdir().expect("a directory");
        let (tree, pipe) = (place.path().join("tree"), place.path().join("pipe"));
        std::fs::create_dir(&tree).expect("made");
        // A process that leaves its session and process group is killed as well.
        let script = format!(
            "mount -t tmpfs none {tree} && touch {tree}/inside && setsid sleep 1000 >{pipe}",
            tree = tree.display(),
            pipe = pipe.display()
        );
        let (running, pipe) = begin_mounting(&script, &pipe).await;
        let mounts = std::fs::read_to_string("/proc/self/mountinfo").expect("read");
        assert!(!mounts.contains(&*tree.to_string_lossy()), "{mounts}");
        assert!(!tree.join("inside").exists());
        running.abort();
        wait_closed(pipe).await;
        std::fs::remove_dir(&tree).expect("nothing is mounted there");
    }

    #[tokio::test]
    async fn a_program_that_mounts_ends_with_a_daemon_that_is_killed() {
        let place = tempfile::tempdir().expect("a directory");
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).expect("made");
        // Equivalent to killing the daemon: its end of the pipe is closed, and nobody kills the group.
        let mut first = command("unshare");
        first
            .args(NAMESPACES)
            .args(["sh", "-c", FIRST_PROCESS, "sh", "sh", "-c"])
            .arg(format!("setsid sleep 1000 >{}", pipe.display()))
            .stdin(Stdio::piped())
            .kill_on_drop(false);
        let mut child = first.spawn().expect("unshare, of util-linux");
        let input = child.stdin.take();
        let opening = tokio::task::spawn_blocking(move || File::open(pipe).expect("opened"));
        let pipe = opening.await.expect("no panic");
        drop(input);
        wait_closed(pipe).await;
        child.wait().await.expect("it has ended");
    }

    #[tokio::test]
    async fn a_program_in_namespaces_ends_as_it_would_outside() {
        let run = |script: &str| run_in_namespaces(shell(script), "dash", |_, _| {});
        run("exit 0").await.expect("success");
        let error = run("echo why >&2; exit 3").await.expect_err("status 3");
        let text = error.to_string();
        assert!(text.contains("sh failed (exit status: 3)"), "{text}");
        assert!(text.contains("why"), "{text}");
    }

    #[tokio::test]
    async fn a_missing_program_is_answered_with_the_command_that_installs_it() {
        let missing = |program| {
            let place = tempfile::tempdir().expect("a directory");
            for there in ["unshare", "sh", "cat"] {
                let at = place.path().join(there);
                std::os::unix::fs::symlink(format!("/usr/bin/{there}"), at).expect("linked");
            }
            let mut command = command(program);
            command.env("PATH", place.path());
            (command, place)
        };
        let (command, _place) = missing("mmdebstrap");
        let error = run_in_namespaces(command, "mmdebstrap", |_, _| {}).await;
        let expected = "mmdebstrap is not installed: run `apt-get install mmdebstrap`";
        assert_eq!(error.expect_err("not found").to_string(), expected);
        let (command, _place) = missing("pip3");
        let error = output(command, "python3-pip").await.expect_err("not found");
        let expected = "pip3 is not installed: run `apt-get install python3-pip`";
        assert_eq!(error.to_string(), expected);
    }

    #[tokio::test]
    async fn a_full_disk_is_seen_in_a_programs_words() {
        let error = output(shell("echo 'x: No space left on device' >&2; exit 1"), "dash").await.expect_err("failed");
        assert!(matches!(error, Error::DiskFull { .. }), "{error}");
    }
}
