//! Programs of the host: started without a shell, killed when their future is dropped, their last words kept.

use std::collections::VecDeque;
use std::ffi::OsStr;
use std::path::Path;
use std::process::Stdio;

use nix::sys::signal::{Signal, killpg};
use nix::unistd::Pid;
use tokio::io::{AsyncBufReadExt, AsyncRead, BufReader};
use tokio::process::Command;

use crate::error::Error;

/// How many last lines an error carries.
pub(crate) const LAST_LINES: usize = 25;

/// The last lines of something that prints many.
#[derive(Debug, Default)]
pub(crate) struct Tail(VecDeque<String>);

impl Tail {
    /// Takes one more line; gives the one that is not among the last ones any more.
    pub(crate) fn push(&mut self, line: &str) -> Option<String> {
        let is_full = self.0.len() == LAST_LINES;
        self.0.push_back(line.to_owned());
        if is_full { self.0.pop_front() } else { None }
    }

    /// All of them, one per line.
    pub(crate) fn text(&self) -> String {
        self.0
            .iter()
            .map(String::as_str)
            .collect::<Vec<_>>()
            .join("\n")
    }
}

/// A command in the C locale with nothing on its standard input.
pub(crate) fn command(program: &str) -> Command {
    let mut command = Command::new(program);
    command
        .env("LC_ALL", "C.UTF-8")
        .env("DEBIAN_FRONTEND", "noninteractive")
        .stdin(Stdio::null())
        // Its own, so that all that it starts can be ended with it.
        .process_group(0)
        .kill_on_drop(true);
    command
}

/// A program and all that it has started, killed when this is dropped before it has ended: apt's methods and
/// mmdebstrap's dpkg would go on for a build that nobody wants any more.
struct Group(Option<Pid>);

impl Drop for Group {
    fn drop(&mut self) {
        if let Some(group) = self.0.take() {
            let _ = killpg(group, Signal::SIGKILL);
        }
    }
}

/// Runs it to its end; every line of either stream goes to `on_line` as it comes. The error has the last lines,
/// or says how to get the program.
pub(crate) async fn run(
    mut command: Command,
    package: &'static str,
    mut on_line: impl FnMut(Stream, &str),
) -> Result<(), Error> {
    let program = command.as_std().get_program().to_owned();
    command.stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command
        .spawn()
        .map_err(|error| spawn_error(&program, package, error))?;
    let id = child.id().and_then(|id| i32::try_from(id).ok());
    let mut group = Group(id.map(Pid::from_raw));
    let out = child.stdout.take().map(BufReader::new);
    let err = child.stderr.take().map(BufReader::new);
    let mut tail = Tail::default();
    let mut out = Lines::new(out);
    let mut err = Lines::new(err);
    while out.open() || err.open() {
        let (stream, line) = tokio::select! {
            line = out.next(), if out.open() => (Stream::Out, line),
            line = err.next(), if err.open() => (Stream::Err, line),
        };
        if let Some(line) = line {
            tail.push(&line);
            on_line(stream, &line);
        }
    }
    let status = child
        .wait()
        .await
        .map_err(|error| spawn_error(&program, package, error))?;
    group.0 = None;
    if status.success() {
        return Ok(());
    }
    Err(failed(&program, &status.to_string(), tail.text()))
}

/// Runs it and gives its standard output.
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

/// Which stream a line came from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Stream {
    /// Standard output.
    Out,
    /// Standard error.
    Err,
}

fn failed(program: &OsStr, status: &str, last_lines: String) -> Error {
    if last_lines.contains("No space left on device") {
        return Error::DiskFull {
            path: Path::new(program).to_owned(),
            what: format!("running {}", program.to_string_lossy()),
        };
    }
    Error::Program {
        program: program.to_string_lossy().into_owned(),
        status: status.to_owned(),
        last_lines,
    }
}

fn spawn_error(program: &OsStr, package: &'static str, error: std::io::Error) -> Error {
    if error.kind() == std::io::ErrorKind::NotFound {
        // Programs are named by literals; the names below are those this crate runs.
        let program = match program.to_str() {
            Some("mmdebstrap") => "mmdebstrap",
            Some("dpkg-deb") => "dpkg-deb",
            Some("pip3") => "pip3",
            _ => "apt-get",
        };
        return Error::MissingProgram { program, package };
    }
    Error::io("starting", program, error)
}

/// Lines of a stream that may not be UTF-8 and may end lines with a carriage return.
struct Lines<R> {
    reader: Option<R>,
    buffer: Vec<u8>,
}

impl<R: AsyncRead + AsyncBufReadExt + Unpin> Lines<R> {
    fn new(reader: Option<R>) -> Self {
        Self {
            reader,
            buffer: Vec::new(),
        }
    }

    fn open(&self) -> bool {
        self.reader.is_some()
    }

    /// Cancel safe: what was read stays in the buffer.
    async fn next(&mut self) -> Option<String> {
        let reader = self.reader.as_mut()?;
        match reader.read_until(b'\n', &mut self.buffer).await {
            Ok(read) if read > 0 => {}
            _ => self.reader = None,
        }
        if self.buffer.is_empty() {
            return None;
        }
        let line = String::from_utf8_lossy(&self.buffer)
            .trim_end_matches(['\n', '\r'])
            .to_owned();
        self.buffer.clear();
        Some(line)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn shell(script: &str) -> Command {
        let mut shell = command("sh");
        shell.args(["-c", script]);
        shell
    }

    #[tokio::test]
    async fn lines_of_both_streams_come_and_the_last_are_kept() {
        let mut seen = Vec::new();
        let error = run(shell("echo a; echo b >&2; exit 3"), "dash", |_, line| {
            seen.push(line.to_owned())
        })
        .await
        .expect_err("status 3");
        seen.sort();
        assert_eq!(seen, ["a", "b"]);
        let text = error.to_string();
        assert!(
            text.contains("sh failed (exit status: 3)") && text.contains('b'),
            "{text}"
        );
    }

    #[tokio::test]
    async fn what_a_program_has_started_ends_with_it() {
        let place = tempfile::tempdir().expect("a directory");
        let pipe = place.path().join("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).expect("made");
        // The grandchild holds the pipe open for writing as long as it lives.
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
        assert_eq!(
            reading.await.expect("no panic"),
            0,
            "the other end is closed"
        );
    }

    #[tokio::test]
    async fn a_missing_program_is_answered_with_the_command_that_installs_it() {
        let mut command = command("mmdebstrap");
        command.env("PATH", "/nonexistent");
        let error = output(command, "mmdebstrap").await.expect_err("not found");
        assert_eq!(
            error.to_string(),
            "mmdebstrap is not installed: run `apt-get install mmdebstrap`"
        );
    }

    #[tokio::test]
    async fn a_full_disk_is_seen_in_a_programs_words() {
        let error = output(
            shell("echo 'x: No space left on device' >&2; exit 1"),
            "dash",
        )
        .await
        .expect_err("failed");
        assert!(matches!(error, Error::DiskFull { .. }), "{error}");
    }
}
