//! Model test of the governor: a camera at its own rate, goals of an action, and two sides that answer as they can,
//! over random periods of good and bad links, slow and silent nodes, lost pictures, new servants, crashes, and pairs
//! that become known late.
//!
//! Properties, matching by stamp and by arrival, with a cold original, a warm one, and none:
//! 1. There is no safe stop while any side answers what it accepts within T_max, however much its node skips.
//! 2. When a node that took every picture starts to skip some, at most one of them counts as late for that, and at most
//!    one safe stop is fired.
//! 3. When no side answers any more, the safe stop comes T_max after the first picture that was not answered; if the
//!    node skipped pictures until then, at the latest T_max after its last answer.
//! 4. By stamp, no picture is answered by both sides. Of a goal, one result is delivered.
//! 5. Each request counts once: as desired, accepted, late, or left out. What is left out changes neither Q nor the
//!    robot's motion.
//! 6. Feedback of a goal comes from one side at a time, and continues after a hand-over.
//! 7. A warm original that answers within a third of T_max steps in before the first request is late.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::{Duration, Instant};

use proptest::prelude::*;
use qos::{
    CorrelationKey, DeliveryVerdict, Effect, Governor, LocalState, OutputAge, QosEvent, QosSla, RequestChannel,
    RequestCounts, Responder, Responders, RetentionLimits, Stamp,
};

const MS: Duration = Duration::from_millis(1);
const T_MAX: u64 = 300;
/// Start time of a cold original, milliseconds.
const STARTS: u64 = 700;
/// Interval between feedback messages, milliseconds.
const FEEDBACK: u64 = 100;

#[derive(Debug, Clone, Copy)]
enum Sent {
    Picture(u32),
    Goal(u32),
}

/// A node with a queue of one picture: the newest replaces the waiting one.
#[derive(Default)]
struct Node {
    takes: u64,
    is_silent: bool,
    /// The newest picture that it was given.
    newest: u32,
    waiting: Option<u32>,
    working: Option<(u32, u64)>,
    goals: BTreeSet<u32>,
}

impl Node {
    fn receive(&mut self, sent: Sent) {
        match sent {
            Sent::Picture(number) => {
                self.newest = self.newest.max(number);
                self.waiting = Some(number);
            }
            Sent::Goal(number) => drop(self.goals.insert(number)),
        }
    }

    /// Advances to millisecond `t` and returns the picture answered then.
    fn step(&mut self, t: u64) -> Option<u32> {
        let done = self.working.take_if(|(_, until)| *until <= t);
        if self.working.is_none() {
            self.working = self.waiting.take().map(|number| (number, t + self.takes));
        }
        done.filter(|_| !self.is_silent).map(|(number, _)| number)
    }

    fn reset(&mut self) {
        (self.waiting, self.working) = (None, None);
        self.goals.clear();
    }
}

struct World {
    governor: Governor<Sent>,
    begin: Instant,
    t: u64,
    is_by_stamp: bool,
    period: u64,
    /// One-way delay between robot and cloud, milliseconds.
    delay: u64,
    /// One-way delay between robot and local original, milliseconds.
    local_delay: u64,
    /// One picture in so many is lost on the way; zero for none.
    loses: u32,
    has_link: bool,
    nodes: [Node; 2],
    up: VecDeque<(u64, Sent)>,
    /// Answers, with the newest picture that the node had been given.
    down: VecDeque<(u64, [u32; 2])>,
    to_local: VecDeque<(u64, Sent)>,
    from_local: VecDeque<(u64, u32)>,
    /// Time at which the local original will be up, and whether it is.
    local_up: Option<u64>,
    is_local_up: bool,
    pictures: u32,
    /// Time at which each picture was published, milliseconds.
    published: Vec<u64>,
    /// By stamp: number of delivered answers of each side.
    delivered: BTreeMap<u32, [u32; 2]>,
    speakers: BTreeMap<u32, Responder>,
    results: BTreeMap<u32, u32>,
    stops: Vec<u64>,
    /// Times at which any side answered a picture.
    heard: Vec<u64>,
    /// The camera is running.
    films: bool,
}

impl World {
    fn new(local: &str, by: &str) -> Self {
        let sla = serde_json::json!({
            "t_desire": 0.1, "t_max": 0.3, "local": local,
            "safe_stop": {"topic": "/cmd_vel", "type": "geometry_msgs/Twist"}
        });
        let begin = Instant::now();
        let mut governor = Governor::new(QosSla::parse(sla).unwrap(), vec![], RetentionLimits::default());
        governor.link_up(begin, false);
        governor.begin(begin);
        let node = || Node { takes: 64, ..Node::default() };
        let mut world = Self {
            governor,
            begin,
            t: 0,
            is_by_stamp: by == "stamp",
            period: 33,
            delay: 0,
            local_delay: 0,
            loses: 0,
            has_link: true,
            nodes: [node(), node()],
            up: VecDeque::new(),
            down: VecDeque::new(),
            to_local: VecDeque::new(),
            from_local: VecDeque::new(),
            local_up: None,
            is_local_up: false,
            pictures: 0,
            published: Vec::new(),
            delivered: BTreeMap::new(),
            speakers: BTreeMap::new(),
            results: BTreeMap::new(),
            stops: Vec::new(),
            heard: Vec::new(),
            films: true,
        };
        world.apply_effects();
        world
    }

    fn with_pairs(local: &str, by: &str) -> Self {
        let mut world = Self::new(local, by);
        world.add_action_pair();
        world.add_picture_pair();
        world
    }

    fn add_picture_pair(&mut self) {
        let by = if self.is_by_stamp { "stamp" } else { "arrival" };
        let pair = format!("/image -> /found by {by}").parse().unwrap();
        self.governor.add_pairs(self.now(), vec![pair]);
    }

    fn add_action_pair(&mut self) {
        let pair = "/walk/goal -> /walk/result, /walk/feedback by goal";
        self.governor.add_pairs(self.now(), vec![pair.parse().unwrap()]);
    }

    fn now(&self) -> Instant {
        self.begin + MS * self.t as u32
    }

    fn counts(&self) -> RequestCounts {
        self.governor.report(self.now()).counts
    }

    fn advance(&mut self, ms: u64) {
        for _ in 0..ms {
            self.t += 1;
            self.step();
        }
    }

    fn step(&mut self) {
        if self.local_up.take_if(|at| *at <= self.t).is_some() {
            self.is_local_up = true;
            self.governor.on_local_state(self.now(), LocalState::Ready);
            self.apply_effects();
        }
        if self.films && self.t % self.period == 0 {
            self.publish_picture();
        }
        while let Some(sent) = pop_arrived(&mut self.up, self.t, self.has_link) {
            self.nodes[0].receive(sent);
        }
        if let Some(number) = self.nodes[0].step(self.t) {
            self.down.push_back((self.t + self.delay, [number, self.nodes[0].newest]));
        }
        while let Some([number, newest]) = pop_arrived(&mut self.down, self.t, self.has_link) {
            let published = self.published[newest as usize - 1];
            self.answer(Responder::Cloud, number, Some(MS * (self.t - published) as u32));
        }
        while let Some(sent) = pop_arrived(&mut self.to_local, self.t, self.is_local_up) {
            self.nodes[1].receive(sent);
        }
        if let Some(number) = self.nodes[1].step(self.t) {
            self.from_local.push_back((self.t + self.local_delay, number));
        }
        while let Some(number) = pop_arrived(&mut self.from_local, self.t, self.is_local_up) {
            self.answer(Responder::Local, number, None);
        }
        if self.t % FEEDBACK == 0 {
            self.send_feedback();
        }
        while self.governor.deadline().is_some_and(|at| at <= self.now()) {
            self.governor.tick(self.now());
        }
        self.apply_effects();
    }

    fn publish_picture(&mut self) {
        self.pictures += 1;
        self.published.push(self.t);
        let topic: Arc<str> = "/image".into();
        let key = self.is_by_stamp.then_some(CorrelationKey::Stamp(Stamp { secs: self.pictures, nsecs: 0 }));
        self.governor.input(self.now(), &topic, key, Sent::Picture(self.pictures));
        self.apply_effects();
    }

    fn send_goal(&mut self, number: u32) {
        let topic: Arc<str> = "/walk/goal".into();
        self.governor.input(self.now(), &topic, Some(goal(number)), Sent::Goal(number));
        self.apply_effects();
    }

    fn answer(&mut self, side: Responder, number: u32, since_input: Option<Duration>) {
        self.heard.push(self.t);
        let key = self.is_by_stamp.then_some(CorrelationKey::Stamp(Stamp { secs: number, nsecs: 0 }));
        let age = OutputAge { since_stamp: Duration::ZERO, since_input };
        if self.governor.output(self.now(), side, "/found", key, age) == DeliveryVerdict::Deliver {
            self.delivered.entry(number).or_default()[side.index()] += 1;
        }
        self.apply_effects();
    }

    fn is_asked(&self, side: Responder) -> bool {
        let sides = self.governor.sides();
        [sides.cloud, sides.local][side.index()]
    }

    fn send_feedback(&mut self) {
        for side in [Responder::Cloud, Responder::Local] {
            let can_speak = [self.has_link, self.is_local_up][side.index()];
            if self.nodes[side.index()].is_silent || !can_speak {
                continue;
            }
            for number in self.nodes[side.index()].goals.clone() {
                let earlier = self.speakers.get(&number).copied();
                let earlier = earlier.filter(|earlier| self.is_asked(*earlier));
                let may_speak = self.is_asked(side) || self.governor.sides() == Responders::default();
                let is_heard = may_speak && earlier.is_none_or(|earlier| earlier == side);
                let is_told = self.publish_for_goal(side, "/walk/feedback", number);
                assert_eq!(is_told, is_heard, "goal {number}, {side:?} after {earlier:?}");
                if is_heard {
                    self.speakers.insert(number, side);
                }
            }
        }
    }

    /// Publishes a message of a goal from one side. Returns true if it is delivered.
    fn publish_for_goal(&mut self, side: Responder, topic: &str, number: u32) -> bool {
        let key = Some(goal(number));
        let verdict = self.governor.output(self.now(), side, topic, key, Duration::ZERO);
        self.apply_effects();
        verdict == DeliveryVerdict::Deliver
    }

    fn finish_goal(&mut self, side: Responder, number: u32) {
        if self.nodes[side.index()].goals.remove(&number) && self.is_asked(side) {
            let is_told = self.publish_for_goal(side, "/walk/result", number);
            *self.results.entry(number).or_default() += u32::from(is_told);
        }
    }

    fn apply_effects(&mut self) {
        while let Some(effect) = self.governor.next_effect() {
            match effect {
                Effect::Give { side, payload, channel: RequestChannel::Topic(_), .. } => match side {
                    Responder::Cloud => {
                        let is_lost = matches!(payload, Sent::Picture(number)
                            if self.loses > 0 && number % self.loses == 0);
                        if !is_lost {
                            self.up.push_back((self.t + self.delay, payload));
                        }
                    }
                    Responder::Local => self.to_local.push_back((self.t + self.local_delay, payload)),
                },
                Effect::Event(QosEvent::Start(_)) => self.local_up = Some(self.t + STARTS),
                Effect::Event(QosEvent::Stop(_)) => self.stop_local(),
                Effect::SafeStop => self.stops.push(self.t),
                _ => {}
            }
        }
    }

    fn stop_local(&mut self) {
        (self.local_up, self.is_local_up) = (None, false);
        self.nodes[1].reset();
        self.to_local.clear();
        self.from_local.clear();
    }

    fn cut_link(&mut self) {
        self.has_link = false;
        self.governor.link_down(self.now());
        self.apply_effects();
    }

    fn restore_link(&mut self, resumed: bool) {
        self.has_link = true;
        if !resumed {
            self.up.clear();
            self.down.clear();
            self.nodes[0].reset();
        }
        self.governor.link_up(self.now(), resumed);
        self.apply_effects();
    }
}

/// Pops the first message that has arrived by `t`, if the path is open.
fn pop_arrived<T>(way: &mut VecDeque<(u64, T)>, t: u64, is_open: bool) -> Option<T> {
    let (at, _) = way.front()?;
    if !is_open || *at > t {
        return None;
    }
    way.pop_front().map(|(_, sent)| sent)
}

fn goal(number: u32) -> CorrelationKey {
    CorrelationKey::Goal(format!("goal {number}").into())
}

#[test]
fn a_node_that_takes_64_ms_of_a_30_hz_camera_keeps_its_promise_by_the_cloud() {
    for (by, delay) in [("stamp", 0), ("stamp", 90), ("arrival", 0), ("arrival", 90)] {
        let mut world = World::with_pairs("none", by);
        world.delay = delay;
        world.advance(10_000);
        let counts = world.counts();
        println!("{by}, {delay} ms each way: {counts:?}");
        assert_eq!((counts.late, counts.safe_stops), (0, 0), "{by}, {delay}: {counts:?}");
        assert!(counts.desired + counts.accepted > 100, "{by}, {delay}: {counts:?}");
    }
}

#[test]
fn offline_a_warm_original_that_answers_in_time_stops_nobody() {
    for (by, period, takes) in [("arrival", 50, 40), ("arrival", 33, 64), ("stamp", 50, 40), ("stamp", 33, 64)] {
        let mut world = World::with_pairs("warm", by);
        world.period = period;
        world.nodes[1].takes = takes;
        world.advance(3000);
        world.cut_link();
        // Q needs two late requests: by arrival they come one after the other.
        world.advance(3 * T_MAX);
        let begun = world.stops.len();
        world.advance(10_000);
        let counts = world.counts();
        println!("{by}, {period} ms: {begun} stops until the hand-over; {counts:?}");
        assert_eq!(world.stops.len(), begun, "{by}, {period}: {counts:?}");
        world.restore_link(true);
        world.advance(3000);
        assert_eq!(world.stops.len(), begun, "{by}, {period}: {counts:?}");
    }
}

#[test]
fn a_warm_original_steps_in_before_the_first_request_is_late() {
    for (by, takes) in [("stamp", 10), ("stamp", 64), ("stamp", 100), ("arrival", 10), ("arrival", 64)] {
        let mut world = World::with_pairs("warm", by);
        world.nodes[1].takes = takes;
        world.advance(3000);
        assert_eq!(world.counts().from_local, 0, "{by}, {takes} ms: the cloud answers in time");
        for _ in 0..5 {
            world.cut_link();
            world.advance(3000);
            world.restore_link(true);
            world.advance(3000);
        }
        let counts = world.counts();
        println!("{by}, {takes} ms: {counts:?}");
        assert!(counts.late >= 5 && counts.from_local > 100, "{by}, {takes} ms: {counts:?}");
        assert_eq!((counts.unanswered_in_time, counts.safe_stops), (0, 0), "{by}, {takes} ms: {counts:?}");
        let twice = world.delivered.iter().find(|(_, by)| by[0] + by[1] > 1);
        assert_eq!(twice, None, "{by}, {takes} ms");
    }
}

#[test]
fn by_arrival_no_picture_is_answered_twice_around_a_cut() {
    for (delay, takes) in [(0, 64), (20, 64), (60, 64), (20, 40), (20, 100), (20, 20)] {
        for offset in 0..66 {
            let mut world = World::with_pairs("warm", "arrival");
            (world.delay, world.local_delay, world.nodes[1].takes) = (delay, 2, takes);
            world.advance(2000 + offset);
            for _ in 0..3 {
                world.cut_link();
                world.advance(1500);
                let heard = world.heard.last().is_some_and(|at| world.t - at < T_MAX);
                assert!(heard, "{delay} ms each way, {takes} ms, cut at {offset} ms: the original does not answer");
                world.restore_link(true);
                world.advance(1500 + offset);
            }
            let twice = world.delivered.iter().find(|(_, by)| by[0] + by[1] > 1);
            assert_eq!(twice, None, "{delay} ms each way, {takes} ms, cut at {offset} ms");
            assert_eq!(world.counts().safe_stops, 0, "{delay} ms each way, {takes} ms, cut at {offset} ms");
        }
    }
}

#[test]
fn who_takes_every_picture_and_falls_silent_is_stopped_for_at_t_max() {
    let mut world = World::with_pairs("none", "stamp");
    (world.delay, world.nodes[0].takes) = (50, 10);
    world.advance(10_000);
    assert_eq!(world.counts().safe_stops, 0);
    world.nodes[0].is_silent = true;
    world.advance(1000);
    // Answers in flight still arrived.
    let answered = *world.delivered.keys().last().unwrap();
    let due = u64::from(answered + 1) * world.period + T_MAX + 1;
    assert_eq!(world.stops[0], due, "after picture {answered}");
}

#[test]
fn who_answers_everything_too_late_stops_the_robot() {
    for takes in [10, 64] {
        let mut world = World::with_pairs("none", "stamp");
        (world.delay, world.nodes[0].takes) = (225, takes);
        world.advance(10_000);
        let counts = world.counts();
        assert!(counts.safe_stops > 100 && counts.unanswered_in_time > 100, "{takes} ms: {counts:?}");
    }
}

#[test]
fn a_node_that_becomes_slow_is_late_once_at_most() {
    for takes in [40, 64, 100, 130] {
        let mut world = World::with_pairs("none", "stamp");
        (world.delay, world.nodes[0].takes) = (20, 10);
        world.advance(10_000);
        assert_eq!(world.counts().left_out, 0);
        world.nodes[0].takes = takes;
        world.advance(10_000);
        let counts = world.counts();
        println!("{takes} ms: {counts:?}");
        let is_calm = counts.late <= 1 && counts.safe_stops <= 1;
        assert!(is_calm && counts.left_out > 10, "{takes} ms: {counts:?}");
    }
}

#[test]
fn feedback_goes_on_after_a_hand_over_and_a_long_goal_stops_nobody() {
    let mut world = World::with_pairs("warm", "arrival");
    world.send_goal(1);
    world.advance(60_000);
    assert_eq!(world.speakers[&1], Responder::Cloud);
    let counts = world.counts();
    let trouble = (counts.late, counts.safe_stops, counts.failed);
    assert_eq!(trouble, (1, 0, 0), "{counts:?}");
    world.cut_link();
    world.advance(2000);
    assert_eq!(world.speakers[&1], Responder::Local, "it was given the goal");
    world.restore_link(true);
    world.advance(5000);
    assert_eq!(world.speakers[&1], Responder::Cloud);
    world.advance(300_000);
    world.finish_goal(Responder::Cloud, 1);
    world.finish_goal(Responder::Local, 1);
    assert_eq!(world.results[&1], 1);
}

/// A period with constant conditions.
#[derive(Debug, Clone)]
struct Times {
    length: u64,
    link: Link,
    is_silent: bool,
    delay: u64,
    takes: [u64; 2],
    loses: u32,
    crashes: bool,
    sends_goal: bool,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Link {
    Up,
    Renewed,
    Cut,
}

fn any_times() -> impl Strategy<Value = Times> {
    let link = prop_oneof![6 => Just(Link::Up), 1 => Just(Link::Renewed), 2 => Just(Link::Cut)];
    let takes = || prop_oneof![5u64..30, 30u64..130];
    let loses = prop_oneof![3 => Just(0u32), 1 => 2u32..12];
    let chances = [6.0, 8.0, 4.0].map(|one_of| prop::bool::weighted(1.0 / one_of));
    let numbers = (300u64..2500, 0u64..150, [takes(), takes()], loses);
    (numbers, link, chances).prop_map(|((length, delay, takes, loses), link, chances)| {
        let [is_silent, crashes, sends_goal] = chances;
        Times { length, link, is_silent, delay, takes, loses, crashes, sends_goal }
    })
}

impl Times {
    /// The final period: everything works, and the camera is off.
    const END: Self = Self {
        length: 0,
        link: Link::Up,
        is_silent: false,
        delay: 0,
        takes: [10; 2],
        loses: 0,
        crashes: false,
        sends_goal: false,
    };

    /// Returns true if the side answers accepted pictures within T_max, allowing for skipped and lost ones.
    fn answers_in_time(&self, period: u64, side: Responder) -> bool {
        let takes = 2 * self.takes[side.index()] + period;
        if side == Responder::Local {
            return takes <= T_MAX;
        }
        let is_there = self.link != Link::Cut && !self.is_silent;
        let lost = if self.loses > 0 { 2 * period } else { 0 };
        is_there && 2 * self.delay + takes + lost <= T_MAX
    }
}

impl World {
    fn enter(&mut self, times: &Times) {
        match times.link {
            Link::Cut if self.has_link => self.cut_link(),
            Link::Up if !self.has_link => self.restore_link(true),
            Link::Renewed => {
                self.cut_link();
                self.restore_link(false);
            }
            _ => {}
        }
        self.nodes[0].is_silent = times.is_silent;
        (self.delay, self.loses) = (times.delay, times.loses);
        for side in 0..2 {
            self.nodes[side].takes = times.takes[side];
        }
        if times.crashes && self.is_local_up {
            self.stop_local();
            self.local_up = Some(self.t + STARTS);
            self.governor.on_local_crash(self.now(), "signal 11");
            self.apply_effects();
        }
    }

    /// Runs one period, and checks that no safe stop is fired while a side answers.
    fn run_period(&mut self, times: &Times) -> Result<(), TestCaseError> {
        self.enter(times);
        let (settled, ends) = (self.t + 2 * T_MAX, self.t + times.length);
        let mut is_stood_in_for = times.answers_in_time(self.period, Responder::Local);
        while self.t < ends {
            self.advance(1);
            is_stood_in_for &= self.is_asked(Responder::Local);
        }
        let answers = is_stood_in_for || times.answers_in_time(self.period, Responder::Cloud);
        let mut stops = self.stops.iter().filter(|at| **at > settled);
        let stop = stops.next().filter(|_| answers);
        prop_assert!(stop.is_none(), "{:?} in {:?}, until {}", stop, times, ends);
        Ok(())
    }

    /// Checks that every silence led to a safe stop.
    fn check_safe_stops(&self, since: u64) -> Result<(), TestCaseError> {
        let t_max = if self.is_by_stamp { T_MAX } else { 2 * T_MAX };
        let patience = t_max + 3 * self.period;
        let heard = self.heard.iter().copied().filter(|at| *at > since);
        let mut from = since;
        for until in heard.chain([self.t]) {
            let mut stops = self.stops.iter();
            let stopped = stops.any(|at| (from..=from + patience).contains(at));
            let is_short = until - from <= patience;
            prop_assert!(is_short || stopped, "silence from {} to {}", from, until);
            from = until;
        }
        Ok(())
    }
}

/// Runs a sequence of periods. `known` are the indices of the periods before which the pairs of the action and of the
/// pictures become known.
fn run_story(world: &mut World, all: &[Times], known: [usize; 2]) -> Result<(), TestCaseError> {
    let (mut goals, mut since) = (0, None);
    for (index, times) in all.iter().enumerate() {
        if index == known[0] {
            world.add_action_pair();
        }
        if index == known[1] {
            since = Some(world.t);
            world.add_picture_pair();
        }
        if times.sends_goal && index >= known[0] {
            goals += 1;
            world.send_goal(goals);
        }
        world.run_period(times)?;
    }
    if let Some(since) = since {
        world.check_safe_stops(since)?;
    }
    world.enter(&Times::END);
    world.films = false;
    world.advance(2000);
    for number in 1..=goals {
        world.finish_goal(Responder::Cloud, number);
        world.finish_goal(Responder::Local, number);
        prop_assert_eq!(world.results.get(&number), Some(&1), "goal {}", number);
    }
    world.advance(2 * T_MAX);
    if world.is_by_stamp && since == Some(0) {
        let mut answered = world.delivered.iter();
        let twice = answered.find(|(_, by)| by[0] + by[1] > 1);
        prop_assert!(twice.is_none(), "answered twice: {:?}", twice);
    }
    let counts = world.counts();
    let counted = counts.desired + counts.accepted + counts.late + counts.left_out;
    prop_assert_eq!(counted, counts.requests, "{:?}", counts);
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(200) })]
    #[test]
    fn whatever_happens(
        all in prop::collection::vec(any_times(), 1..10),
        local in prop_oneof![Just("cold"), Just("warm"), Just("none")],
        by in prop_oneof![Just("stamp"), Just("arrival")],
        period in prop_oneof![Just(33u64), Just(50), Just(200)],
        known in prop_oneof![Just([0, 0]), Just([0, 1]), Just([1, 0]), Just([2, 1])],
    ) {
        let mut world = World::new(local, by);
        world.period = period;
        run_story(&mut world, &all, known)?;
    }
}
