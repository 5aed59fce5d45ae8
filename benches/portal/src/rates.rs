//! Throughput in messages per second, with a fixed window in flight, so that the slowest hop determines the rate.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchDaemon, BenchReport, Process, Target, is_full_run};

use crate::contestants::{ClientPath, Encoding, PathTarget, check_message};
use crate::node::{MessageCount, MeterNode, PATIENCE, PublishCredit};
use crate::relay::RelayHops;
use crate::turns::take_turns;

/// Duration of a turn; its first fifth is not counted.
const TURN: Duration = Duration::from_millis(700);
/// Number of small messages in flight: fewer than any queue on the path holds.
const SMALL: u64 = 192;
/// Number of images in flight.
const BIG: u64 = 4;

const JSON: ClientPath = ClientPath::Daemon(Encoding::Json);
const CBOR: ClientPath = ClientPath::Daemon(Encoding::Cbor);
const RAW: ClientPath = ClientPath::Daemon(Encoding::Raw);
/// Paths that every rate is compared with.
const FLOORS: [ClientPath; 3] = [ClientPath::Direct, ClientPath::Bytes, ClientPath::Values];

/// A rate as a multiple of rosbridge_suite's.
#[derive(Clone, Copy)]
enum Multiple {
    PerSecond(f64),
    /// Per second of processor time, of which rosbridge_suite kept one processor busy.
    PerProcessor(f64),
}

/// A path whose rate is measured, with its targets.
struct RateGoal {
    way: ClientPath,
    floor: Option<(ClientPath, f64)>,
    /// Throughput of rosbridge_suite (Python) on a comparable machine, per second.
    suite: Option<f64>,
    multiple: Option<Multiple>,
}

/// Messages in one direction: a title, the topic, and the paths through the daemon.
struct RateCase {
    what: &'static str,
    images: bool,
    inward: Option<&'static str>,
    outward: Option<&'static str>,
    goals: &'static [RateGoal],
}

const fn goal(way: ClientPath, floor: ClientPath, share: f64, suite: f64) -> RateGoal {
    RateGoal { way, floor: Some((floor, share)), suite: Some(suite), multiple: None }
}

const CASES: [RateCase; 4] = [
    RateCase {
        what: "small messages out",
        images: false,
        inward: None,
        outward: Some("/meter/small_out"),
        goals: &[RateGoal {
            multiple: Some(Multiple::PerProcessor(10.0)),
            ..goal(JSON, ClientPath::Direct, 0.7, 10_454.0)
        }],
    },
    RateCase {
        what: "small messages in",
        images: false,
        inward: Some("/meter/small_in"),
        outward: None,
        goals: &[RateGoal {
            multiple: Some(Multiple::PerProcessor(10.0)),
            ..goal(JSON, ClientPath::Direct, 0.7, 8_181.0)
        }],
    },
    RateCase {
        what: "640x480 RGB out",
        images: true,
        inward: None,
        outward: Some("/meter/image_out"),
        goals: &[
            goal(JSON, ClientPath::Bytes, 0.2, 292.0),
            goal(CBOR, ClientPath::Bytes, 0.5, 972.0),
            goal(RAW, ClientPath::Bytes, 0.6, 788.0),
        ],
    },
    RateCase {
        what: "640x480 RGB in",
        images: true,
        inward: Some("/meter/image_in"),
        outward: None,
        goals: &[
            RateGoal { multiple: Some(Multiple::PerSecond(25.0)), ..goal(JSON, ClientPath::Bytes, 0.2, 12.5) },
            RateGoal { way: CBOR, floor: None, suite: None, multiple: None },
            RateGoal { suite: None, ..goal(RAW, ClientPath::Bytes, 0.6, 0.0) },
        ],
    },
];

/// Measures all rates.
pub(crate) fn measure(report: &mut BenchReport, daemon: &BenchDaemon, node: &MeterNode, only: &str) -> Result<()> {
    for case in CASES.iter().filter(|case| case.what.contains(only)) {
        let RateCase { images, inward, outward, .. } = *case;
        let course = PathTarget { daemon, node, hops: RelayHops { images, inward, outward, ..RelayHops::default() } };
        let ways = case.goals.iter().map(|goal| goal.way).chain(FLOORS);
        let mut found: Vec<_> = ways.map(|way| (way, MessageRate::default())).collect();
        measure_in_turns(&course, &mut found, case.what)?;
        for goal in case.goals {
            report_rate(report, case.what, goal, &found);
        }
    }
    Ok(())
}

/// Messages per second at best, and messages and the daemon's processor time in all turns.
#[derive(Debug, Clone, Copy, Default)]
struct MessageRate {
    best: f64,
    messages: u64,
    processor: Duration,
}

fn measure_in_turns(course: &PathTarget<'_>, found: &mut [(ClientPath, MessageRate)], what: &str) -> Result<()> {
    let process = Process::from_pid(course.daemon.pid());
    // One for all turns, because it takes the node a while to connect and disconnect.
    let counter = match (course.hops.outward, course.hops.inward) {
        (Some(topic), _) => Counter::Credit(course.node.credit(topic)?),
        (None, topic) => Counter::Count(course.node.message_count(topic.unwrap_or_default())?),
    };
    take_turns(what, if is_full_run() { 20 } else { 6 }, found, |(way, rate)| {
        let before = process.total_processor_time()?;
        let turn = match &counter {
            Counter::Credit(credit) => measure_outward(course, *way, credit),
            Counter::Count(count) => measure_inward(course, *way, count),
        };
        let (per_second, messages) = turn.with_context(|| format!("{what}, {way}"))?;
        rate.best = rate.best.max(per_second);
        rate.messages += messages;
        rate.processor += process.total_processor_time()? - before;
        Ok(())
    })
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

fn report_rate(report: &mut BenchReport, what: &str, goal: &RateGoal, found: &[(ClientPath, MessageRate)]) {
    let rate =
        |way: ClientPath| found.iter().find(|(other, _)| *other == way).map(|(_, rate)| *rate).unwrap_or_default();
    let (ours, name) = (rate(goal.way), format!("{what}, {}", goal.way));
    for floor in FLOORS {
        let figure = report.figure(name.clone(), "/s", ours.best);
        figure.relative_to(floor.to_string(), rate(floor).best);
        if let Some((_, share)) = goal.floor.filter(|(of, _)| *of == floor) {
            figure.require(Target::RatioAtLeast(share));
        }
    }
    let per_processor = ours.messages as f64 / ours.processor.as_secs_f64().max(0.01);
    let mut figure = report.figure(format!("{name}, per s of the daemon's processor time"), "/s", per_processor);
    if let Some(Multiple::PerSecond(_)) = goal.multiple {
        figure = report.figure(name, "/s", ours.best);
    }
    let Some(suite) = goal.suite else { return };
    figure.relative_to("rosbridge_suite, elsewhere", suite);
    if let Some(Multiple::PerSecond(times) | Multiple::PerProcessor(times)) = goal.multiple {
        figure.require(Target::RatioAtLeast(times));
    }
}
