//! A camera of 30 Hz, a node that takes 64 ms and leaves out the other pictures, commands, a goal of minutes and a node
//! that prints: through good, slow, lossy and cut links, with a cold and a warm local original and with none.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Target, quantile};
use bytes::Bytes;
use nix::sys::signal::Signal;
use parking_lot::Mutex;
use ros::bus::{
    ActionClient, Bus, GoalEnd, GoalError, GoalEvents, GoalOutcome, Graph, Publisher, QosProfile, RosVersion,
    SerializedMessage, Subscription, WireType,
};
use ros::schema::Registry;
use support::cable::{Cable, NetworkImpairment, run_in_namespace};
use support::daemon::Daemon;
use support::layout::MessageLayout;
use support::people::{number, type_of};
use support::site::{NodeProcess, Site};
use tokio::time::{Instant as At, interval, sleep_until, timeout};

const PACKAGE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/camera_node");
const PROGRAM: &str = "/opt/cloudroid/install/lib/camera_node/camera_node.py";
/// Longest accepted response time, seconds.
const T_MAX: f64 = 0.4;
/// Cap of Q, twice the threshold: the first late request hands over to the local original.
const CAP: f64 = 8.0;
/// Interval between two pictures.
const PERIOD: Duration = Duration::from_nanos(33_333_333);
/// Interval between two commands.
const COMMANDS: Duration = Duration::from_millis(100);
/// Bytes of a compressed picture.
const PICTURE: usize = 30_000;
/// The stamps of pictures are greater than this number of seconds.
const FIRST: u32 = 1000;
/// Maximum time to wait for anything that is not measured.
const PATIENCE: Duration = Duration::from_secs(120);
/// Length of the goal, seconds.
const GOAL: u32 = 300;
/// Lines a second that the busy node prints, what each begins with, and the topics that it registers.
const LINES: u32 = 10_000;
const LINE: &str = "line ";
const TOPICS: u32 = 200;

/// A period in which the network has one quality.
#[derive(PartialEq)]
struct NetworkPhase {
    name: &'static str,
    impairment: Option<NetworkImpairment>,
    seconds: u64,
}

const fn lossy(delay: u32, jitter: u32, loss: f64, rate: u32) -> Option<NetworkImpairment> {
    Some(NetworkImpairment { rate, delay, jitter, loss, limit: 1000 })
}

const GOOD: NetworkPhase = NetworkPhase { name: "good", impairment: None, seconds: 8 };
/// Carries half of what the camera sends, behind a router that queues 150 ms.
const SLOW: NetworkPhase = NetworkPhase {
    name: "4 Mbit/s",
    impairment: Some(NetworkImpairment { rate: 4000, delay: 20, jitter: 0, loss: 0.0, limit: 50 }),
    seconds: 15,
};
const CUT: NetworkPhase = NetworkPhase { name: "cut", impairment: lossy(0, 0, 1.0, 100_000), seconds: 10 };
/// A good network after a bad one: at first connections still catch up.
const RESTORED: NetworkPhase = NetworkPhase { name: "good again", ..GOOD };
/// The phases of a round.
const ROUND: [NetworkPhase; 11] = [
    GOOD,
    SLOW,
    RESTORED,
    NetworkPhase { name: "80±20 ms, 2 % lost", impairment: lossy(80, 20, 0.02, 100_000), seconds: 15 },
    RESTORED,
    NetworkPhase { name: "150±50 ms, 5 % lost", impairment: lossy(150, 50, 0.05, 100_000), seconds: 15 },
    RESTORED,
    NetworkPhase { name: "300±100 ms, 10 % lost, 500 kbit/s", impairment: lossy(300, 100, 0.1, 500), seconds: 15 },
    RESTORED,
    CUT,
    RESTORED,
];
/// Follow the round of a warm original [`CUTS`] times, because one hand-over has no percentiles.
const FURTHER_CUT: [NetworkPhase; 2] = [NetworkPhase { seconds: 3, ..CUT }, NetworkPhase { seconds: 5, ..RESTORED }];
const CUTS: usize = 10;

/// One run.
struct CameraPlan {
    name: &'static str,
    /// Topic of the answers: `/found` has the picture's stamp, `/count` has none.
    answers: &'static str,
    local: &'static str,
    /// True if the node prints 10,000 lines a second and registers 200 topics, and the robot sends a goal of 5 minutes.
    is_busy: bool,
    /// How often the phases are repeated.
    rounds: usize,
}

const PLANS: [CameraPlan; 7] = [
    plan("by stamp, cloud alone", "/found", "none"),
    plan("by stamp, cold original", "/found", "cold"),
    plan("by stamp, warm original", "/found", "warm"),
    plan("by arrival, cloud alone", "/count", "none"),
    plan("by arrival, cold original", "/count", "cold"),
    plan("by arrival, warm original", "/count", "warm"),
    CameraPlan {
        name: "5-minute goal, 10,000 lines/s, 200 topics",
        answers: "/found",
        local: "warm",
        is_busy: true,
        rounds: 3,
    },
];

const fn plan(name: &'static str, answers: &'static str, local: &'static str) -> CameraPlan {
    CameraPlan { name, answers, local, is_busy: false, rounds: 1 }
}

impl CameraPlan {
    fn phases(&self) -> impl Iterator<Item = &'static NetworkPhase> {
        let cuts = if self.local == "warm" && !self.is_busy { CUTS } else { 0 };
        let rounds = std::iter::repeat_n(&ROUND, self.rounds).flatten();
        let cuts = std::iter::repeat_n(&FURTHER_CUT, cuts).flatten();
        // Both end with a good network, so that everything that was sent can still be answered.
        rounds.chain(cuts)
    }
}

#[derive(Clone, Copy)]
struct Picture {
    sent: Instant,
    answers: usize,
}

/// A command, or a message of the plain connection.
#[derive(Clone, Copy)]
struct RoundTrip {
    sent: Instant,
    after: Option<Duration>,
}

/// What a run recorded.
struct CameraRecord {
    pictures: Vec<Picture>,
    /// When answers arrived, and to which picture.
    answered: Vec<(Instant, usize)>,
    commands: Vec<RoundTrip>,
    stops: Vec<Instant>,
    /// Begin of each phase.
    phases: Vec<(Instant, &'static NetworkPhase)>,
    end: Instant,
}

impl CameraRecord {
    /// Returns the phase at this time.
    fn phase_at(&self, at: Instant) -> Option<&'static NetworkPhase> {
        let begun = self.phases.iter().rev().find(|(begin, _)| *begin <= at);
        begun.map(|(_, phase)| *phase)
    }

    /// Returns, for each onset of a phase, the seconds until an answer arrived to a picture sent after the onset.
    fn seconds_to_answer(&self, name: &str) -> Vec<f64> {
        let onsets = self.phases.iter().filter(|(_, phase)| phase.name == name);
        onsets
            .map(|(onset, _)| {
                let first = self.pictures.partition_point(|picture| picture.sent < *onset);
                let answer = self.answered.iter().find(|(_, picture)| *picture >= first);
                answer.map_or(f64::INFINITY, |(at, _)| at.duration_since(*onset).as_secs_f64())
            })
            .collect()
    }

    /// Counts pictures that count as late on the robot: neither they nor later ones were answered by anybody within
    /// T_max, or, if an answer came meanwhile, within T_max of that (docs/robots.md, "Skipped inputs").
    fn count_late(&self) -> usize {
        let t_max = Duration::from_secs_f64(T_MAX);
        let mut first_answers: Vec<Option<Instant>> = vec![None; self.pictures.len()];
        for (at, picture) in &self.answered {
            first_answers[*picture].get_or_insert(*at);
        }
        let (mut late, mut earliest) = (0, None::<Instant>);
        for (picture, answer) in self.pictures.iter().zip(first_answers).rev() {
            earliest = earliest.into_iter().chain(answer).min();
            let due = picture.sent + t_max;
            let heard = self.answered.partition_point(|(at, _)| *at <= due).checked_sub(1);
            let heard = heard.map(|last| self.answered[last].0).filter(|at| *at >= picture.sent);
            let due = heard.map_or(due, |heard| heard + t_max);
            late += usize::from(due <= self.end && earliest.is_none_or(|at| at > due));
        }
        late
    }

    /// Counts safe stops that came although an answer had arrived within T_max before.
    fn count_wrong_stops(&self) -> usize {
        let is_wrong = |stop: &&Instant| {
            let earlier = self.answered.iter().rev().find(|(at, _)| at <= *stop);
            earlier.is_some_and(|(at, picture)| {
                let response = at.duration_since(self.pictures[*picture].sent).as_secs_f64();
                response <= T_MAX && stop.duration_since(*at).as_secs_f64() < T_MAX
            })
        };
        self.stops.iter().filter(is_wrong).count()
    }
}

/// A plain TCP connection through the cable whose messages are sent back: the floor for commands.
struct EchoFloor {
    trips: Arc<Mutex<Vec<RoundTrip>>>,
    over: Arc<AtomicBool>,
}

impl EchoFloor {
    fn start(cable: &Cable) -> Result<Self> {
        let address = (cable.server.ip(), 0);
        let listener = run_in_namespace(&cable.namespace(), || TcpListener::bind(address))??;
        let server = listener.local_addr()?;
        std::thread::spawn(move || {
            let Ok((mut stream, _)) = listener.accept() else {
                return;
            };
            let _ = stream.set_nodelay(true);
            let mut message = [0; 4];
            while stream.read_exact(&mut message).is_ok() && stream.write_all(&message).is_ok() {}
        });
        let mut stream = TcpStream::connect(server)?;
        stream.set_nodelay(true)?;
        let mut answers = stream.try_clone()?;
        let (trips, over) = (Arc::new(Mutex::new(Vec::new())), Arc::new(AtomicBool::new(false)));
        let (sent, ending) = (Arc::clone(&trips), Arc::clone(&over));
        std::thread::spawn(move || {
            while !ending.load(Ordering::Relaxed) {
                let trip = RoundTrip { sent: Instant::now(), after: None };
                sent.lock().push(trip);
                if stream.write_all(&[0; 4]).is_err() {
                    return;
                }
                std::thread::sleep(COMMANDS);
            }
            let _ = stream.shutdown(std::net::Shutdown::Both);
        });
        let received = Arc::clone(&trips);
        std::thread::spawn(move || {
            let mut message = [0; 4];
            let mut next = 0;
            while answers.read_exact(&mut message).is_ok() {
                let mut trips = received.lock();
                let trip: &mut RoundTrip = &mut trips[next];
                trip.after = Some(trip.sent.elapsed());
                next += 1;
            }
        });
        Ok(Self { trips, over })
    }
}

impl Drop for EchoFloor {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
    }
}

/// Counts what becomes of the goal.
#[derive(Default)]
struct GoalRecord {
    feedback: AtomicUsize,
    ends: Mutex<Vec<Option<GoalOutcome>>>,
}

impl GoalEvents for GoalRecord {
    fn on_feedback(&self, _feedback: Bytes) {
        self.feedback.fetch_add(1, Ordering::Relaxed);
    }

    fn on_ended(&self, end: Result<GoalEnd, GoalError>) {
        self.ends.lock().push(end.ok().map(|end| end.outcome));
    }
}

/// The robot's own nodes.
struct CameraRobot {
    // Fields are in the order in which they must be dropped.
    found: Subscription,
    echo: Subscription,
    stops: Subscription,
    image: Box<dyn Publisher>,
    command: Box<dyn Publisher>,
    node: Arc<dyn Bus>,
    _wheels: Arc<dyn Bus>,
}

impl CameraRobot {
    fn new(site: &Site, plan: &CameraPlan) -> Result<Self> {
        let (node, wheels) = (site.join("/camera")?, site.join("/wheels")?);
        let text = "std_msgs/Header header\nstring format\nuint8[] data\n";
        let picture = type_of(RosVersion::One, "sensor_msgs/CompressedImage", text)?;
        let advertise = |topic: &str, of: WireType, queue: usize| {
            let made = node.advertise(topic, of, QosProfile::keep_last(queue));
            site.runtime.block_on(made)
        };
        let image = advertise("/image", picture, 1)?;
        let integer = type_of(RosVersion::One, "std_msgs/UInt32", "uint32 data\n")?;
        let command = advertise("/command", integer, 100)?;
        let (found, echo) = (site.subscribe(&node, plan.answers)?, site.subscribe(&node, "/echo")?);
        let stops = site.subscribe(&wheels, "/cmd_vel")?;
        site.wait_for_subscribers(&*image, 1)?;
        site.wait_for_subscribers(&*command, 1)?;
        Ok(Self { found, echo, stops, image, command, node, _wheels: wheels })
    }

    fn publish_picture(&self, number: u32) {
        let mut out = MessageLayout::new(RosVersion::One);
        let pixels = make_pixels(number);
        let message = out.header(number, "camera").text("jpeg").bytes(&pixels).finish();
        self.image.publish(message);
    }

    /// Sends pictures until ten answers in a row have arrived within T_max.
    async fn warm_up(&mut self) -> Result<()> {
        let (begun, mut in_time) = (Instant::now(), 0);
        let mut number = 1;
        while in_time < 10 {
            ensure!(begun.elapsed() < PATIENCE, "the first pictures are not answered in time");
            self.publish_picture(number);
            let asked = Instant::now();
            let answer = timeout(Duration::from_secs(2), self.found.messages.recv()).await;
            let is_in_time = answer.is_ok() && asked.elapsed().as_secs_f64() <= T_MAX;
            in_time = if is_in_time { in_time + 1 } else { 0 };
            number += 1;
        }
        tokio::time::sleep(Duration::from_secs(2)).await;
        while self.found.messages.try_recv().is_some() {}
        while self.stops.messages.try_recv().is_some() {}
        Ok(())
    }

    async fn measure(&mut self, cable: &Cable, plan: &CameraPlan) -> Result<CameraRecord> {
        let mut record = CameraRecord {
            pictures: Vec::new(),
            answered: Vec::new(),
            commands: Vec::new(),
            stops: Vec::new(),
            phases: Vec::new(),
            end: Instant::now(),
        };
        let (mut camera, mut commands) = (interval(PERIOD), interval(COMMANDS));
        for phase in plan.phases() {
            match phase.impairment {
                Some(impairment) => cable.degrade(impairment)?,
                None => cable.restore()?,
            }
            record.phases.push((Instant::now(), phase));
            let end = At::now() + Duration::from_secs(phase.seconds);
            loop {
                tokio::select! {
                    () = sleep_until(end) => break,
                    _ = camera.tick() => {
                        self.publish_picture(FIRST + record.pictures.len() as u32);
                        record.pictures.push(Picture { sent: Instant::now(), answers: 0 });
                    }
                    _ = commands.tick() => {
                        let number = record.commands.len() as u32;
                        self.command.publish(number.to_le_bytes().to_vec().into());
                        record.commands.push(RoundTrip { sent: Instant::now(), after: None });
                    }
                    Some(answer) = self.found.messages.recv() => record_answer(&mut record, plan, &answer),
                    Some(echo) = self.echo.messages.recv() => record_echo(&mut record, &echo),
                    Some(_) = self.stops.messages.recv() => record.stops.push(Instant::now()),
                }
            }
        }
        record.end = Instant::now();
        Ok(record)
    }
}

/// Returns bytes that no codec makes fewer, as those of a compressed picture.
fn make_pixels(number: u32) -> Vec<u8> {
    let mut word = u64::from(number) + 1;
    let words = std::iter::repeat_with(|| {
        // xorshift64
        word ^= word << 13;
        word ^= word >> 7;
        word ^= word << 17;
        word.to_le_bytes()
    });
    words.flatten().take(PICTURE).collect()
}

fn read_integer(message: &SerializedMessage) -> Option<u32> {
    let word = message.bytes.get(..4)?.try_into().ok()?;
    Some(u32::from_le_bytes(word))
}

fn record_answer(record: &mut CameraRecord, plan: &CameraPlan, answer: &SerializedMessage) {
    let number = if plan.answers == "/found" { number(answer) } else { read_integer(answer) };
    let index = number.and_then(|number| number.checked_sub(FIRST));
    let Some(index) = index.map(|index| index as usize) else {
        return;
    };
    if let Some(picture) = record.pictures.get_mut(index) {
        picture.answers += 1;
        record.answered.push((Instant::now(), index));
    }
}

fn record_echo(record: &mut CameraRecord, echo: &SerializedMessage) {
    let index = read_integer(echo).map(|index| index as usize);
    if let Some(command) = index.and_then(|index| record.commands.get_mut(index)) {
        command.after.get_or_insert(command.sent.elapsed());
    }
}

/// Measures all runs; `CLOUDROID_BENCH_RUN` selects those whose name contains it.
pub fn measure(report: &mut BenchReport, daemon: &Daemon, cable: &Cable) -> Result<()> {
    let words = ["push", PACKAGE, "--node", "camera_node.py"];
    daemon.deployer().run(&words)?.expect_success()?;
    let only = std::env::var("CLOUDROID_BENCH_RUN").unwrap_or_default();
    for plan in PLANS.iter().filter(|plan| plan.name.contains(&only)) {
        eprintln!("camera: {}", plan.name);
        run(report, daemon, cable, plan).with_context(|| plan.name.to_owned())?;
        cable.restore()?;
        let stopped = daemon.deployer().run(&["stop", "--all"])?;
        stopped.expect_success()?;
    }
    Ok(())
}

fn run(report: &mut BenchReport, daemon: &Daemon, cable: &Cable, plan: &CameraPlan) -> Result<()> {
    let site = Site::new()?;
    let mut stub = start_stub(&site, daemon, cable, plan)?;
    let mut robot = CameraRobot::new(&site, plan).with_context(|| stub.output())?;
    let floor = EchoFloor::start(cable)?;
    let goal = Arc::new(GoalRecord::default());
    let client = plan.is_busy.then(|| send_goal(&site, &robot, &goal)).transpose()?;
    let measured = site.runtime.block_on(async {
        robot.warm_up().await?;
        let before = resident_kilobytes(stub.pid())?;
        let record = robot.measure(cable, plan).await?;
        Ok::<_, anyhow::Error>((record, before))
    });
    let (record, before) = measured.with_context(|| stub.output())?;
    let after = resident_kilobytes(stub.pid())?;
    let has_topics = plan.is_busy && has_all_topics(&site, &robot);
    stub.signal(Signal::SIGINT)?;
    stub.wait_for_exit()?;
    drop(client);
    if std::env::var_os("CLOUDROID_BENCH_LOG").is_some() {
        eprintln!("{}", stub.output());
    }
    let trips = floor.trips.lock().clone();
    report_figures(report, plan, &record, &trips, &stub.output());
    let growth = after as f64 / before as f64;
    report.figure(format!("{}: stub's memory, end / begin", plan.name), "", growth);
    if plan.is_busy {
        let ends = goal.ends.lock().clone();
        let succeeded = ends == [Some(GoalOutcome::Succeeded)];
        report
            .figure(format!("{}: goal ended once, by success", plan.name), "", f64::from(succeeded))
            .require(Target::AtLeast(1.0))
            .note(format!("{ends:?}, {} of {GOAL} times feedback", goal.feedback.load(Ordering::Relaxed)));
        report
            .figure(format!("{}: all topics of the node are on the robot", plan.name), "", f64::from(has_topics))
            .require(Target::AtLeast(1.0));
        let lines = stub.output().lines().filter(|line| line.starts_with(LINE)).count();
        let seconds = record.end.duration_since(record.phases[0].0).as_secs_f64();
        report
            .figure(format!("{}: the node's lines on the robot", plan.name), "1/s", lines as f64 / seconds)
            .note(format!("{LINES} of them from the warm original, the others as the link can spare"));
    }
    Ok(())
}

fn start_stub(site: &Site, daemon: &Daemon, cable: &Cable, plan: &CameraPlan) -> Result<NodeProcess> {
    let names = ("camera_node", "camera_node.py");
    let workspace = site.install_original(daemon, "camera_node", names, PROGRAM)?;
    let workspace = workspace.to_string_lossy();
    let variables = [("CMAKE_PREFIX_PATH", &*workspace), ("NO_COLOR", "1"), ("CLOUDROID_LOG", "info,requests=debug")];
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"camera_node\"\nrobot = \"camera-{}\"\nlocal = \"{}\"\n\
         desire = {:?}\nmax = {T_MAX:?}\ncap = {CAP:?}\nrequest = \"/image -> {}\"\n\
         safe_stop = {{ topic = \"/cmd_vel\", type = \"geometry_msgs/Twist\" }}\n",
        cable.server,
        plan.local,
        plan.local,
        T_MAX / 2.0,
        plan.answers,
    );
    let mut argv = vec!["__name:=camera_node".to_owned()];
    if plan.is_busy {
        argv.extend([format!("_lines:={LINES}"), format!("_topics:={TOPICS}")]);
    }
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    site.start_stub_with_environment(&variables, &toml, names.0, names.1, &argv)
}

fn send_goal(site: &Site, robot: &CameraRobot, record: &Arc<GoalRecord>) -> Result<Box<dyn ActionClient>> {
    let registry = Registry::for_version(RosVersion::One);
    let parts = "int32 goal\n---\nint32 result\n---\nint32 feedback\n";
    registry.insert("actionlib/action/Test", parts)?;
    let of = registry.action("actionlib/Test")?;
    let _runtime = site.runtime.enter();
    let client = robot.node.action_client("/work", &of)?;
    site.runtime.block_on(client.wait_for_server(PATIENCE))?;
    let goal = MessageLayout::new(RosVersion::One).u32(GOAL).finish();
    client.send_goal("bench-goal", goal, Arc::clone(record) as Arc<dyn GoalEvents>);
    Ok(client)
}

/// Returns whether the robot has all topics that the node in the cloud registers.
fn has_all_topics(site: &Site, robot: &CameraRobot) -> bool {
    let is_registered = |topic: &&String| topic.starts_with("/camera_node/topic_");
    let has_all = |graph: &Graph| graph.topics.keys().filter(is_registered).count() == TOPICS as usize;
    site.wait_for_graph(&robot.node, "all topics of the node", has_all).is_ok()
}

/// Returns the resident memory of a process in KiB (`VmRSS`, proc_pid_status(5)).
fn resident_kilobytes(pid: u32) -> Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"));
    let value = line.and_then(|line| line.trim().strip_suffix(" kB"));
    Ok(value.context("VmRSS")?.parse()?)
}

fn report_figures(report: &mut BenchReport, plan: &CameraPlan, record: &CameraRecord, floor: &[RoundTrip], log: &str) {
    let name = plan.name;
    let onsets = record.phases.iter().filter(|(_, phase)| phase.impairment.is_some());
    let onsets = onsets.count();
    let sent = record.pictures.len();
    let answered = record.pictures.iter().filter(|picture| picture.answers > 0).count();
    report
        .figure(format!("{name}: pictures answered"), "%", 100.0 * answered as f64 / sent as f64)
        .note(format!("of {sent}, in {:.0} s", (record.end - record.phases[0].0).as_secs_f64()));
    let twice = record.pictures.iter().filter(|picture| picture.answers > 1).count();
    report.figure(format!("{name}: pictures answered twice"), "", twice as f64).require(Target::AtMost(0.0));
    let wrong = record.count_wrong_stops();
    report
        .figure(format!("{name}: safe stops while answers came in time"), "", wrong as f64)
        .require(Target::AtMost(0.0))
        .note(format!("of {} safe stops", record.stops.len()));
    let late_in_cloud = log.lines().filter(|line| line.contains("answer=None") && line.contains(" q=")).count();
    let late_pictures = record.count_late();
    // Without a stamp one picture at a time is a request, and each that nobody answers in time fires a safe stop.
    let late = if plan.answers == "/found" { late_pictures } else { record.stops.len() };
    let per_onset = |count: usize| count as f64 / onsets as f64;
    let figure = report.figure(format!("{name}: late requests per onset"), "", per_onset(late));
    figure.note(format!(
        "{:.0} by the cloud alone; {:.0} pictures",
        per_onset(late_in_cloud),
        per_onset(late_pictures)
    ));
    if plan.local == "warm" {
        figure.require(Target::AtMost(1.0));
    }
    let cuts = record.seconds_to_answer("cut");
    if plan.local != "none" {
        let slowest = quantile(&cuts, 0.95).unwrap_or(f64::NAN);
        let figure = report.figure(format!("{name}: hand-over after a cut, p95"), "T_max", slowest / T_MAX);
        figure.note(format!("of {}", cuts.len()));
        if plan.local == "warm" {
            figure.require(Target::AtMost(1.2));
        }
    }
    report_commands(report, plan, record, floor);
}

fn report_commands(report: &mut BenchReport, plan: &CameraPlan, record: &CameraRecord, floor: &[RoundTrip]) {
    for phase in ROUND.iter().filter(|phase| ![CUT, RESTORED].contains(phase)) {
        let in_phase = |trips: &[RoundTrip]| -> Vec<f64> {
            let these = trips.iter().filter(|trip| record.phase_at(trip.sent) == Some(phase));
            these.map(|trip| trip.after.map_or(f64::INFINITY, |after| after.as_secs_f64() * 1e3)).collect()
        };
        let (ours, plain) = (in_phase(&record.commands), in_phase(floor));
        for (percentile, fraction) in [("p50", 0.5), ("p99", 0.99)] {
            let value = |times: &[f64]| quantile(times, fraction).unwrap_or(f64::NAN);
            let name = format!("{}: command and echo, {}, {percentile}", plan.name, phase.name);
            let figure = report.figure(name, "ms", value(&ours));
            figure.relative_to("the same bytes by an idle TCP connection", value(&plain));
            if let Some(impairment) = phase.impairment {
                let missing = ours.iter().filter(|time| time.is_infinite()).count();
                let (delay, all) = (2 * impairment.delay, ours.len());
                figure.note(format!("the network's own delay is {delay} ms; {missing} of {all} without echo"));
                if percentile == "p99" && plan.local == "none" {
                    figure.require(Target::RatioAtMost(2.0));
                }
            }
        }
    }
}
