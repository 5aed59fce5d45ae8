//! Services that a node in the cloud calls and its robot provides.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use nix::sys::signal::Signal;
use parking_lot::Mutex;
use ros::bus::{Bus, BusError, FailureReason, RosVersion, ServiceHandler, ServiceType};
use ros::schema::Registry;
use support::Verdict;
use support::cutter::Cutter;
use support::patience::{self, Deadline, patience, scale_seconds};
use support::ros_system::HasBus;
use support::site::{NodeProcess, Site};
use support::twins::{self, Twin, trigger_request, trigger_response};
use support::world::{CALLER, world};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

const HOUR: i64 = 3600;
const SECOND: i64 = 1_000_000_000;
/// Maximum time for a call that may never be answered, which ROS 2 does not report; on an idle machine.
const MEANWHILE: Duration = Duration::from_secs(5);

/// A server of std_srvs/Trigger.
pub struct TriggerService {
    ros: RosVersion,
    says: Mutex<Result<String, FailureReason>>,
    /// Number of calls so far.
    calls: watch::Sender<u32>,
    /// Permits to answer calls.
    answers: Semaphore,
}

impl TriggerService {
    pub fn new(ros: RosVersion, says: &str) -> Arc<Self> {
        Arc::new(Self {
            ros,
            says: Mutex::new(Ok(says.to_owned())),
            calls: watch::Sender::new(0),
            answers: Semaphore::new(Semaphore::MAX_PERMITS),
        })
    }

    /// Makes calls wait from now on.
    fn hold_calls(&self) {
        self.answers.forget_permits(Semaphore::MAX_PERMITS);
    }

    fn call_count(&self) -> u32 {
        *self.calls.borrow()
    }

    /// Waits until `calls` calls have arrived.
    fn wait_for_calls(&self, site: &Site, calls: u32) -> anyhow::Result<()> {
        let mut now = self.calls.subscribe();
        let called = site.runtime.block_on(async {
            let called = now.wait_for(|now| *now >= calls);
            patience::wait_for(called).await.is_ok()
        });
        ensure!(called, "{calls} calls should have come");
        Ok(())
    }
}

#[async_trait]
impl ServiceHandler for TriggerService {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        self.calls.send_modify(|calls| *calls += 1);
        let answer = self.answers.acquire().await;
        let answer = answer.map_err(|_| FailureReason::new("closed"))?;
        answer.forget();
        let text = self.says.lock().clone()?;
        Ok(trigger_response(self.ros, true, &text))
    }
}

/// Returns a service type of std_srvs.
fn std_srvs_type(ros: RosVersion, name: &str, text: &str) -> anyhow::Result<ServiceType> {
    let registry = Registry::for_version(ros);
    registry.insert(&format!("std_srvs/srv/{name}"), text)?;
    let name = match ros {
        RosVersion::One => format!("std_srvs/{name}"),
        RosVersion::Two => format!("std_srvs/srv/{name}"),
    };
    Ok(ServiceType::from_service(&*registry.service(&name)?))
}

fn trigger_type(ros: RosVersion) -> anyhow::Result<ServiceType> {
    std_srvs_type(ros, "Trigger", "---\nbool success\nstring message\n")
}

/// Serves a service until the returned value is dropped.
fn serve(
    site: &Site,
    node: &(impl HasBus + ?Sized),
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> anyhow::Result<Box<dyn Send + Sync>> {
    let serving = node.bus().serve(service, of, handler);
    Ok(site.runtime.block_on(serving)?)
}

/// Serves std_srvs/Trigger.
pub fn serve_trigger(
    site: &Site,
    node: &(impl HasBus + ?Sized),
    service: &str,
    secret: Arc<TriggerService>,
) -> anyhow::Result<Box<dyn Send + Sync>> {
    serve(site, node, service, trigger_type(secret.ros)?, secret)
}

fn call_trigger(site: &Site, app: &Arc<dyn Bus>, service: &str) -> anyhow::Result<(bool, String)> {
    twins::call_trigger(site, app, service)
}

/// Returns the message of a response; fails if the call failed, which ROS 1 reports as an error of the call and ROS 2
/// in the response.
fn expect_success(answer: anyhow::Result<(bool, String)>) -> anyhow::Result<String> {
    match answer? {
        (true, words) => Ok(words),
        (false, words) => Err(anyhow::anyhow!(words)),
    }
}

/// Starts a call of std_srvs/Trigger without waiting.
fn begin_call(site: &Site, app: &Arc<dyn Bus>, service: &'static str) -> JoinHandle<Result<Bytes, BusError>> {
    begin_call_with_timeout(site, app, service, patience())
}

/// Starts a call with a timeout.
fn begin_call_with_timeout(
    site: &Site,
    app: &Arc<dyn Bus>,
    service: &'static str,
    time: Duration,
) -> JoinHandle<Result<Bytes, BusError>> {
    let app = Arc::clone(app);
    let request = trigger_request(site.system.version());
    site.runtime.spawn(async move { app.call(service, request, time).await })
}

/// Waits for the response to a call.
fn finish_call(site: &Site, call: JoinHandle<Result<Bytes, BusError>>) -> anyhow::Result<(bool, String)> {
    let answer = site.runtime.block_on(call)??;
    twins::parse_trigger_response(site.system.version(), &answer)
}

/// Repeats a call until it fails with a message that contains `words`; other failures must be among `may`.
fn wait_for_failure(ask: impl Fn() -> anyhow::Result<String>, words: &str, may: &[&str]) -> anyhow::Result<()> {
    let deadline = Deadline::begin();
    loop {
        if let Err(error) = ask() {
            let text = format!("{error:#}");
            if text.contains(words) {
                return Ok(());
            }
            ensure!(may.iter().any(|may| text.contains(may)), "{text}");
        }
        deadline.check(|| "it does not fail".to_owned())?;
    }
}

/// Repeats a call until it succeeds; failures must be among `may`.
fn wait_for_success(ask: impl Fn() -> anyhow::Result<String>, may: &[&str]) -> anyhow::Result<String> {
    let deadline = Deadline::begin();
    loop {
        match ask() {
            Ok(words) => return Ok(words),
            Err(error) => {
                let text = format!("{error:#}");
                let may = may.iter().any(|may| text.contains(may));
                ensure!(may && !deadline.is_over(), "{text}");
            }
        }
    }
}

fn start_stub(
    site: &Site,
    server: &str,
    (service, node): (&str, &str),
    robot: &str,
    argv: &[&str],
    ahead: i64,
) -> anyhow::Result<NodeProcess> {
    let toml = format!("server = \"ws://{server}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n");
    let ahead = ahead.to_string();
    let environment = [("CLOUDROID_TEST_CLOCK_SHIFT", ahead.as_str())];
    site.start_stub_with_environment(&environment, &toml, service, node, argv)
}

fn with_log<T>(outcome: anyhow::Result<T>, stub: &NodeProcess) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", stub.output()))
}

fn wait_until_served(site: &Site, app: &Arc<dyn Bus>, service: &str, stub: &NodeProcess) -> anyhow::Result<()> {
    let there = site.wait_for_graph(app, service, |graph| graph.services.contains_key(service));
    with_log(there.map(drop), stub)
}

/// Waits until a service has been looked up at the robot's Master in vain.
fn wait_until_sought(site: &Site, app: &Arc<dyn Bus>, service: &str, stub: &NodeProcess) -> anyhow::Result<()> {
    let sought = site.wait_for_graph(app, service, |graph| graph.sought.contains_key(service));
    with_log(sought.map(drop), stub)
}

/// Extends the command line of a caller of ROS 2 to wait for an answer for `seconds` on an idle machine.
fn with_patience(mut argv: Vec<String>, seconds: u64) -> Vec<String> {
    let seconds = scale_seconds(seconds);
    argv.extend(["-p".to_owned(), format!("patience:={seconds}.0")]);
    argv
}

const THE_CALLER: (&str, &str) = ("caller_cpp", "caller");

pub fn a_python_node_calls_the_robot(ros: RosVersion) -> Verdict {
    let twin = Twin::caller(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let mut argv = twin.argv("crossing", &[]);
    if ros == RosVersion::Two {
        argv = with_patience(argv, 5);
    }
    let robot = twin.robot_name("calls-python");
    let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
    wait_until_served(&site, &app, "/crossing/ask", &stub)?;
    let ask = || expect_success(call_trigger(&site, &app, "/crossing/ask"));
    // No server exists: the same error as with the original.
    let error = format!("{:#}", ask().err().context("nobody is there")?);
    ensure!(error.contains("/robot/secret") && error.contains("unavailable"), "{error}");
    // Waits for a server that starts later.
    let waits = begin_call(&site, &app, "/crossing/wait");
    if ros == RosVersion::One {
        wait_until_sought(&site, &app, "/robot/late", &stub)?;
    }
    let late = TriggerService::new(ros, "late");
    let other = site.join("/other")?;
    let _late = serve_trigger(&site, &other, "/robot/late", late)?;
    let waited = finish_call(&site, waits);
    ensure!(with_log(waited, &stub)? == (true, "it is there".into()));
    // The first call failed a moment ago.
    let secret = TriggerService::new(ros, "42");
    let serving = serve_trigger(&site, &other, "/robot/secret", secret.clone())?;
    let told = with_log(wait_for_success(ask, &["unavailable", "no answer"]), &stub)?;
    ensure!(told == "the robot says 42", "{told:?}");
    // The reason of a failure is transmitted, where ROS has reasons.
    *secret.says.lock() = Err(FailureReason::new("it is a secret"));
    let error = format!("{:#}", ask().err().context("it refuses")?);
    let reason = match ros {
        RosVersion::One => "it is a secret",
        RosVersion::Two => "no answer",
    };
    ensure!(error.contains(reason), "{error}");
    // The server ends during a call.
    secret.hold_calls();
    let calls = secret.call_count();
    let asked = begin_call(&site, &app, "/crossing/ask");
    secret.wait_for_calls(&site, calls + 1)?;
    drop((serving, other));
    let error = expect_success(finish_call(&site, asked));
    let error = format!("{:#}", error.err().context("nobody answers")?);
    ensure!(error.contains("during the call"), "{error}");
    // No server, then one with another type, then one with the right type.
    let gone = [
        "has no server",
        // The node has looked it up before.
        "does not serve",
        "any more",
        "onnection refused",
        "no answer",
    ];
    with_log(wait_for_failure(ask, "unavailable", &gone), &stub)?;
    let another = site.join("/another")?;
    let wrong = std_srvs_type(ros, "Empty", "---\n")?;
    let serving = serve(&site, &another, "/robot/secret", wrong, TriggerService::new(ros, "?"))?;
    // For a client of ROS 2 a service with another type does not exist.
    let another_type = match ros {
        RosVersion::One => "md5sum",
        RosVersion::Two => "unavailable",
    };
    let fails = wait_for_failure(ask, another_type, &["unavailable"]);
    with_log(fails, &stub)?;
    drop(serving);
    let secret = TriggerService::new(ros, "43");
    let _serving = serve_trigger(&site, &another, "/robot/secret", secret)?;
    let may = ["unavailable", "md5sum", "any more", "no answer", "does not serve"];
    let told = with_log(wait_for_success(ask, &may), &stub)?;
    ensure!(told == "the robot says 43", "{told:?}");
    Ok(())
}

/// A service of the robot that returns its argument, and the time, which is `ahead` nanoseconds ahead of this
/// machine's.
struct RobotScale {
    ahead: i64,
}

#[async_trait]
impl ServiceHandler for RobotScale {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let now = link::clock::now() + self.ahead;
        let number = |at: usize| -> i64 {
            let bytes = request[at..at + 4].try_into().unwrap_or_default();
            u32::from_le_bytes(bytes).into()
        };
        let age = now - (number(4) * SECOND + number(8));
        if age.abs() > 60 * SECOND {
            return Err(FailureReason::new(format!("asked {} s ago", age / SECOND)));
        }
        let time = |at: i64| {
            let part = |part: i64| u32::try_from(part).unwrap_or(0).to_le_bytes();
            [part(at / SECOND), part(at % SECOND)].concat()
        };
        let moments = [time(now), time(now - 5)].concat();
        Ok([&2_u32.to_le_bytes()[..], &moments, &request].concat().into())
    }
}

pub fn a_cpp_node_waits_for_the_robot_and_calls_it() -> Verdict {
    let daemon = world().daemon_with(CALLER)?;
    // The push has detected that the node waits for a service.
    let service = daemon.get_json("/api/v1/services/caller_cpp")?;
    let needs = service["interface"]["needs"].to_string();
    ensure!(needs == r#"[{"name":"/awaited","nodes":["/caller"]}]"#, "{needs}");
    let ros = RosVersion::One;
    let site = Site::new()?;
    let app = site.join("/app")?;
    let argv = ["__name:=caller", "__ns:=/arm", "secret:=/vault/secret", "scale:=kitchen_scale"];
    let stub = start_stub(&site, &daemon.address, THE_CALLER, "calls-cpp", &argv, HOUR)?;
    wait_until_served(&site, &app, "/arm/caller/once", &stub)?;
    // The node waits for a service that starts later.
    let mut told = site.subscribe(&app, "/arm/caller/told")?;
    wait_until_sought(&site, &app, "/arm/awaited", &stub)?;
    let robot = site.join("/robot")?;
    let _awaited = serve_trigger(&site, &robot, "/arm/awaited", TriggerService::new(ros, "!"))?;
    let message = with_log(site.next_message(&mut told), &stub)?;
    let text = String::from_utf8_lossy(&message.bytes[4..]).into_owned();
    ensure!(text == "awaited is there", "{text}");
    // Calls use the names of the robot's command line.
    let once = || with_log(call_trigger(&site, &app, "/arm/caller/once"), &stub);
    let kept = || with_log(call_trigger(&site, &app, "/arm/caller/kept"), &stub);
    ensure!(once()? == (false, "it failed".into()));
    wait_until_sought(&site, &app, "/vault/secret", &stub)?;
    let serving = serve_trigger(&site, &robot, "/vault/secret", TriggerService::new(ros, "42"))?;
    let first = loop {
        let told = once()?;
        if told.0 {
            break told;
        }
    };
    ensure!(first.1 == "42", "{first:?}");
    ensure!(kept()?.1 == "newly 42");
    ensure!(kept()?.1 == "still 42");
    // The persistent connection ends with its server, and another one is opened.
    drop(serving);
    let gone = |graph: &ros::bus::Graph| !graph.services.contains_key("/vault/secret");
    site.wait_for_graph(&app, "its end", gone)?;
    while kept()?.0 {}
    let _serving = serve_trigger(&site, &robot, "/vault/secret", TriggerService::new(ros, "43"))?;
    let again = loop {
        let told = kept()?;
        if told.0 {
            break told;
        }
    };
    ensure!(again.1 == "newly 43", "{again:?}");
    // Stamps are converted between the clocks, and three megabytes are transmitted unchanged.
    let registry = Registry::new();
    registry.insert(
        "caller_cpp/srv/Measure",
        "Header header\nuint8[] data\n---\ntime[] moments\nHeader header\nuint8[] data\n",
    )?;
    let measure = ServiceType::new("caller_cpp/Measure", registry.service("caller_cpp/Measure")?.md5.clone());
    let scale = Arc::new(RobotScale { ahead: HOUR * SECOND });
    let _scale = serve(&site, &robot, "/arm/kitchen_scale", measure, scale)?;
    let measured = with_log(call_trigger(&site, &app, "/arm/caller/measure"), &stub)?;
    ensure!(measured == (true, String::new()), "{measured:?}");
    Ok(())
}

pub fn a_call_of_the_robot_outlives_a_cut_and_fails_with_the_link(ros: RosVersion) -> Verdict {
    let twin = Twin::caller(ros);
    let (service, package, argv, ask, secrets, words) = match ros {
        RosVersion::One => (CALLER, THE_CALLER, vec![], "/caller/once", "/secret", "42"),
        RosVersion::Two => (
            twin.service,
            (twin.service.name, twin.executable),
            with_patience(twin.argv("crossing", &[]), 20),
            "/crossing/ask",
            "/robot/secret",
            "the robot says 42",
        ),
    };
    // A separate daemon, because it is killed.
    let setup = world().setup(&twin.robot_name("calls-cut"));
    let daemon = setup.start()?;
    let pushed = service.package.context("a package")?;
    daemon.deployer().push(pushed, service.arguments)?.expect_success()?;
    let cutter = Cutter::new(&daemon.address, 0, 1, 0)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = site.join("/robot")?;
    let secret = TriggerService::new(ros, "42");
    let _serving = serve_trigger(&site, &robot, secrets, secret.clone())?;
    let server = cutter.server.to_string();
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = start_stub(&site, &server, package, "calls-cut", &argv, 0)?;
    wait_until_served(&site, &app, ask, &stub)?;
    let asks = || expect_success(call_trigger(&site, &app, ask));
    // A node of ROS 2 learns of services within a moment.
    let told = with_log(wait_for_success(asks, &["unavailable"]), &stub)?;
    ensure!(told == words, "{told:?}");
    // The robot answers while there is no link; the answer arrives with the next one, and nothing was called twice.
    secret.hold_calls();
    let calls = secret.call_count();
    let asked = begin_call(&site, &app, ask);
    secret.wait_for_calls(&site, calls + 1)?;
    cutter.cut(true);
    stub.wait_for_output("was lost")?;
    secret.answers.add_permits(1);
    cutter.cut(false);
    let told = with_log(finish_call(&site, asked), &stub)?;
    ensure!(told == (true, words.into()), "{told:?}");
    ensure!(secret.call_count() == calls + 1);
    // Without the daemon the link is lost for good, and the node gets an error; its next call is answered.
    let time = match ros {
        RosVersion::One => patience(),
        RosVersion::Two => patience::scale(MEANWHILE),
    };
    let asked = begin_call_with_timeout(&site, &app, ask, time);
    secret.wait_for_calls(&site, calls + 2)?;
    let address = daemon.address.clone();
    daemon.kill()?;
    let daemon = setup.listen(&address).start()?;
    // The application's own call was lost in the same way, which DDS cannot report.
    let lost = finish_call(&site, asked);
    let lost = format!("{:#}", lost.err().context("it was lost with the daemon")?);
    let forgotten = match ros {
        RosVersion::One => "this call was lost",
        RosVersion::Two => "within",
    };
    ensure!(lost.contains(forgotten), "{lost}");
    secret.answers.add_permits(2);
    // A node of ROS 2 may still regard the killed daemon as a server that answers.
    let may = ["unavailable", "no answer"];
    let told = with_log(wait_for_success(asks, &may), &stub)?;
    ensure!(told == words, "{told:?}");
    ensure!(secret.call_count() == calls + 3);
    drop(stub);
    daemon.deployer().run(&["stop", "--all"])?;
    daemon.stop()?;
    Ok(())
}

pub fn siblings_come_first_and_other_robots_are_not_asked(ros: RosVersion) -> Verdict {
    let twin = Twin::caller(ros);
    let daemon = world().daemon_with(twin.service)?;
    let site = Site::with_ros(ros)?;
    let app = site.join("/app")?;
    let robot = twin.robot_name("calls-two");
    let start = |name: &str, secret: &str| {
        let argv = twin.argv(name, &[("/robot/secret", secret)]);
        twin.stub(&site, (&daemon.address, &robot), "", &argv)
    };
    let first = start("first", "/robot/secret")?;
    let second = start("second", "/first/now")?;
    wait_until_served(&site, &app, "/first/now", &first)?;
    wait_until_served(&site, &app, "/second/ask", &second)?;
    // If the call went through the robot, it would need the first stub, which is stopped.
    first.signal(Signal::SIGSTOP)?;
    let ask = || expect_success(call_trigger(&site, &app, "/second/ask"));
    // A node of ROS 2 discovers its sibling within a moment.
    let told = wait_for_success(ask, &["unavailable"]);
    first.signal(Signal::SIGCONT)?;
    let told = with_log(told, &second)?;
    ensure!(told.starts_with("the robot says "), "{told:?}");
    // A service of the same name belongs to another robot.
    let elsewhere = Site::with_ros(ros)?;
    let neighbour = elsewhere.join("/neighbour")?;
    let secret = TriggerService::new(ros, "the neighbour's");
    let serving = serve_trigger(&elsewhere, &neighbour, "/robot/secret", secret)?;
    let argv = twin.argv("crossing", &[]);
    let robot = twin.robot_name("calls-three");
    let theirs = twin.stub(&elsewhere, (&daemon.address, &robot), "", &argv)?;
    wait_until_served(&elsewhere, &neighbour, "/crossing/ask", &theirs)?;
    let ask = || expect_success(call_trigger(&elsewhere, &neighbour, "/crossing/ask"));
    let told = with_log(wait_for_success(ask, &["unavailable"]), &theirs)?;
    ensure!(told == "the robot says the neighbour's", "{told}");
    let error = expect_success(call_trigger(&site, &app, "/first/ask")).err();
    let error = format!("{:#}", error.context("nobody serves it on this robot")?);
    ensure!(error.contains("unavailable"), "{error}");
    drop(serving);
    Ok(())
}
