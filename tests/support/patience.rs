//! Time limits of stories, in working time, which passes more slowly the busier the machine is. What takes a second on
//! an idle machine takes five if five threads compete for each core, or if something waits for the disk four seconds
//! out of five; stories should not fail because of that.
//!
//! ```text
//!  /proc/loadavg      running and runnable threads per core       ─┐
//!  a sleeping thread  how much later than requested it wakes up    ├─▶ busyness (1 to 8) ─▶ working time ─▶ deadlines
//!  /proc/pressure     time spent waiting for disk or memory       ─┘
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

/// Working time that a story waits for anything. Long, because only a failing story waits that long.
const LONG: Duration = Duration::from_secs(120);
/// Upper limit of the busyness; otherwise a failing story would delay all others for an hour.
const BUSIEST: f64 = 8.0;
/// Sampling interval of the busyness.
const LOOK_EVERY: Duration = Duration::from_millis(100);
/// Weight of a sample in the moving average: threads come and go between samples, and about twenty samples are
/// representative of the load.
const SHARE: f64 = 0.1;
/// Maximum duration of a blocking call without a deadline, so that a deadline is checked in between.
const SLICE: Duration = Duration::from_secs(1);
/// Environment variable with the number of seconds that programs of the stories should wait.
const VARIABLE: &str = "STORY_PATIENCE";

static METER: LazyLock<&'static LoadMeter> = LazyLock::new(LoadMeter::begin);

/// The measured load of the machine.
struct LoadMeter {
    /// Working time since the first sample, in nanoseconds.
    worked: AtomicU64,
    /// Current and maximum busyness: the bits of a number of at least 1.
    busy: AtomicU64,
    busiest: AtomicU64,
}

impl LoadMeter {
    /// Starts the measuring thread; it ends with the process.
    fn begin() -> &'static LoadMeter {
        let meter: &LoadMeter = Box::leak(Box::new(LoadMeter {
            worked: AtomicU64::new(0),
            busy: AtomicU64::new(1_f64.to_bits()),
            busiest: AtomicU64::new(1_f64.to_bits()),
        }));
        thread::Builder::new().name("patience".to_owned()).spawn(|| meter.measure_forever()).expect("a thread");
        meter
    }

    fn measure_forever(&self) {
        let cores = thread::available_parallelism().map_or(1, NonZero::get) as f64;
        let mut stalled = sum_stalls();
        let mut looked = Instant::now();
        // The load at the start of the first story is known before that story waits for anything.
        let mut busy = count_runnable().map_or(1.0, |threads| (threads / cores).clamp(1.0, BUSIEST));
        loop {
            self.busy.store(busy.to_bits(), Ordering::Relaxed);
            // Non-negative floats have the same order as their bits.
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
            // A late sample, which means that this thread lacked a core as well, counts immediately.
            let slowly = busy.max(late.min(BUSIEST));
            let worked = passed.as_secs_f64() / slowly;
            self.worked.fetch_add((worked * 1e9) as u64, Ordering::Relaxed);
        }
    }

    fn working_time(&self) -> Duration {
        Duration::from_nanos(self.worked.load(Ordering::Relaxed))
    }
}

/// Returns the number of running and runnable threads of this machine, except the calling one (proc_loadavg(5)).
fn count_runnable() -> Option<f64> {
    let text = fs::read_to_string("/proc/loadavg").ok()?;
    let (running, _) = text.split_whitespace().nth(3)?.split_once('/')?;
    Some((running.parse::<f64>().ok()? - 1.0).max(0.0))
}

/// Returns the time since boot during which some task waited for the disk, or all tasks for memory
/// (Documentation/accounting/psi.rst); zero if the kernel does not count it.
fn sum_stalls() -> Duration {
    let total = |what: &str, line: &str| -> Option<u64> {
        let text = fs::read_to_string(format!("/proc/pressure/{what}")).ok()?;
        let line = text.lines().find(|said| said.starts_with(line))?;
        line.rsplit_once("total=")?.1.trim().parse().ok()
    };
    let waited = total("io", "some").unwrap_or(0) + total("memory", "full").unwrap_or(0);
    Duration::from_micros(waited)
}

/// Returns the busyness of the machine: 1 if every runnable thread has a core, 2 if everything takes twice as long.
pub fn busyness() -> f64 {
    f64::from_bits(METER.busy.load(Ordering::Relaxed))
}

/// Returns the maximum busyness since the first wait.
pub fn busiest() -> f64 {
    f64::from_bits(METER.busiest.load(Ordering::Relaxed))
}

/// Scales a duration on an idle machine to the present load.
pub fn scale(time: Duration) -> Duration {
    time.mul_f64(busyness())
}

/// Scales whole seconds to the present load, for settings of programs that do not adapt to a busy machine themselves.
pub fn scale_seconds(seconds: u64) -> u64 {
    scale(Duration::from_secs(seconds)).as_secs_f64().ceil() as u64
}

/// Returns how long a story waits, for calls with a fixed timeout. In a loop a [`Deadline`] is preferable, because it
/// follows the load during the wait.
pub fn patience() -> Duration {
    scale(LONG)
}

/// Tells a program of the stories how long to wait, by an environment variable.
pub fn tell_patience(command: &mut Command) -> &mut Command {
    command.env(VARIABLE, patience().as_secs().to_string())
}

/// A deadline in working time.
#[derive(Debug, Clone, Copy)]
pub struct Deadline {
    /// Working time at the deadline.
    end: Duration,
}

impl Deadline {
    /// Returns the default deadline.
    pub fn begin() -> Self {
        Self::begin_for(LONG)
    }

    /// Returns a deadline for something that takes `times` times as long.
    pub fn begin_many(times: u32) -> Self {
        Self::begin_for(LONG * times)
    }

    /// Returns a deadline after this working time.
    pub fn begin_for(time: Duration) -> Self {
        Self { end: METER.working_time() + time }
    }

    /// Returns whether the deadline has passed.
    pub fn is_over(&self) -> bool {
        METER.working_time() >= self.end
    }

    /// Fails with the message of `instead` if the deadline has passed.
    ///
    /// # Errors
    /// If the deadline has passed.
    pub fn check(&self, instead: impl FnOnce() -> String) -> anyhow::Result<()> {
        if self.is_over() {
            evidence::note_machine();
            bail!("{}", instead());
        }
        Ok(())
    }

    /// Awaits a future, but not beyond the deadline.
    ///
    /// # Errors
    /// If the deadline has passed.
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

/// Describes the load of the machine, for messages about timeouts.
pub fn describe_slowness() -> String {
    format!("the machine is {:.1} times as slow as it can be", busyness())
}

/// Awaits a future, within the time limit of a story.
///
/// # Errors
/// If the time limit is exceeded.
pub async fn wait_for<F: Future>(future: F) -> anyhow::Result<F::Output> {
    Deadline::begin().limit(future).await
}

/// Waits for the next message of another thread.
///
/// # Errors
/// If nothing arrives in time, or if the other thread has ended.
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

/// A connection with a read timeout.
pub trait ReadTimeout {
    /// Sets the timeout of a read.
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()>;
}

impl ReadTimeout for TcpStream {
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()> {
        self.set_read_timeout(time)
    }
}

impl ReadTimeout for UnixStream {
    fn set_patience(&self, time: Option<Duration>) -> io::Result<()> {
        self.set_read_timeout(time)
    }
}

/// A connection whose reads have the time limit of a story, unless another one is set.
#[derive(Debug)]
pub struct PatientStream<S> {
    stream: S,
    is_limited: bool,
}

impl<S: ReadTimeout> PatientStream<S> {
    /// Wraps a connection.
    ///
    /// # Errors
    /// If the timeout cannot be set.
    pub fn new(stream: S) -> io::Result<Self> {
        stream.set_patience(Some(SLICE))?;
        Ok(Self { stream, is_limited: false })
    }

    /// Sets the time limit of reads; `None` restores the limit of a story.
    ///
    /// # Errors
    /// If the timeout cannot be set.
    pub fn limit(&mut self, time: Option<Duration>) -> io::Result<()> {
        self.is_limited = time.is_some();
        // A timeout of zero would mean none.
        let time = time.map_or(SLICE, |time| time.max(Duration::from_millis(1)));
        self.stream.set_patience(Some(time))
    }

    /// Returns the connection.
    pub fn get(&self) -> &S {
        &self.stream
    }
}

impl<S: Read> Read for PatientStream<S> {
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

impl<S: Write> Write for PatientStream<S> {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.stream.write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}

/// Returns whether an error only means that nothing arrived in time.
pub(crate) fn is_slow(error: &io::Error) -> bool {
    // A signal, such as SIGCHLD, interrupts a read as well.
    let of_waiting = [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted];
    of_waiting.contains(&error.kind())
}

/// Connects to a server on this machine.
///
/// # Errors
/// If nobody listens.
pub fn connect(address: &str) -> anyhow::Result<PatientStream<TcpStream>> {
    let stream = TcpStream::connect(address).with_context(|| address.to_owned())?;
    PatientStream::new(stream).map_err(|error| anyhow!("{address}: {error}"))
}
