//! What a node in the cloud calls that is served on its robot.

use std::sync::Arc;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use nix::sys::signal::Signal;
use parking_lot::Mutex;
use ros::bus::{Bus, ServiceHandler, ServiceType};
use ros::ros1::Ros1Bus;
use ros::schema::Registry;
use support::Verdict;
use support::cutter::Cutter;
use support::robot::PATIENCE;
use support::site::{Running, Site};
use support::world::{CALLER, CROSSING, world};
use tokio::sync::{Semaphore, watch};
use tokio::task::JoinHandle;

const HOUR: i64 = 3600;
const SECOND: i64 = 1_000_000_000;

/// Serves std_srvs/Trigger.
struct Secret {
    says: Mutex<Result<String, String>>,
    /// So many have come.
    calls: watch::Sender<u32>,
    /// Calls that may be answered.
    answers: Semaphore,
}

impl Secret {
    fn new(says: &str) -> Arc<Self> {
        Arc::new(Self {
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
            tokio::time::timeout(PATIENCE, called).await.is_ok()
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
        let length = u32::try_from(text.len()).unwrap_or(0).to_le_bytes();
        Ok([&[1], &length[..], text.as_bytes()].concat().into())
    }
}

fn trigger() -> ServiceType {
    ServiceType::new("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522")
}

fn serves(
    site: &Site,
    node: &Ros1Bus,
    service: &str,
    of: ServiceType,
    handler: Arc<dyn ServiceHandler>,
) -> anyhow::Result<Box<dyn Send + Sync>> {
    let serving = node.serve(service, of, handler);
    Ok(site.runtime.block_on(serving)?)
}

/// What std_srvs/Trigger answered: whether it succeeded, and its words.
fn said(answer: &[u8]) -> anyhow::Result<(bool, String)> {
    let text = answer.get(5..).context("too short")?;
    Ok((answer[0] == 1, String::from_utf8_lossy(text).into_owned()))
}

fn triggers(site: &Site, app: &Ros1Bus, service: &str) -> anyhow::Result<(bool, String)> {
    said(&site.calls(app, service, &[])?)
}

/// The same, not awaited.
fn begins(
    site: &Site,
    app: &Arc<Ros1Bus>,
    service: &'static str,
) -> JoinHandle<anyhow::Result<(bool, String)>> {
    let app = Arc::clone(app);
    site.runtime
        .spawn(async move { said(&app.call(service, Bytes::new(), PATIENCE).await?) })
}

/// Calls until it fails with these words; other failures are none of those that `may` be.
fn fails_at_last(
    site: &Site,
    app: &Ros1Bus,
    service: &str,
    words: &str,
    may: &[&str],
) -> anyhow::Result<()> {
    let deadline = std::time::Instant::now() + PATIENCE;
    loop {
        if let Err(error) = triggers(site, app, service) {
            let text = format!("{error:#}");
            if text.contains(words) {
                return Ok(());
            }
            ensure!(may.iter().any(|may| text.contains(may)), "{text}");
        }
        ensure!(std::time::Instant::now() < deadline, "it does not fail");
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

fn is_there(site: &Site, app: &Ros1Bus, service: &str, stub: &Running) -> anyhow::Result<()> {
    let there = site.until(app, service, |graph| graph.services.contains_key(service));
    with_log(there.map(drop), stub)
}

/// Waits until somebody has looked for a service at the robot's Master, in vain.
fn is_sought(site: &Site, app: &Ros1Bus, service: &str, stub: &Running) -> anyhow::Result<()> {
    let sought = site.until(app, service, |graph| graph.sought.contains_key(service));
    with_log(sought.map(drop), stub)
}

const THE_CROSSING: (&str, &str) = ("crossing_py", "crossing.py");
const THE_CALLER: (&str, &str) = ("caller_cpp", "caller");

pub fn a_python_node_calls_the_robot() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let argv = ["__name:=crossing"];
    let stub = stub(
        &site,
        &daemon.address,
        THE_CROSSING,
        "calls-python",
        &argv,
        0,
    )?;
    is_there(&site, &app, "/crossing/ask", &stub)?;
    let ask = || triggers(&site, &app, "/crossing/ask");
    // Nobody serves it: as with the original.
    let error = format!("{:#}", ask().err().context("nobody is there")?);
    ensure!(error.contains("[/robot/secret] unavailable"), "{error}");
    // Waiting for one that comes later.
    let waits = begins(&site, &app, "/crossing/wait");
    is_sought(&site, &app, "/robot/late", &stub)?;
    let late = Secret::new("late");
    let other = site.node("/other")?;
    let _late = serves(&site, &other, "/robot/late", trigger(), late)?;
    let waited = site.runtime.block_on(waits)?;
    ensure!(with_log(waited, &stub)? == (true, "it is there".into()));
    // The first asked in vain a moment ago.
    let secret = Secret::new("42");
    let serving = serves(&site, &other, "/robot/secret", trigger(), secret.clone())?;
    let told = loop {
        match ask() {
            Ok(told) => break told,
            Err(error) => ensure!(format!("{error:#}").contains("unavailable"), "{error:#}"),
        }
    };
    ensure!(told == (true, "the robot says 42".into()), "{told:?}");
    // Its reason for having no answer comes through.
    *secret.says.lock() = Err("it is a secret".to_owned());
    let error = format!("{:#}", ask().err().context("it refuses")?);
    ensure!(error.contains("it is a secret"), "{error}");
    // It ends in the midst of a call.
    secret.holds();
    let calls = secret.calls();
    let asked = begins(&site, &app, "/crossing/ask");
    secret.is_called(&site, calls + 1)?;
    drop((serving, other));
    let error = site.runtime.block_on(asked)?;
    let error = format!("{:#}", error.err().context("nobody answers")?);
    ensure!(error.contains("during the call"), "{error}");
    // Gone, and another one comes: of a type that the node does not mean, then of the right one.
    let gone = ["has no server", "any more", "onnection refused"];
    let fails = |words: &str| fails_at_last(&site, &app, "/crossing/ask", words, &gone);
    with_log(fails("unavailable"), &stub)?;
    let another = site.node("/another")?;
    let wrong = ServiceType::new("std_srvs/Empty", "d41d8cd98f00b204e9800998ecf8427e");
    let serving = serves(&site, &another, "/robot/secret", wrong, Secret::new("?"))?;
    let gone = ["unavailable"];
    let fails = |words: &str| fails_at_last(&site, &app, "/crossing/ask", words, &gone);
    with_log(fails("md5sum"), &stub)?;
    drop(serving);
    let secret = Secret::new("43");
    let _serving = serves(&site, &another, "/robot/secret", trigger(), secret)?;
    let deadline = std::time::Instant::now() + PATIENCE;
    loop {
        match ask() {
            Ok(told) => {
                ensure!(told.1 == "the robot says 43", "{told:?}");
                return Ok(());
            }
            Err(error) => ensure!(std::time::Instant::now() < deadline, "{error:#}"),
        }
    }
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
    let site = Site::new()?;
    let app = site.node("/app")?;
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
    let robot = site.node("/robot")?;
    let _awaited = serves(&site, &robot, "/arm/awaited", trigger(), Secret::new("!"))?;
    let message = with_log(site.next(&mut told), &stub)?;
    let text = String::from_utf8_lossy(&message.bytes[4..]).into_owned();
    ensure!(text == "awaited is there", "{text}");
    // Calls go to the names that the robot's command line gives.
    let once = || with_log(triggers(&site, &app, "/arm/caller/once"), &stub);
    let kept = || with_log(triggers(&site, &app, "/arm/caller/kept"), &stub);
    ensure!(once()? == (false, "it failed".into()));
    is_sought(&site, &app, "/vault/secret", &stub)?;
    let serving = serves(&site, &robot, "/vault/secret", trigger(), Secret::new("42"))?;
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
    let _serving = serves(&site, &robot, "/vault/secret", trigger(), Secret::new("43"))?;
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

pub fn a_call_of_the_robot_outlives_a_cut_and_fails_with_the_link() -> Verdict {
    // Of its own: it is killed.
    let setup = world().own("calls-cut");
    let daemon = setup.start()?;
    daemon
        .deployer()
        .pushes(CALLER.name, CALLER.arguments)?
        .succeeded()?;
    let cutter = Cutter::new(&daemon.address, 0, 1, 0)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let robot = site.node("/robot")?;
    let secret = Secret::new("42");
    let _serving = serves(&site, &robot, "/secret", trigger(), secret.clone())?;
    let server = cutter.server.to_string();
    let stub = stub(&site, &server, THE_CALLER, "calls-cut", &[], 0)?;
    is_there(&site, &app, "/caller/once", &stub)?;
    // The robot answers while there is no link; the answer comes with the next one, and nothing was asked twice.
    secret.holds();
    let asked = begins(&site, &app, "/caller/once");
    secret.is_called(&site, 1)?;
    cutter.cut(true);
    stub.says("was lost")?;
    secret.answers.add_permits(1);
    cutter.cut(false);
    let told = with_log(site.runtime.block_on(asked)?, &stub)?;
    ensure!(told == (true, "42".into()), "{told:?}");
    ensure!(secret.calls() == 1);
    // With the daemon the link is gone for good, and the node is told so; its next call is answered.
    let asked = begins(&site, &app, "/caller/once");
    secret.is_called(&site, 2)?;
    let address = daemon.address.clone();
    daemon.is_killed()?;
    let daemon = setup.listen(&address).start()?;
    // The application's own call went the same way.
    let lost = site.runtime.block_on(asked)?;
    let lost = format!("{:#}", lost.err().context("it was lost with the daemon")?);
    ensure!(lost.contains("forgotten this call"), "{lost}");
    secret.answers.add_permits(2);
    let told = with_log(triggers(&site, &app, "/caller/once"), &stub)?;
    ensure!(told == (true, "42".into()), "{told:?}");
    ensure!(secret.calls() == 3);
    drop(stub);
    daemon.deployer().types(&["stop", "--all"])?;
    daemon.ends()?;
    Ok(())
}

pub fn siblings_come_first_and_other_robots_are_not_asked() -> Verdict {
    let daemon = world().with(CROSSING)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let start = |name: &str, secret: &str| {
        let argv = [name, secret];
        stub(&site, &daemon.address, THE_CROSSING, "calls-two", &argv, 0)
    };
    let first = start("__name:=first", "/robot/secret:=/robot/secret")?;
    let second = start("__name:=second", "/robot/secret:=/first/now")?;
    is_there(&site, &app, "/first/now", &first)?;
    is_there(&site, &app, "/second/ask", &second)?;
    // Were it asked by way of the robot, it would have to come back through the first's stub, which sleeps.
    first.signal(Signal::SIGSTOP)?;
    let told = triggers(&site, &app, "/second/ask");
    first.signal(Signal::SIGCONT)?;
    let told = with_log(told, &second)?;
    ensure!(told.0 && told.1.starts_with("the robot says "), "{told:?}");
    // Another robot's service of the same name is its own.
    let elsewhere = Site::new()?;
    let neighbour = elsewhere.node("/neighbour")?;
    let secret = Secret::new("the neighbour's");
    let serving = serves(&elsewhere, &neighbour, "/robot/secret", trigger(), secret)?;
    let argv = ["__name:=crossing"];
    let theirs = stub(
        &elsewhere,
        &daemon.address,
        THE_CROSSING,
        "calls-three",
        &argv,
        0,
    )?;
    is_there(&elsewhere, &neighbour, "/crossing/ask", &theirs)?;
    let told = triggers(&elsewhere, &neighbour, "/crossing/ask");
    ensure!(with_log(told, &theirs)?.1 == "the robot says the neighbour's");
    let error = triggers(&site, &app, "/first/ask").err();
    let error = format!("{:#}", error.context("nobody serves it on this robot")?);
    ensure!(error.contains("unavailable"), "{error}");
    drop(serving);
    Ok(())
}
