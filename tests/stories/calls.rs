//! What a node in the cloud calls that is served on its robot.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use nix::sys::signal::Signal;
use parking_lot::Mutex;
use ros::bus::{Bus, BusError, RosVersion, ServiceHandler, ServiceType};
use ros::schema::Registry;
use support::Verdict;
use support::cutter::Cutter;
use support::patience::{self, Deadline, patience, scale_seconds};
use support::ros_system::Node;
use support::site::{Running, Site};
use support::twins::{self, Twin, answer_of, trigger};
use support::world::{CALLER, world};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

const HOUR: i64 = 3600;
const SECOND: i64 = 1_000_000_000;
/// For a call that may never be answered, which nobody says in ROS 2; where nothing else runs.
const MEANWHILE: Duration = Duration::from_secs(5);

/// Serves std_srvs/Trigger.
struct Secret {
    ros: RosVersion,
    says: Mutex<Result<String, String>>,
    /// So many have come.
    calls: watch::Sender<u32>,
    /// Calls that may be answered.
    answers: Semaphore,
}

impl Secret {
    fn new(ros: RosVersion, says: &str) -> Arc<Self> {
        Arc::new(Self {
            ros,
            says: Mutex::new(Ok(says.to_owned())),
            calls: watch::Sender::new(0),
            answers: Semaphore::new(Semaphore::MAX_PERMITS),
        })
    }

    /// From now on calls wait.
    fn holds(&self) {
        self.answers.forget_permits(Semaphore::MAX_PERMITS);
    }

    fn calls(&self) -> u32 {
        *self.calls.borrow()
    }

    /// Waits until so many calls have come.
    fn is_called(&self, site: &Site, calls: u32) -> anyhow::Result<()> {
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
impl ServiceHandler for Secret {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, String> {
        self.calls.send_modify(|calls| *calls += 1);
        let answer = self.answers.acquire().await.map_err(|_| "closed")?;
        answer.forget();
        let text = self.says.lock().clone()?;
        Ok(answer_of(self.ros, true, &text))
    }
}

/// A service of std_srvs.
fn std_srvs(ros: RosVersion, name: &str, text: &str) -> anyhow::Result<ServiceType> {
    let registry = Registry::of(ros);
    registry.insert(&format!("std_srvs/srv/{name}"), text)?;
    let name = match ros {
        RosVersion::One => format!("std_srvs/{name}"),
        RosVersion::Two => format!("std_srvs/srv/{name}"),
    };
    Ok(ServiceType::of(&*registry.service(&name)?))
}

fn trigger_type(ros: RosVersion) -> anyhow::Result<ServiceType> {
    std_srvs(ros, "Trigger", "---\nbool success\nstring message\n")
}

/// Serves until it is dropped.
fn serves(
    site: &Site,
    node: &(impl Node + ?Sized),
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> anyhow::Result<Box<dyn Send + Sync>> {
    let serving = node.bus().serve(service, of, handler);
    Ok(site.runtime.block_on(serving)?)
}

/// Serves std_srvs/Trigger.
fn serves_secret(
    site: &Site,
    node: &(impl Node + ?Sized),
    service: &str,
    secret: Arc<Secret>,
) -> anyhow::Result<Box<dyn Send + Sync>> {
    serves(site, node, service, trigger_type(secret.ros)?, secret)
}

fn triggers(site: &Site, app: &Arc<dyn Bus>, service: &str) -> anyhow::Result<(bool, String)> {
    twins::triggered(site, app, service)
}

/// The words of what was answered; an error where that failed: in ROS 1 the call itself does, in ROS 2 the answer says so.
fn succeeds(answer: anyhow::Result<(bool, String)>) -> anyhow::Result<String> {
    match answer? {
        (true, words) => Ok(words),
        (false, words) => Err(anyhow::anyhow!(words)),
    }
}

/// Calls a std_srvs/Trigger, and does not wait.
fn begins(
    site: &Site,
    app: &Arc<dyn Bus>,
    service: &'static str,
) -> JoinHandle<Result<Bytes, BusError>> {
    begins_within(site, app, service, patience())
}

/// The same, given up after so long.
fn begins_within(
    site: &Site,
    app: &Arc<dyn Bus>,
    service: &'static str,
    time: Duration,
) -> JoinHandle<Result<Bytes, BusError>> {
    let app = Arc::clone(app);
    let request = trigger(site.system.version());
    site.runtime
        .spawn(async move { app.call(service, request, time).await })
}

/// What came of it.
fn ended(site: &Site, call: JoinHandle<Result<Bytes, BusError>>) -> anyhow::Result<(bool, String)> {
    let answer = site.runtime.block_on(call)??;
    twins::said(site.system.version(), &answer)
}

/// Calls until it fails with these words; other failures are none of those that `may` be.
fn fails_at_last(
    ask: impl Fn() -> anyhow::Result<String>,
    words: &str,
    may: &[&str],
) -> anyhow::Result<()> {
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

/// Calls until it succeeds; no failures are others than those that `may` be.
fn succeeds_at_last(
    ask: impl Fn() -> anyhow::Result<String>,
    may: &[&str],
) -> anyhow::Result<String> {
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

fn stub(
    site: &Site,
    server: &str,
    (service, node): (&str, &str),
    robot: &str,
    argv: &[&str],
    ahead: i64,
) -> anyhow::Result<Running> {
    let toml = format!(
        "server = \"ws://{server}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n"
    );
    let ahead = ahead.to_string();
    let environment = [("CLOUDROID_TEST_CLOCK_SHIFT", ahead.as_str())];
    site.stub_among(&environment, &toml, service, node, argv)
}

fn with_log<T>(outcome: anyhow::Result<T>, stub: &Running) -> anyhow::Result<T> {
    outcome.with_context(|| format!("the stub said:\n{}", stub.said()))
}

fn is_there(site: &Site, app: &Arc<dyn Bus>, service: &str, stub: &Running) -> anyhow::Result<()> {
    let there = site.until(app, service, |graph| graph.services.contains_key(service));
    with_log(there.map(drop), stub)
}

/// Waits until somebody has looked for a service at the robot's Master, in vain.
fn is_sought(site: &Site, app: &Arc<dyn Bus>, service: &str, stub: &Running) -> anyhow::Result<()> {
    let sought = site.until(app, service, |graph| graph.sought.contains_key(service));
    with_log(sought.map(drop), stub)
}

/// The command line of a caller of ROS 2 that waits for an answer as long as takes so many seconds where nothing else runs.
fn with_patience(mut argv: Vec<String>, seconds: u64) -> Vec<String> {
    let seconds = scale_seconds(seconds);
    argv.extend(["-p".to_owned(), format!("patience:={seconds}.0")]);
    argv
}

const THE_CALLER: (&str, &str) = ("caller_cpp", "caller");

pub fn a_python_node_calls_the_robot(ros: RosVersion) -> Verdict {
    let twin = Twin::caller(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let mut argv = twin.argv("crossing", &[]);
    if ros == RosVersion::Two {
        argv = with_patience(argv, 5);
    }
    let robot = twin.robot("calls-python");
    let stub = twin.stub(&site, (&daemon.address, &robot), "", &argv)?;
    is_there(&site, &app, "/crossing/ask", &stub)?;
    let ask = || succeeds(triggers(&site, &app, "/crossing/ask"));
    // Nobody serves it: as with the original.
    let error = format!("{:#}", ask().err().context("nobody is there")?);
    ensure!(
        error.contains("/robot/secret") && error.contains("unavailable"),
        "{error}"
    );
    // Waiting for one that comes later.
    let waits = begins(&site, &app, "/crossing/wait");
    if ros == RosVersion::One {
        is_sought(&site, &app, "/robot/late", &stub)?;
    }
    let late = Secret::new(ros, "late");
    let other = site.joins("/other")?;
    let _late = serves_secret(&site, &other, "/robot/late", late)?;
    let waited = ended(&site, waits);
    ensure!(with_log(waited, &stub)? == (true, "it is there".into()));
    // The first asked in vain a moment ago.
    let secret = Secret::new(ros, "42");
    let serving = serves_secret(&site, &other, "/robot/secret", secret.clone())?;
    let told = with_log(succeeds_at_last(ask, &["unavailable", "no answer"]), &stub)?;
    ensure!(told == "the robot says 42", "{told:?}");
    // Its reason for having no answer comes through, where there are reasons.
    *secret.says.lock() = Err("it is a secret".to_owned());
    let error = format!("{:#}", ask().err().context("it refuses")?);
    let reason = match ros {
        RosVersion::One => "it is a secret",
        RosVersion::Two => "no answer",
    };
    ensure!(error.contains(reason), "{error}");
    // It ends in the midst of a call.
    secret.holds();
    let calls = secret.calls();
    let asked = begins(&site, &app, "/crossing/ask");
    secret.is_called(&site, calls + 1)?;
    drop((serving, other));
    let error = succeeds(ended(&site, asked));
    let error = format!("{:#}", error.err().context("nobody answers")?);
    ensure!(error.contains("during the call"), "{error}");
    // Gone, and another one comes: of a type that the node does not mean, then of the right one.
    let gone = [
        "has no server",
        // The node had looked it up before.
        "does not serve",
        "any more",
        "onnection refused",
        "no answer",
    ];
    with_log(fails_at_last(ask, "unavailable", &gone), &stub)?;
    let another = site.joins("/another")?;
    let wrong = std_srvs(ros, "Empty", "---\n")?;
    let serving = serves(
        &site,
        &another,
        "/robot/secret",
        wrong,
        Secret::new(ros, "?"),
    )?;
    // To a client of ROS 2, what has another type is not there.
    let another_type = match ros {
        RosVersion::One => "md5sum",
        RosVersion::Two => "unavailable",
    };
    let fails = fails_at_last(ask, another_type, &["unavailable"]);
    with_log(fails, &stub)?;
    drop(serving);
    let secret = Secret::new(ros, "43");
    let _serving = serves_secret(&site, &another, "/robot/secret", secret)?;
    let may = [
        "unavailable",
        "md5sum",
        "any more",
        "no answer",
        "does not serve",
    ];
    let told = with_log(succeeds_at_last(ask, &may), &stub)?;
    ensure!(told == "the robot says 43", "{told:?}");
    Ok(())
}

/// A robot's scale: it gives back what it is given, and tells the time, which is `ahead` nanoseconds ahead of ours.
struct Scale {
    ahead: i64,
}

#[async_trait]
impl ServiceHandler for Scale {
    async fn call(&self, request: Bytes, _caller: &str) -> Result<Bytes, String> {
        let now = link::clock::now() + self.ahead;
        let number = |at: usize| -> i64 {
            let bytes = request[at..at + 4].try_into().unwrap_or_default();
            u32::from_le_bytes(bytes).into()
        };
        let age = now - (number(4) * SECOND + number(8));
        if age.abs() > 60 * SECOND {
            return Err(format!("asked {} s ago", age / SECOND));
        }
        let time = |at: i64| {
            let part = |part: i64| u32::try_from(part).unwrap_or(0).to_le_bytes();
            [part(at / SECOND), part(at % SECOND)].concat()
        };
        let moments = [time(now), time(now - 5)].concat();
        Ok([&2_u32.to_le_bytes()[..], &moments, &request]
            .concat()
            .into())
    }
}

pub fn a_cpp_node_waits_for_the_robot_and_calls_it() -> Verdict {
    let daemon = world().with(CALLER)?;
    // It was seen at push that it waits.
    let service = daemon.get_json("/api/v1/services/caller_cpp")?;
    let needs = service["interface"]["needs"].to_string();
    ensure!(
        needs == r#"[{"name":"/awaited","nodes":["/caller"]}]"#,
        "{needs}"
    );
    let ros = RosVersion::One;
    let site = Site::new()?;
    let app = site.joins("/app")?;
    let argv = [
        "__name:=caller",
        "__ns:=/arm",
        "secret:=/vault/secret",
        "scale:=kitchen_scale",
    ];
    let stub = stub(&site, &daemon.address, THE_CALLER, "calls-cpp", &argv, HOUR)?;
    is_there(&site, &app, "/arm/caller/once", &stub)?;
    // It waits for a service that comes later.
    let mut told = site.hears(&app, "/arm/caller/told")?;
    is_sought(&site, &app, "/arm/awaited", &stub)?;
    let robot = site.joins("/robot")?;
    let _awaited = serves_secret(&site, &robot, "/arm/awaited", Secret::new(ros, "!"))?;
    let message = with_log(site.next(&mut told), &stub)?;
    let text = String::from_utf8_lossy(&message.bytes[4..]).into_owned();
    ensure!(text == "awaited is there", "{text}");
    // Calls go to the names that the robot's command line gives.
    let once = || with_log(triggers(&site, &app, "/arm/caller/once"), &stub);
    let kept = || with_log(triggers(&site, &app, "/arm/caller/kept"), &stub);
    ensure!(once()? == (false, "it failed".into()));
    is_sought(&site, &app, "/vault/secret", &stub)?;
    let serving = serves_secret(&site, &robot, "/vault/secret", Secret::new(ros, "42"))?;
    let first = loop {
        let told = once()?;
        if told.0 {
            break told;
        }
    };
    ensure!(first.1 == "42", "{first:?}");
    ensure!(kept()?.1 == "newly 42");
    ensure!(kept()?.1 == "still 42");
    // The kept connection ends with its server, and another is made.
    drop(serving);
    let gone = |graph: &ros::bus::Graph| !graph.services.contains_key("/vault/secret");
    site.until(&app, "its end", gone)?;
    while kept()?.0 {}
    let _serving = serves_secret(&site, &robot, "/vault/secret", Secret::new(ros, "43"))?;
    let again = loop {
        let told = kept()?;
        if told.0 {
            break told;
        }
    };
    ensure!(again.1 == "newly 43", "{again:?}");
    // Stamps mean the same on both sides, whatever the clocks say, and three megabytes are as many.
    let registry = Registry::new();
    registry.insert(
        "caller_cpp/srv/Measure",
        "Header header\nuint8[] data\n---\ntime[] moments\nHeader header\nuint8[] data\n",
    )?;
    let measure = ServiceType::new(
        "caller_cpp/Measure",
        registry.service("caller_cpp/Measure")?.md5.clone(),
    );
    let scale = Arc::new(Scale {
        ahead: HOUR * SECOND,
    });
    let _scale = serves(&site, &robot, "/arm/kitchen_scale", measure, scale)?;
    let measured = with_log(triggers(&site, &app, "/arm/caller/measure"), &stub)?;
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
    // Of its own: it is killed.
    let setup = world().own(&twin.robot("calls-cut"));
    let daemon = setup.start()?;
    let pushed = service.package.context("a package")?;
    daemon
        .deployer()
        .pushes(pushed, service.arguments)?
        .succeeded()?;
    let cutter = Cutter::new(&daemon.address, 0, 1, 0)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = site.joins("/robot")?;
    let secret = Secret::new(ros, "42");
    let _serving = serves_secret(&site, &robot, secrets, secret.clone())?;
    let server = cutter.server.to_string();
    let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
    let stub = stub(&site, &server, package, "calls-cut", &argv, 0)?;
    is_there(&site, &app, ask, &stub)?;
    let asks = || succeeds(triggers(&site, &app, ask));
    // Of what it may call, a node of ROS 2 is told in a moment.
    let told = with_log(succeeds_at_last(asks, &["unavailable"]), &stub)?;
    ensure!(told == words, "{told:?}");
    // The robot answers while there is no link; the answer comes with the next one, and nothing was asked twice.
    secret.holds();
    let calls = secret.calls();
    let asked = begins(&site, &app, ask);
    secret.is_called(&site, calls + 1)?;
    cutter.cut(true);
    stub.says("was lost")?;
    secret.answers.add_permits(1);
    cutter.cut(false);
    let told = with_log(ended(&site, asked), &stub)?;
    ensure!(told == (true, words.into()), "{told:?}");
    ensure!(secret.calls() == calls + 1);
    // With the daemon the link is gone for good, and the node is told so; its next call is answered.
    let time = match ros {
        RosVersion::One => patience(),
        RosVersion::Two => patience::scale(MEANWHILE),
    };
    let asked = begins_within(&site, &app, ask, time);
    secret.is_called(&site, calls + 2)?;
    let address = daemon.address.clone();
    daemon.is_killed()?;
    let daemon = setup.listen(&address).start()?;
    // The application's own call went the same way; DDS has no way to tell it.
    let lost = ended(&site, asked);
    let lost = format!("{:#}", lost.err().context("it was lost with the daemon")?);
    let forgotten = match ros {
        RosVersion::One => "forgotten this call",
        RosVersion::Two => "within",
    };
    ensure!(lost.contains(forgotten), "{lost}");
    secret.answers.add_permits(2);
    // A node of ROS 2 may still take the killed daemon for one that answers.
    let may = ["unavailable", "no answer"];
    let told = with_log(succeeds_at_last(asks, &may), &stub)?;
    ensure!(told == words, "{told:?}");
    ensure!(secret.calls() == calls + 3);
    drop(stub);
    daemon.deployer().types(&["stop", "--all"])?;
    daemon.ends()?;
    Ok(())
}

pub fn siblings_come_first_and_other_robots_are_not_asked(ros: RosVersion) -> Verdict {
    let twin = Twin::caller(ros);
    let daemon = world().with(twin.service)?;
    let site = Site::of(ros)?;
    let app = site.joins("/app")?;
    let robot = twin.robot("calls-two");
    let start = |name: &str, secret: &str| {
        let argv = twin.argv(name, &[("/robot/secret", secret)]);
        twin.stub(&site, (&daemon.address, &robot), "", &argv)
    };
    let first = start("first", "/robot/secret")?;
    let second = start("second", "/first/now")?;
    is_there(&site, &app, "/first/now", &first)?;
    is_there(&site, &app, "/second/ask", &second)?;
    // Were it asked by way of the robot, it would have to come back through the first's stub, which sleeps.
    first.signal(Signal::SIGSTOP)?;
    let ask = || succeeds(triggers(&site, &app, "/second/ask"));
    // Of its sibling a node of ROS 2 hears in a moment.
    let told = succeeds_at_last(ask, &["unavailable"]);
    first.signal(Signal::SIGCONT)?;
    let told = with_log(told, &second)?;
    ensure!(told.starts_with("the robot says "), "{told:?}");
    // Another robot's service of the same name is its own.
    let elsewhere = Site::of(ros)?;
    let neighbour = elsewhere.joins("/neighbour")?;
    let secret = Secret::new(ros, "the neighbour's");
    let serving = serves_secret(&elsewhere, &neighbour, "/robot/secret", secret)?;
    let argv = twin.argv("crossing", &[]);
    let robot = twin.robot("calls-three");
    let theirs = twin.stub(&elsewhere, (&daemon.address, &robot), "", &argv)?;
    is_there(&elsewhere, &neighbour, "/crossing/ask", &theirs)?;
    let ask = || succeeds(triggers(&elsewhere, &neighbour, "/crossing/ask"));
    let told = with_log(succeeds_at_last(ask, &["unavailable"]), &theirs)?;
    ensure!(told == "the robot says the neighbour's", "{told}");
    let error = succeeds(triggers(&site, &app, "/first/ask")).err();
    let error = format!("{:#}", error.context("nobody serves it on this robot")?);
    ensure!(error.contains("unavailable"), "{error}");
    drop(serving);
    Ok(())
}
