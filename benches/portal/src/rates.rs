//! How many messages pass in a second. A window of messages is under way, so nothing is dropped and the slowest hop
//! decides.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use bench_servant::{Daemon, full};

use crate::contestants::{Course, Encoding, Way, check};
use crate::node::{Count, Credit, Node, PATIENCE};
use crate::relay::Hops;
use crate::watch::processor;

/// One turn. Its first fifth does not count.
const TURN: Duration = Duration::from_millis(700);
/// Small messages under way: fewer than any queue on the way holds.
const SMALL: u64 = 192;
/// Pictures under way.
const BIG: u64 = 4;

const JSON: Way = Way::Daemon(Encoding::Json);
const CBOR: Way = Way::Daemon(Encoding::Cbor);
const RAW: Way = Way::Daemon(Encoding::Raw);

/// What rosbridge_suite (Python) did on a machine like this, per second; it kept one processor busy.
const ROSBRIDGE: [(&str, Way, f64); 6] = [
    ("small messages out", JSON, 10_454.0),
    ("small messages in", JSON, 8_181.0),
    ("640x480 RGB out", JSON, 292.0),
    ("640x480 RGB out", CBOR, 972.0),
    ("640x480 RGB out", RAW, 788.0),
    ("640x480 RGB in", JSON, 12.5),
];

/// What is to be reached: of the floor, or of rosbridge_suite (per second of processor time where it says so).
struct Goal {
    way: Way,
    floor: Way,
    share: f64,
    times_rosbridge: Option<f64>,
    per_processor: bool,
}

impl Goal {
    fn of(way: Way, share: f64, floor: Way) -> Self {
        Self {
            way,
            floor,
            share,
            times_rosbridge: None,
            per_processor: false,
        }
    }
}

/// All rates.
pub(crate) fn measure(report: &mut Report, daemon: &Daemon, node: &Node, only: &str) -> Result<()> {
    let topic = |images, inward, outward| Hops {
        images,
        inward,
        outward,
        ..Hops::default()
    };
    let tenfold = |share| Goal {
        times_rosbridge: Some(10.0),
        per_processor: true,
        ..Goal::of(JSON, share, Way::Direct)
    };
    let many = Goal {
        times_rosbridge: Some(25.0),
        ..Goal::of(JSON, 0.2, Way::Bytes)
    };
    for (what, hops, ways, goals) in [
        (
            "small messages out",
            topic(false, None, Some("/meter/small_out")),
            vec![JSON, Way::Direct, Way::Bytes, Way::Values],
            vec![tenfold(0.7)],
        ),
        (
            "small messages in",
            topic(false, Some("/meter/small_in"), None),
            vec![JSON, Way::Direct, Way::Bytes, Way::Values],
            vec![tenfold(0.7)],
        ),
        (
            "640x480 RGB out",
            topic(true, None, Some("/meter/image_out")),
            vec![JSON, CBOR, RAW, Way::Direct, Way::Bytes, Way::Values],
            vec![
                Goal::of(JSON, 0.2, Way::Bytes),
                Goal::of(CBOR, 0.5, Way::Bytes),
                Goal::of(RAW, 0.6, Way::Bytes),
            ],
        ),
        (
            "640x480 RGB in",
            topic(true, Some("/meter/image_in"), None),
            vec![JSON, CBOR, RAW, Way::Direct, Way::Bytes, Way::Values],
            vec![many, Goal::of(RAW, 0.6, Way::Bytes)],
        ),
    ] {
        if what.contains(only) {
            let course = Course { daemon, node, hops };
            let found = race(&course, &ways, what)?;
            tell(report, what, &ways, &found, &goals);
        }
    }
    Ok(())
}

/// Messages per second, and per second of the daemon's processor time.
#[derive(Debug, Clone, Copy, Default)]
struct Rate {
    best: f64,
    messages: u64,
    processor: Duration,
}

fn race(course: &Course<'_>, ways: &[Way], what: &str) -> Result<Vec<Rate>> {
    let rounds = if full() { 20 } else { 6 };
    let mut found = vec![Rate::default(); ways.len()];
    // The same for all turns: to come and go takes a node a while.
    let counter = match (course.hops.outward, course.hops.inward) {
        (Some(topic), _) => Counter::Credit(course.node.credit(topic)?),
        (None, topic) => Counter::Count(course.node.count(topic.unwrap_or_default())?),
    };
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        for (way, rate) in ways.iter().zip(&mut found) {
            let before = processor(course.daemon.pid())?;
            let (per_second, messages) = match &counter {
                Counter::Credit(credit) => outward(course, *way, credit),
                Counter::Count(count) => inward(course, *way, count),
            }
            .with_context(|| format!("{what}, {way}"))?;
            rate.best = rate.best.max(per_second);
            rate.messages += messages;
            rate.processor += processor(course.daemon.pid())? - before;
        }
    }
    Ok(found)
}

/// What keeps the window.
enum Counter {
    Credit(Credit),
    Count(Count),
}

fn window(course: &Course<'_>) -> u64 {
    if course.hops.images { BIG } else { SMALL }
}

/// Counts from the end of the first fifth.
struct Clock {
    begun: Instant,
    counted: Option<(Instant, u64)>,
}

impl Clock {
    fn start() -> Self {
        Self {
            begun: Instant::now(),
            counted: None,
        }
    }

    /// The rate, once the turn is over.
    fn rate(&mut self, messages: u64) -> Option<f64> {
        let elapsed = self.begun.elapsed();
        if elapsed < TURN / 5 {
            return None;
        }
        let (since, first) = *self.counted.get_or_insert((Instant::now(), messages));
        (elapsed > TURN).then(|| (messages - first) as f64 / since.elapsed().as_secs_f64())
    }
}

/// The node publishes what it has credit for.
pub(crate) fn outward(course: &Course<'_>, way: Way, credit: &Credit) -> Result<(f64, u64)> {
    let mut open = course.open(way)?;
    credit.pay(1);
    check(way, course.hops.images, &open.line.whole()?)?;
    let window = window(course);
    credit.pay(window as u32);
    let (mut owed, mut messages, mut clock) = (0, 0, Clock::start());
    let rate = loop {
        let got = open.line.receive()?;
        messages += got;
        if let Some(rate) = clock.rate(messages) {
            owed += got;
            break rate;
        }
        owed += got;
        // Not for every message: credit costs the node time too.
        if owed >= window / 4 {
            credit.pay(owed as u32);
            owed = 0;
        }
    };
    let mut under_way = window - owed;
    while under_way > 0 {
        let got = open.line.receive()?;
        ensure!(got <= under_way, "more came than was asked for");
        under_way -= got;
        messages += got;
    }
    course.close(open)?;
    Ok((rate, messages + 1))
}

/// The node tells how many it has received.
fn inward(course: &Course<'_>, way: Way, count: &Count) -> Result<(f64, u64)> {
    let mut open = course.open(way)?;
    let window = window(course);
    // The node counts on: what it says first tells where this turn begins, to the step that it tells in.
    let batch = if course.hops.images { 1 } else { 16 };
    let group = open.message.repeat(batch as usize);
    let before = count.get();
    open.line.send(&group)?;
    let base = wait(count, before)?;
    let (mut sent, mut clock) = (0, Clock::start());
    loop {
        let received = count.get() - base;
        if let Some(rate) = clock.rate(received) {
            let mut now = count.get();
            while now - base < sent {
                now = wait(count, now)?;
            }
            course.close(open)?;
            return Ok((rate, sent + batch));
        }
        if sent - received + batch <= window {
            open.line.send(&group)?;
            sent += batch;
        } else {
            std::thread::park_timeout(Duration::from_millis(100));
            ensure!(
                clock.begun.elapsed() < PATIENCE,
                "{way}: messages were lost"
            );
        }
    }
}

fn wait(count: &Count, before: u64) -> Result<u64> {
    let begun = Instant::now();
    loop {
        let now = count.get();
        if now != before {
            return Ok(now);
        }
        ensure!(
            begun.elapsed() < PATIENCE,
            "the node counts no more than {now}"
        );
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

fn tell(report: &mut Report, what: &str, ways: &[Way], found: &[Rate], goals: &[Goal]) {
    let rate = |way: Way| {
        let at = ways.iter().position(|other| *other == way);
        at.map_or_else(Rate::default, |at| found[at])
    };
    for way in ways.iter().filter(|way| matches!(way, Way::Daemon(_))) {
        let ours = rate(*way);
        let goal = goals.iter().find(|goal| goal.way == *way);
        let name = format!("{what}, {way}");
        for floor in ways.iter().filter(|way| !matches!(way, Way::Daemon(_))) {
            let figure = report.figure(name.clone(), "/s", ours.best);
            figure.beside(floor.to_string(), rate(*floor).best);
            if let Some(goal) = goal.filter(|goal| goal.floor == *floor) {
                figure.reach(Target::RatioAtLeast(goal.share));
            }
        }
        let per_processor = ours.messages as f64 / ours.processor.as_secs_f64().max(0.01);
        let mut per_second = format!("{name}, per s of the daemon's processor time");
        let mut value = per_processor;
        let suite = ROSBRIDGE
            .iter()
            .find(|(title, encoding, _)| *title == what && encoding == way);
        if goal.is_some_and(|goal| !goal.per_processor && goal.times_rosbridge.is_some()) {
            report.figure(per_second, "/s", per_processor);
            (per_second, value) = (name, ours.best);
        }
        let figure = report.figure(per_second, "/s", value);
        if let Some((.., theirs)) = suite {
            figure.beside("rosbridge_suite, elsewhere", *theirs);
            if let Some(times) = goal.and_then(|goal| goal.times_rosbridge) {
                figure.reach(Target::RatioAtLeast(times));
            }
        }
    }
}
