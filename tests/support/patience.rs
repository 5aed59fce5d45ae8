//! How long stories wait: in working time, which passes the more slowly the busier the machine is. What would be there in
//! a second where nothing else runs takes five where five threads want each core, or where somebody waits for the disk
//! for four seconds of five; no story is to fail for that.
//!
//! ```text
//!  /proc/loadavg      threads that run or want to, for each core ─┐
//!  a thread that asks to be woken: how much later it is           ├─▶ how busy (1 to 8) ─▶ working time ─▶ deadlines
//!  /proc/pressure     time that passed waiting for disk or memory ┘
//! ```

use std::fs;
use std::future::Future;
use std::io::{self, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::num::NonZero;
use std::os::unix::net::UnixStream;
use std::process::Command;
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::thread;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};

use crate::evidence;

/// The working time that a story waits for what must come. Long: only a story that fails waits so long.
const LONG: Duration = Duration::from_secs(120);
/// No machine is taken for busier than this: else a story that fails would hold up all others for an hour.
const BUSIEST: f64 = 8.0;
/// Between two looks at how busy the machine is.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// What one look counts beside all before it: threads come and go between two looks, and some twenty of these tell a load.
const SHARE: f64 = 0.1;
/// Calls that take no deadline wait so long at a time, so that a deadline is looked at in between.
const SLICE: Duration = Duration::from_secs(1);
/// Programs of the stories find here how many seconds they are to wait.
const VARIABLE: &str = "STORY_PATIENCE";

static METER: LazyLock<&'static Meter> = LazyLock::new(Meter::begin);

/// What is known of the machine.
struct Meter {
    /// Working time since the first look, in nanoseconds.
    worked: AtomicU64,
    /// How busy it is and was at most: the bits of a number from 1 on.
    busy: AtomicU64,
    busiest: AtomicU64,
}

impl Meter {
    /// Starts the thread that looks; it ends with the process.
    fn begin() -> &'static Meter {
        let meter: &Meter = Box::leak(Box::new(Meter {
            worked: AtomicU64::new(0),
            busy: AtomicU64::new(1_f64.to_bits()),
            busiest: AtomicU64::new(1_f64.to_bits()),
        }));
        thread::Builder::new()
            .name("patience".to_owned())
            .spawn(|| meter.look_for_ever())
            .expect("a thread");
        meter
    }

    fn look_for_ever(&self) {
        let cores = thread::available_parallelism().map_or(1, NonZero::get) as f64;
        let mut stalled = sum_stalls();
        let mut looked = Instant::now();
        // What runs when the first story begins is known before that waits for anything.
        let mut busy =
            count_runnable().map_or(1.0, |threads| (threads / cores).clamp(1.0, BUSIEST));
        loop {
            self.busy.store(busy.to_bits(), Ordering::Relaxed);
            // Numbers that are not negative are ordered as their bits are.
            self.busiest.fetch_max(busy.to_bits(), Ordering::Relaxed);
            thread::sleep(LOOK_EVERY);
            let passed = looked.elapsed();
            looked += passed;
            let late = passed.as_secs_f64() / LOOK_EVERY.as_secs_f64();
            let wanted = count_runnable().map_or(1.0, |threads| threads / cores);
            let stalls = sum_stalls();
            let stood = stalls.saturating_sub(std::mem::replace(&mut stalled, stalls));
            let moved = 1.0 - (stood.as_secs_f64() / passed.as_secs_f64()).min(1.0);
            let now = (wanted.max(late).max(1.0) / moved.max(1.0 / BUSIEST)).min(BUSIEST);
            busy += (now - busy) * SHARE;
            // A look that comes late, since this thread found no core either, counts at once.
            let slowly = busy.max(late.min(BUSIEST));
            let worked = passed.as_secs_f64() / slowly;
            self.worked
                .fetch_add((worked * 1e9) as u64, Ordering::Relaxed);
        }
    }

    fn worked(&self) -> Duration {
        Duration::from_nanos(self.worked.load(Ordering::Relaxed))
    }
}

/// Returns how many threads of this machine run or want to, but for the one that asks (proc_loadavg(5)).
fn count_runnable() -> Option<f64> {
    let text = fs::read_to_string("/proc/loadavg").ok()?;
    let (running, _) = text.split_whitespace().nth(3)?.split_once('/')?;
    Some((running.parse::<f64>().ok()? - 1.0).max(0.0))
}

/// Returns for how long since the machine has started somebody waited for the disk, or all for memory
/// (Documentation/accounting/psi.rst); of a kernel that does not count it, no time.
fn sum_stalls() -> Duration {
    let total = |what: &str, line: &str| -> Option<u64> {
        let text = fs::read_to_string(format!("/proc/pressure/{what}")).ok()?;
        let line = text.lines().find(|said| said.starts_with(line))?;
        line.rsplit_once("total=")?.1.trim().parse().ok()
    };
    let waited = total("io", "some").unwrap_or(0) + total("memory", "full").unwrap_or(0);
    Duration::from_micros(waited)
}

/// Returns how busy the machine is: 1 where whatever wants a core has one, 2 where it takes twice as long.
pub fn busyness() -> f64 {
    f64::from_bits(METER.busy.load(Ordering::Relaxed))
}

/// Returns how busy the machine was at most since somebody first waited.
pub fn busiest() -> f64 {
    f64::from_bits(METER.busiest.load(Ordering::Relaxed))
}

/// Returns what takes `time` where nothing else runs, as long as it takes now.
pub fn scale(time: Duration) -> Duration {
    time.mul_f64(busyness())
}

/// Returns whole seconds as they are now, for settings of programs whose own times a busy machine would not keep.
pub fn scale_seconds(seconds: u64) -> u64 {
    scale(Duration::from_secs(seconds)).as_secs_f64().ceil() as u64
}

/// Returns how long a story waits, for calls that take one limit. Where there is a loop, a [`Deadline`] is better: it
/// follows the machine while it waits.
pub fn patience() -> Duration {
    scale(LONG)
}

/// Tells a program of the stories how long it is to wait.
pub fn tell_patience(command: &mut Command) -> &mut Command {
    command.env(VARIABLE, patience().as_secs().to_string())
}

/// An end of waiting.
#[derive(Debug, Clone, Copy)]
pub struct Deadline {
    /// Of the working time.
    end: Duration,
}

impl Deadline {
    /// Returns the one of whatever must come.
    pub fn begin() -> Self {
        Self::begin_for(LONG)
    }

    /// Returns the one of something that takes so many times as long.
    pub fn begin_many(times: u32) -> Self {
        Self::begin_for(LONG * times)
    }

    /// Returns one after so much working time.
    pub fn begin_for(time: Duration) -> Self {
        Self {
            end: METER.worked() + time,
        }
    }

    /// Says whether all the time is over.
    pub fn is_over(&self) -> bool {
        METER.worked() >= self.end
    }

    /// Fails with these words once the time is over.
    ///
    /// # Errors
    /// Then.
    pub fn check(&self, instead: impl FnOnce() -> String) -> anyhow::Result<()> {
        if self.is_over() {
            evidence::note_machine();
            bail!("{}", instead());
        }
        Ok(())
    }

    /// Waits for something that is not waited for longer than this.
    ///
    /// # Errors
    /// When the time is over.
    pub async fn limit<F: Future>(self, future: F) -> anyhow::Result<F::Output> {
        let mut future = std::pin::pin!(future);
        loop {
            match tokio::time::timeout(SLICE, &mut future).await {
                Ok(output) => return Ok(output),
                Err(_) if self.is_over() => {
                    evidence::note_machine();
                    bail!("it did not come; {}", describe_slowness())
                }
                Err(_) => {}
            }
        }
    }
}

/// Says how busy the machine is, for who reads that something did not come.
pub fn describe_slowness() -> String {
    format!(
        "the machine is {:.1} times as slow as it can be",
        busyness()
    )
}

/// Waits for something, as long as a story waits.
///
/// # Errors
/// When it does not come.
pub async fn wait_for<F: Future>(future: F) -> anyhow::Result<F::Output> {
    Deadline::begin().limit(future).await
}

/// Waits for the next of what another thread says.
///
/// # Errors
/// When nothing comes, and when the other thread has ended.
pub fn receive<T>(said: &Receiver<T>) -> anyhow::Result<T> {
    let deadline = Deadline::begin();
    loop {
        match said.recv_timeout(SLICE) {
            Ok(what) => return Ok(what),
            Err(RecvTimeoutError::Disconnected) => bail!("whoever was to say it has ended"),
            Err(RecvTimeoutError::Timeout) => {
                deadline.check(|| format!("nothing was said; {}", describe_slowness()))?;
            }
        }
    }
}

/// A connection that can be told when to stop waiting.
pub trait Timed {
    /// Sets how long one read waits.
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()>;
}

impl Timed for TcpStream {
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()> {
        self.set_read_timeout(time)
    }
}

impl Timed for UnixStream {
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()> {
        self.set_read_timeout(time)
    }
}

/// A connection each read of which waits as long as a story does, unless it is told another time.
#[derive(Debug)]
pub struct Patient<S> {
    stream: S,
    is_limited: bool,
}

impl<S: Timed> Patient<S> {
    /// Wraps one.
    ///
    /// # Errors
    /// Where the kernel sets no time.
    pub fn new(stream: S) -> io::Result<Self> {
        stream.set_patience(Some(SLICE))?;
        Ok(Self {
            stream,
            is_limited: false,
        })
    }

    /// Has reads wait no longer than this, or again as long as a story does.
    ///
    /// # Errors
    /// Where the kernel sets no time.
    pub fn limit(&mut self, time: Option<Duration>) -> io::Result<()> {
        self.is_limited = time.is_some();
        // No time at all would be time without an end.
        let time = time.map_or(SLICE, |time| time.max(Duration::from_millis(1)));
        self.stream.set_patience(Some(time))
    }

    /// Returns the connection.
    pub fn get(&self) -> &S {
        &self.stream
    }
}

impl<S: Read> Read for Patient<S> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let deadline = Deadline::begin();
        loop {
            match self.stream.read(buffer) {
                Err(error) if is_slow(&error) && !self.is_limited && !deadline.is_over() => {}
                read => return read,
            }
        }
    }
}

impl<S: Write> Write for Patient<S> {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.stream.write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// Says whether nothing came in time, which is all that it says of the connection.
pub(crate) fn is_slow(error: &io::Error) -> bool {
    // A signal, such as a child's end, ends a read as well.
    let of_waiting = [
        ErrorKind::WouldBlock,
        ErrorKind::TimedOut,
        ErrorKind::Interrupted,
    ];
    of_waiting.contains(&error.kind())
}

/// Connects to a server of this machine.
///
/// # Errors
/// Where nobody listens.
pub fn connect(address: &str) -> anyhow::Result<Patient<TcpStream>> {
    let stream = TcpStream::connect(address).with_context(|| address.to_owned())?;
    Patient::new(stream).map_err(|error| anyhow!("{address}: {error}"))
}
