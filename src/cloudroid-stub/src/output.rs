//! Output of the stub: the node's lines and its own, each stream written by a separate thread.
//!
//! The reader may stop (a full pipe) or exit (a closed one). The stub waits for neither: messages of the robot pass
//! through the thread that would wait, and with them the safe stop. Lines that are not read are dropped, the oldest
//! first, and their number is printed as soon as the stream is read again.
//!
//! Existing crates (tracing-appender) require a later compiler than robots' programs are built with.

use std::io::Write;
use std::sync::{Arc, LazyLock};
use std::time::{Duration, Instant};

use bytes::Bytes;
use parking_lot::{Condvar, Mutex};
use ros::ring::{Ring, RingBounds};

/// Limits for lines that wait for a slow reader.
const WAITING: RingBounds = RingBounds { messages: 4096, bytes: 1 << 20 };
/// Time that a reader has for the last lines when the stub ends.
const LAST: Duration = Duration::from_millis(500);

/// Standard output.
pub static STDOUT: LazyLock<Printer> = LazyLock::new(|| Printer::new(std::io::stdout()));
/// Standard error.
pub static STDERR: LazyLock<Printer> = LazyLock::new(|| Printer::new(std::io::stderr()));

/// Waits until the last lines of both streams are written, for half a second at most.
pub fn finish() {
    let deadline = Instant::now() + LAST;
    STDOUT.finish(deadline);
    STDERR.finish(deadline);
}

/// Prints on a separate thread, which lives as long as the process.
pub struct Printer(Arc<PrinterShared>);

struct PrinterShared {
    state: Mutex<State>,
    changed: Condvar,
}

struct State {
    waiting: Ring<Bytes>,
    /// Number of lines dropped since the number was last printed.
    left_out: u64,
    /// The thread is writing.
    is_writing: bool,
    /// The reader is gone.
    is_closed: bool,
}

impl Printer {
    fn new(stream: impl Write + Send + 'static) -> Self {
        let state = State { waiting: Ring::new(WAITING), left_out: 0, is_writing: false, is_closed: false };
        let shared = Arc::new(PrinterShared { state: Mutex::new(state), changed: Condvar::new() });
        let printing = Arc::clone(&shared);
        let spawned = std::thread::Builder::new().name("output".to_owned()).spawn(move || printing.print(stream));
        // If the thread cannot be started nothing is printed, which is better than a robot that does not start.
        shared.state.lock().is_closed = spawned.is_err();
        Self(shared)
    }

    /// Prints this text, which ends with a newline; never waits.
    pub fn print(&self, text: impl Into<Bytes>) {
        let mut state = self.0.state.lock();
        if !state.is_closed {
            let lost = state.waiting.push(text.into());
            state.left_out += lost.messages;
            self.0.changed.notify_all();
        }
    }

    /// Waits until all lines are printed, until the deadline.
    fn finish(&self, deadline: Instant) {
        let mut state = self.0.state.lock();
        while (state.is_writing || !state.waiting.is_empty()) && !state.is_closed {
            if self.0.changed.wait_until(&mut state, deadline).timed_out() {
                return;
            }
        }
    }
}

impl PrinterShared {
    fn print(&self, mut stream: impl Write) {
        loop {
            let (text, left_out) = self.next();
            let note = || {
                format!(
                    "cloudroid-stub: {left_out} lines before this one were dropped because the output was not read\n"
                )
            };
            let noted = match left_out {
                0 => Ok(()),
                _ => stream.write_all(note().as_bytes()),
            };
            let printed = noted.and_then(|()| stream.write_all(&text));
            let printed = printed.and_then(|()| stream.flush());
            let mut state = self.state.lock();
            state.is_writing = false;
            let is_gone = |error: std::io::Error| error.kind() == std::io::ErrorKind::BrokenPipe;
            state.is_closed = printed.is_err_and(is_gone);
            self.changed.notify_all();
            if state.is_closed {
                state.waiting.clear();
                return;
            }
        }
    }

    /// Returns the text to print next, and the number of lines dropped before it.
    fn next(&self) -> (Bytes, u64) {
        let mut state = self.state.lock();
        loop {
            if let Some(text) = state.waiting.pop() {
                state.is_writing = true;
                return (text, std::mem::take(&mut state.left_out));
            }
            self.changed.wait(&mut state);
        }
    }
}

impl Write for &Printer {
    fn write(&mut self, text: &[u8]) -> std::io::Result<usize> {
        self.print(Bytes::copy_from_slice(text));
        Ok(text.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::unix::net::UnixStream;

    use super::*;

    #[test]
    fn a_reader_that_stops_keeps_nobody_waiting_and_is_told_what_it_missed() {
        let (writes, reads) = UnixStream::pair().unwrap();
        let printer = Printer::new(writes);
        let total = 100_000;
        for number in 0..total {
            printer.print(format!("line {number} {}\n", "x".repeat(100)));
        }
        let (mut read, mut left_out) = (0, 0);
        for line in BufReader::new(reads).lines() {
            let line = line.unwrap();
            match line.strip_prefix("cloudroid-stub: ") {
                Some(note) => left_out += note.split(' ').next().unwrap().parse::<u64>().unwrap(),
                None => read += 1,
            }
            if line.starts_with(&format!("line {} ", total - 1)) {
                break;
            }
        }
        assert_eq!(read + left_out, total);
        assert!(left_out > 0, "a socket does not take all of it");
    }

    #[test]
    fn a_reader_that_has_gone_ends_nothing() {
        let (writes, reads) = UnixStream::pair().unwrap();
        let printer = Printer::new(writes);
        drop(reads);
        for _ in 0..3 {
            printer.print("words\n");
            // Lines are either printed or discarded by then.
            printer.finish(Instant::now() + Duration::from_secs(600));
        }
        assert!(printer.0.state.lock().is_closed);
    }

    #[test]
    fn the_last_lines_are_waited_for() {
        let (writes, reads) = UnixStream::pair().unwrap();
        let printer = Printer::new(writes);
        printer.print("last\n");
        printer.finish(Instant::now() + Duration::from_secs(600));
        let mut line = String::new();
        reads.set_nonblocking(true).unwrap();
        BufReader::new(reads).read_line(&mut line).unwrap();
        assert_eq!(line, "last\n");
    }
}
