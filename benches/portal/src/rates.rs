//! Throughput in messages per second. A fixed window of messages is in flight, so that none is dropped and the slowest
//! hop determines the rate.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Process, Target, is_full_run};

use crate::contestants::{ClientPath, Encoding, PathTarget, check_message};
use crate::node::{MessageCount, MeterNode, PATIENCE, PublishCredit};
use crate::relay::RelayHops;

/// Duration of a turn; its first fifth is not counted.
const TURN: Duration = Duration::from_millis(700);
/// Number of small messages in flight: fewer than any queue on the path holds.
const SMALL: u64 = 192;
/// Number of images in flight.
const BIG: u64 = 4;

const JSON: ClientPath = ClientPath::Daemon(Encoding::Json);
const CBOR: ClientPath = ClientPath::Daemon(Encoding::Cbor);
const RAW: ClientPath = ClientPath::Daemon(Encoding::Raw);

/// Throughput of rosbridge_suite (Python) on a comparable machine, per second; it kept one processor busy.
const ROSBRIDGE: [(&str, ClientPath, f64); 6] = [
    ("small messages out", JSON, 10_454.0),
    ("small messages in", JSON, 8_181.0),
    ("640x480 RGB out", JSON, 292.0),
    ("640x480 RGB out", CBOR, 972.0),
    ("640x480 RGB out", RAW, 788.0),
    ("640x480 RGB in", JSON, 12.5),
];

/// A required rate: as a fraction of the floor, or as a multiple of rosbridge_suite's (per second of processor time
/// with `per_processor`).
struct RateTarget {
    way: ClientPath,
    floor: ClientPath,
    share: f64,
    times_rosbridge: Option<f64>,
    per_processor: bool,
}

impl RateTarget {
    fn share_of_floor(way: ClientPath, share: f64, floor: ClientPath) -> Self {
        Self { way, floor, share, times_rosbridge: None, per_processor: false }
    }
}

/// Measures all rates.
pub(crate) fn measure(report: &mut BenchReport, daemon: &BenchDaemon, node: &MeterNode, only: &str) -> Result<()> {
    let topic = |images, inward, outward| RelayHops { images, inward, outward, ..RelayHops::default() };
    let tenfold = |share| RateTarget {
        times_rosbridge: Some(10.0),
        per_processor: true,
        ..RateTarget::share_of_floor(JSON, share, ClientPath::Direct)
    };
    let many = RateTarget { times_rosbridge: Some(25.0), ..RateTarget::share_of_floor(JSON, 0.2, ClientPath::Bytes) };
    for (what, hops, ways, goals) in [
        (
            "small messages out",
            topic(false, None, Some("/meter/small_out")),
            vec![JSON, ClientPath::Direct, ClientPath::Bytes, ClientPath::Values],
            vec![tenfold(0.7)],
        ),
        (
            "small messages in",
            topic(false, Some("/meter/small_in"), None),
            vec![JSON, ClientPath::Direct, ClientPath::Bytes, ClientPath::Values],
            vec![tenfold(0.7)],
        ),
        (
            "640x480 RGB out",
            topic(true, None, Some("/meter/image_out")),
            vec![JSON, CBOR, RAW, ClientPath::Direct, ClientPath::Bytes, ClientPath::Values],
            vec![
                RateTarget::share_of_floor(JSON, 0.2, ClientPath::Bytes),
                RateTarget::share_of_floor(CBOR, 0.5, ClientPath::Bytes),
                RateTarget::share_of_floor(RAW, 0.6, ClientPath::Bytes),
            ],
        ),
        (
            "640x480 RGB in",
            topic(true, Some("/meter/image_in"), None),
            vec![JSON, CBOR, RAW, ClientPath::Direct, ClientPath::Bytes, ClientPath::Values],
            vec![many, RateTarget::share_of_floor(RAW, 0.6, ClientPath::Bytes)],
        ),
    ] {
        if what.contains(only) {
            let course = PathTarget { daemon, node, hops };
            let found = measure_in_turns(&course, &ways, what)?;
            report_rates(report, what, &ways, &found, &goals);
        }
    }
    Ok(())
}

/// Messages per second, and messages per second of the daemon's processor time.
#[derive(Debug, Clone, Copy, Default)]
struct MessageRate {
    best: f64,
    messages: u64,
    processor: Duration,
}

fn measure_in_turns(course: &PathTarget<'_>, ways: &[ClientPath], what: &str) -> Result<Vec<MessageRate>> {
    let rounds = if is_full_run() { 20 } else { 6 };
    let mut found = vec![MessageRate::default(); ways.len()];
    let process = Process::from_pid(course.daemon.pid());
    // One for all turns, because it takes the node a while to connect and disconnect.
    let counter = match (course.hops.outward, course.hops.inward) {
        (Some(topic), _) => Counter::Credit(course.node.credit(topic)?),
        (None, topic) => Counter::Count(course.node.message_count(topic.unwrap_or_default())?),
    };
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, rate) in ways.iter().zip(&mut found) {
            let before = process.total_processor_time()?;
            let (per_second, messages) = match &counter {
                Counter::Credit(credit) => measure_outward(course, *way, credit),
                Counter::Count(count) => measure_inward(course, *way, count),
            }
            .with_context(|| format!("{what}, {way}"))?;
            rate.best = rate.best.max(per_second);
            rate.messages += messages;
            rate.processor += process.total_processor_time()? - before;
        }
    }
    Ok(found)
}

/// Source of the flow control that keeps the window full.
enum Counter {
    Credit(PublishCredit),
    Count(MessageCount),
}

fn window_size(course: &PathTarget<'_>) -> u64 {
    if course.hops.images { BIG } else { SMALL }
}

/// Measures the rate from the end of a turn's first fifth.
struct RateTimer {
    begun: Instant,
    counted: Option<(Instant, u64)>,
}

impl RateTimer {
    fn start() -> Self {
        Self { begun: Instant::now(), counted: None }
    }

    /// Returns the rate once the turn is over.
    fn rate(&mut self, messages: u64) -> Option<f64> {
        let elapsed = self.begun.elapsed();
        if elapsed < TURN / 5 {
            return None;
        }
        let (since, first) = *self.counted.get_or_insert((Instant::now(), messages));
        (elapsed > TURN).then(|| (messages - first) as f64 / since.elapsed().as_secs_f64())
    }
}

/// Measures messages from the node, which publishes as many as it has credit for.
pub(crate) fn measure_outward(course: &PathTarget<'_>, way: ClientPath, credit: &PublishCredit) -> Result<(f64, u64)> {
    let mut open = course.open(way)?;
    credit.grant(1);
    check_message(way, course.hops.images, &open.line.read_message()?)?;
    let window = window_size(course);
    credit.grant(window as u32);
    let (mut owed, mut messages, mut clock) = (0, 0, RateTimer::start());
    let rate = loop {
        let got = open.line.receive_messages()?;
        messages += got;
        if let Some(rate) = clock.rate(messages) {
            owed += got;
            break rate;
        }
        owed += got;
        // Not for every message: processing credit costs the node time as well.
        if owed >= window / 4 {
            credit.grant(owed as u32);
            owed = 0;
        }
    };
    let mut under_way = window - owed;
    while under_way > 0 {
        let got = open.line.receive_messages()?;
        ensure!(got <= under_way, "more came than was asked for");
        under_way -= got;
        messages += got;
    }
    course.close(open)?;
    Ok((rate, messages + 1))
}

/// Measures messages to the node, which reports how many it has received.
fn measure_inward(course: &PathTarget<'_>, way: ClientPath, count: &MessageCount) -> Result<(f64, u64)> {
    let mut open = course.open(way)?;
    let window = window_size(course);
    // The node keeps counting across turns: its first report shows where this turn starts, to the precision of its
    // reporting interval.
    let batch = if course.hops.images { 1 } else { 16 };
    let group = open.message.repeat(batch as usize);
    let before = count.get();
    open.line.send(&group)?;
    let base = wait_for_change(count, before)?;
    let (mut sent, mut clock) = (0, RateTimer::start());
    loop {
        let received = count.get() - base;
        if let Some(rate) = clock.rate(received) {
            let mut now = count.get();
            while now - base < sent {
                now = wait_for_change(count, now)?;
            }
            course.close(open)?;
            return Ok((rate, sent + batch));
        }
        if sent - received + batch <= window {
            open.line.send(&group)?;
            sent += batch;
        } else {
            std::thread::park_timeout(Duration::from_millis(100));
            ensure!(clock.begun.elapsed() < PATIENCE, "{way}: messages were lost");
        }
    }
}

fn wait_for_change(count: &MessageCount, before: u64) -> Result<u64> {
    let begun = Instant::now();
    loop {
        let now = count.get();
        if now != before {
            return Ok(now);
        }
        ensure!(begun.elapsed() < PATIENCE, "the node counts no more than {now}");
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

fn report_rates(
    report: &mut BenchReport,
    what: &str,
    ways: &[ClientPath],
    found: &[MessageRate],
    goals: &[RateTarget],
) {
    let rate = |way: ClientPath| {
        let at = ways.iter().position(|other| *other == way);
        at.map_or_else(MessageRate::default, |at| found[at])
    };
    for way in ways.iter().filter(|way| matches!(way, ClientPath::Daemon(_))) {
        let ours = rate(*way);
        let goal = goals.iter().find(|goal| goal.way == *way);
        let name = format!("{what}, {way}");
        for floor in ways.iter().filter(|way| !matches!(way, ClientPath::Daemon(_))) {
            let figure = report.figure(name.clone(), "/s", ours.best);
            figure.relative_to(floor.to_string(), rate(*floor).best);
            if let Some(goal) = goal.filter(|goal| goal.floor == *floor) {
                figure.require(Target::RatioAtLeast(goal.share));
            }
        }
        let per_processor = ours.messages as f64 / ours.processor.as_secs_f64().max(0.01);
        let mut per_second = format!("{name}, per s of the daemon's processor time");
        let mut value = per_processor;
        let suite = ROSBRIDGE.iter().find(|(title, encoding, _)| *title == what && encoding == way);
        if goal.is_some_and(|goal| !goal.per_processor && goal.times_rosbridge.is_some()) {
            report.figure(per_second, "/s", per_processor);
            (per_second, value) = (name, ours.best);
        }
        let figure = report.figure(per_second, "/s", value);
        if let Some((.., theirs)) = suite {
            figure.relative_to("rosbridge_suite, elsewhere", *theirs);
            if let Some(times) = goal.and_then(|goal| goal.times_rosbridge) {
                figure.require(Target::RatioAtLeast(times));
            }
        }
    }
}
