//! Runs a stub, from its start by roslaunch to the real node's exit status.
//!
//! ```text
//!  Master reached ─▶ linked (see `linked`) ── node exited ─▶ exit status
//!       │              │        └─ SIGINT, shutdown ─▶ exit
//!       │              └─ refused ─▶ the local original in its place, or an error
//!       └─ not there: waits for it, as any node does
//! ```

use std::process::ExitCode;
use std::sync::{Arc, LazyLock};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use budget::Budget;
use futures_util::FutureExt;
use link::control::{Exit, Hello};
use link::{RobotSession, SessionOptions};
use nix::sys::signal::{SigHandler, Signal, kill, signal};
use nix::unistd::Pid;
use ros::JoinOptions;
use ros::bus::{Bus, BusError, ParamValue, RosVersion};
use ros::net::Sockets;
use tokio::signal::unix::{SignalKind, signal as signals};
use tokio::sync::watch;
use tokio::time::sleep;

use crate::config::{self, Config, LocalMode, ParameterGroup};
use crate::farewell;
use crate::linked;
use crate::local::{OriginalProgram, OriginalSetup};
use crate::machine;
use crate::middleware::{self, RobotMiddleware};
use crate::mirror::diagnostics::Diagnostics;
use crate::mirror::requests::RequestPattern;
use crate::mirror::{Mirror, promise};
use crate::original;
use crate::output;
use crate::pairing;
use crate::resolver::RobotSockets;
use crate::revision::Revision;
use crate::robot::{DefaultName, LaunchedNode, RosLocation, default_node_name};
use crate::setup::{self, RosSetup};

/// Time without any data after which a link counts as down, unless T_max is set.
const SILENT: Duration = Duration::from_secs(2);

/// Time that a local original may take to subscribe to its inputs: it may load a model first, or wait for a transform
/// that does not come.
const READY: Duration = Duration::from_secs(60);

/// Reason why the stub ends.
enum StubEnd {
    /// The real node has ended.
    Node(Exit),
    /// The stub was asked to end.
    Asked,
    /// The cloud has refused this stub.
    Refused(String),
}

/// Runs the stub.
pub fn run(asked: &crate::arguments::RunArgs) -> anyhow::Result<ExitCode> {
    let share = &asked.node.share;
    let config = config::load(share, std::env::vars())?;
    let made_of = Revision::read(share);
    let ros = made_of.ros();
    let variable = |name: &str| std::env::var(name).ok();
    // Before anything joins the wrong network, where nobody would see it.
    let checked = RosSetup::read(&variable).map_or(Ok(()), |found| found.check(ros));
    if let Err(error) = checked {
        bail!("{error}; {}", setup::advice(ros, &config.service));
    }
    if ros == RosVersion::Two {
        RobotMiddleware::read(&variable).map_err(|error| anyhow!("{error}; {}", middleware::advice()))?;
    }
    let executable = &asked.node.node;
    let found = made_of.names.get(executable);
    let set = config.nodes.get(executable);
    let guessed = default_node_name(executable);
    let usual = DefaultName {
        name: set.or(found).unwrap_or(&guessed),
        by_program: found.is_some() && set.is_none_or(|set| Some(set) == found),
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let robot = runtime.block_on(LaunchedNode::read(&asked.argv, usual, ros, &variable))?;
    let end = runtime.block_on(run_stub(asked, config.clone(), &robot))?;
    // Running blocking tasks (a codec, for example) are not waited for.
    runtime.shutdown_background();
    match end {
        StubEnd::Asked => Ok(ExitCode::SUCCESS),
        StubEnd::Node(exit) => {
            output::finish();
            Ok(exit_like(&exit))
        }
        StubEnd::Refused(reason) => {
            if config.local != LocalMode::None {
                tracing::error!("{reason}; running the local original instead");
                output::finish();
                return original::exec(&asked.node, &asked.argv);
            }
            bail!("{reason}")
        }
    }
}

async fn run_stub(asked: &crate::arguments::RunArgs, config: Config, robot: &LaunchedNode) -> anyhow::Result<StubEnd> {
    let mut stopping = stop_signals()?;
    let mut buses = Vec::new();
    let begun = tokio::select! {
        begun = start(asked, config, robot, &mut buses) => begun.map(Some),
        () = wait_for_signal(&mut stopping) => Ok(None),
    };
    let StartedStub { config, mirror, mut hello, mut shutdown } = match begun {
        Ok(Some(begun)) => begun,
        over => {
            farewell::close_buses(&buses).await;
            return over.map(|_| StubEnd::Asked);
        }
    };
    let renewing = tokio::spawn(pairing::run_renewal(config.clone()));
    let mut exit = mirror.exit();
    let linked = linked::run_link(&config, &mirror, &mut hello).fuse();
    tokio::pin!(linked);
    let end = tokio::select! {
        refused = &mut linked => StubEnd::Refused(refused),
        ended = exit.wait_for(Option::is_some) => node_end(ended.ok().and_then(|exit| exit.clone())),
        signal = wait_for_stop(&mut stopping, &mut shutdown) => {
            tracing::debug!(signal, "shutting down");
            let other = async {
                tokio::select! {
                    _ = &mut linked => {}
                    _ = wait_for_stop(&mut stopping, &mut shutdown) => {}
                }
            };
            node_end(farewell::stop_node(&mirror, signal, other).await)
        }
    };
    renewing.abort();
    farewell::close_all(&mirror, linked, &buses).await;
    Ok(end)
}

/// State of the stub before it connects to the cloud.
struct StartedStub {
    config: Config,
    mirror: Arc<Mirror>,
    hello: Hello,
    /// The `shutdown` call of XML-RPC.
    shutdown: Option<watch::Receiver<Option<String>>>,
}

/// Joins the robot's ROS; `buses` are those that were joined so far.
async fn start(
    asked: &crate::arguments::RunArgs,
    config: Config,
    robot: &LaunchedNode,
    buses: &mut Vec<Arc<dyn Bus>>,
) -> anyhow::Result<StartedStub> {
    let bus = join(robot, &robot.node).await?;
    buses.push(Arc::clone(&bus));
    let config = apply_parameters(config, &*bus, robot).await?;
    let made_of = Revision::read(&asked.node.share);
    let config = config.or_defaults(&made_of.defaults);
    if config.has_promise() && config.fallback_after != config::FALLBACK_AFTER {
        tracing::warn!(
            "fallback_after applies only until the server is first reached, because desire and max, a rate or an age \
                are set: after that, those decide when the local original answers"
        );
    }
    let shutdown = bus.shutdown_requested();
    let session = new_session(&config);
    let label = format!("{} for {}", config.service, config.robot_id());
    if let Ok(lending) = bus.lending() {
        lending.set_label(&label);
    }
    let mirror = Mirror::start(bus.clone(), label, session, config.call_limit());
    if let Some(sla) = promise::sla(&config).context("the SLA")? {
        let watcher = join(robot, &format!("{}_cloudroid", robot.node)).await?;
        buses.push(Arc::clone(&watcher));
        let diagnostics = Diagnostics::new(&watcher, &robot.node, &config.robot_id()).await?;
        let original = original_setup(asked, robot);
        let decided = RequestPattern::from_revision(&made_of.requests, &asked.node.node, robot);
        mirror.start_promise(sla, original, decided, diagnostics, &watcher).await?;
    }
    let mut parameters = mirror.parameters().await;
    if robot.sim_time {
        parameters.insert("use_sim_time".to_owned(), ParamValue::Bool(true));
    }
    let hello = Hello {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        ros: robot.ros.number(),
        run: format!("{:016x}", rand::random::<u64>()),
        machine: machine::id(),
        host: machine::host(),
        roscore: machine::roscore_id(&*bus).await,
        node: robot.to_cloud_node(&asked.node.package, &asked.node.node, &asked.node.share),
        sla: config.targets(),
        codecs: match config.codec {
            config::CodecSetting::None => Vec::new(),
            wanted => link::packing::supported_codecs(|codec| wanted.lossy() == Some(codec)),
        },
        quality: config.quality(),
        lends: true,
        keep_stamps: config.stamps == config::StampMode::Keep,
        parameters,
        ..Hello::default()
    };
    Ok(StartedStub { config, mirror, hello, shutdown })
}

/// Returns the end of a node that has exited, or of one whose state is unknown.
fn node_end(exit: Option<Exit>) -> StubEnd {
    match exit {
        Some(exit) => {
            if exit.code != Some(0) {
                tracing::warn!("{}", exit.text);
            }
            StubEnd::Node(exit)
        }
        None => StubEnd::Asked,
    }
}

/// Joins the robot's ROS as a node of this name; waits for the Master, or for a free participant id in the domain, as
/// every node does.
async fn join(robot: &LaunchedNode, node: &str) -> anyhow::Result<Arc<dyn Bus>> {
    let mut told = false;
    loop {
        let joined = async {
            let options = match &robot.place {
                RosLocation::Master { host, port, own } => {
                    let master = RobotSockets.resolve(host, *port).await?;
                    JoinOptions { host: own.clone(), ..JoinOptions::new(master, node) }
                }
                RosLocation::Domain { id, network } => JoinOptions {
                    network: network.clone(),
                    distribution: std::env::var("ROS_DISTRO").unwrap_or_default(),
                    ..JoinOptions::in_domain(*id, node)
                },
            };
            anyhow::Ok(ros::connect(robot.ros, Arc::new(RobotSockets), options).await?)
        };
        match joined.await {
            Ok(bus) => return Ok(bus),
            Err(error) if !told => {
                told = true;
                tracing::warn!("{error:#}; retrying until it is available");
            }
            Err(_) => {}
        }
        sleep(Duration::from_millis(200)).await;
    }
}

/// Returns the configuration with the settings that parameters of the node (ROS 2) or of its namespaces (ROS 1)
/// override.
async fn apply_parameters(config: Config, bus: &dyn Bus, robot: &LaunchedNode) -> anyhow::Result<Config> {
    if robot.ros == RosVersion::Two {
        let settings = robot.settings();
        return config.with_parameters(&[ParameterGroup { name: None, settings }]);
    }
    let mut given = Vec::new();
    for name in config::group_names(&robot.node) {
        match bus.parameter(&name).await {
            Ok(ParamValue::Map(settings)) => given.push(ParameterGroup { name: Some(name), settings }),
            Ok(_) => bail!(
                "parameter {name} is a single value, but this node's settings are expected there; remove it with: \
                    rosparam delete {name}"
            ),
            Err(BusError::NoParam(_)) => {}
            Err(error) => {
                bail!("cannot read parameter {name} ({error}); correct it, or remove it with: rosparam delete {name}")
            }
        }
    }
    config.with_parameters(&given)
}

/// Returns the setup of the original, as it would have been started without this stub.
fn original_setup(asked: &crate::arguments::RunArgs, robot: &LaunchedNode) -> OriginalSetup {
    let overlay = original::overlay(&asked.node.share);
    let path = original::find(&asked.node, &|name| std::env::var(name).ok());
    let (namespace, _) = robot.node.rsplit_once('/').unwrap_or_default();
    let mut environment = original::environment(&overlay);
    let domain = match &robot.place {
        RosLocation::Domain { id, .. } => Some(*id),
        RosLocation::Master { .. } => {
            environment.push(("ROS_NAMESPACE", format!("{namespace}/").into()));
            None
        }
    };
    let argv = robot.original_argv.clone();
    OriginalSetup {
        program: path.map(|path| OriginalProgram { path, argv, environment }),
        node: robot.node.clone(),
        domain,
        patience: READY,
    }
}

/// Memory budget for data from the server: records in progress, and those that it has sent until they are processed. No
/// server uses more of the robot's memory.
pub static FROM_SERVER: LazyLock<Budget> = LazyLock::new(|| Budget::new("data from the server", 256 << 20));

/// Creates a session with the cloud that has no connection yet.
pub fn new_session(config: &Config) -> Arc<RobotSession> {
    Arc::new(RobotSession::new(session_options(config)).with_budget(&FROM_SERVER))
}

/// Returns the timeouts of the link.
fn session_options(config: &Config) -> SessionOptions {
    let max = config.promise_timeout().and_then(|max| Duration::try_from_secs_f64(max).ok());
    SessionOptions::for_silence(max.unwrap_or(SILENT), max)
}

/// Streams of the signals that end a node.
struct StopSignals {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

fn stop_signals() -> std::io::Result<StopSignals> {
    Ok(StopSignals { interrupt: signals(SignalKind::interrupt())?, terminate: signals(SignalKind::terminate())? })
}

async fn wait_for_signal(stopping: &mut StopSignals) {
    tokio::select! {
        _ = stopping.interrupt.recv() => {}
        _ = stopping.terminate.recv() => {}
    }
}

/// Waits for a signal, or for the `shutdown` call of XML-RPC, which is equivalent to SIGINT.
async fn wait_for_stop(stopping: &mut StopSignals, shutdown: &mut Option<watch::Receiver<Option<String>>>) -> i32 {
    let asked = async {
        let is_asked = match shutdown {
            Some(asked) => asked.changed().await.is_ok(),
            None => false,
        };
        if !is_asked {
            std::future::pending::<()>().await;
        }
    };
    tokio::select! {
        _ = stopping.interrupt.recv() => Signal::SIGINT as i32,
        _ = stopping.terminate.recv() => Signal::SIGTERM as i32,
        () = asked => Signal::SIGINT as i32,
    }
}

/// Ends as the real node did: with its exit code, or by its signal.
fn exit_like(exit: &Exit) -> ExitCode {
    if let Some(code) = exit.code {
        return ExitCode::from(u8::try_from(code).unwrap_or(1));
    }
    if let Some(number) = exit.signal.and_then(|number| Signal::try_from(number).ok()) {
        // The real node crashed, so the stub dumps no core.
        let _ = nix::sys::resource::setrlimit(nix::sys::resource::Resource::RLIMIT_CORE, 0, 0);
        reset_signal(number);
        let _ = kill(Pid::this(), number);
    }
    ExitCode::FAILURE
}

#[allow(unsafe_code)]
fn reset_signal(number: Signal) {
    // SAFETY: the default action runs no code of this process.
    let _ = unsafe { signal(number, SigHandler::SigDfl) };
}
