//! The life of a stub: from roslaunch's exec to the real node's exit status.
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

use anyhow::{Context, bail};
use budget::Budget;
use futures_util::FutureExt;
use link::control::{Exit, Hello, Sla};
use link::{RobotSession, SessionOptions};
use nix::sys::signal::{SigHandler, Signal, kill, signal};
use nix::unistd::Pid;
use ros::JoinOptions;
use ros::bus::{Bus, BusError, ParamValue, RosVersion};
use ros::net::Sockets;
use tokio::signal::unix::{SignalKind, signal as signals};
use tokio::sync::watch;
use tokio::time::sleep;

use crate::config::{self, Config, Group, Local};
use crate::farewell;
use crate::linked;
use crate::local::{Program, Setting};
use crate::machine;
use crate::mirror::diagnostics::Diagnostics;
use crate::mirror::requests::Request;
use crate::mirror::{Mirror, promise};
use crate::original;
use crate::output;
use crate::pairing;
use crate::resolver::RobotSockets;
use crate::revision::Revision;
use crate::robot::{Place, Robot, Usual, usual_name};

/// Where no T_max is given, a link silent for so long counts as down.
const SILENT: Duration = Duration::from_secs(2);

/// How long a local original may take to listen to its requests: a model may be loaded before, or a transform be awaited that does
/// not come.
const READY: Duration = Duration::from_secs(60);

/// How it ends.
enum End {
    /// The real node has ended.
    Node(Exit),
    /// Someone asked for it.
    Asked,
    /// The cloud does not want this stub.
    Refused(String),
}

/// Runs the stub.
pub fn run(asked: &crate::arguments::Run) -> anyhow::Result<ExitCode> {
    let share = &asked.node.share;
    let config = config::read(share, std::env::vars())?;
    let made_of = Revision::read(share);
    let executable = &asked.node.node;
    let found = made_of.names.get(executable);
    let set = config.nodes.get(executable);
    let guessed = usual_name(executable);
    let usual = Usual {
        name: set.or(found).unwrap_or(&guessed),
        by_program: found.is_some() && set.is_none_or(|set| Some(set) == found),
    };
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()?;
    let ros = made_of.ros();
    let variable = |name: &str| std::env::var(name).ok();
    let robot = runtime.block_on(Robot::read(&asked.argv, usual, ros, &variable))?;
    let end = runtime.block_on(live(asked, config.clone(), &robot))?;
    // Whatever still runs elsewhere (a codec, say) is not waited for.
    runtime.shutdown_background();
    match end {
        End::Asked => Ok(ExitCode::SUCCESS),
        End::Node(exit) => {
            output::finish();
            Ok(exit_as(&exit))
        }
        End::Refused(reason) => {
            if config.local != Local::None {
                tracing::error!("{reason}; running the local original instead");
                output::finish();
                return original::exec(&asked.node, &asked.argv);
            }
            bail!("{reason}")
        }
    }
}

async fn live(asked: &crate::arguments::Run, config: Config, robot: &Robot) -> anyhow::Result<End> {
    let mut stopping = stopping()?;
    let mut buses = Vec::new();
    let begun = tokio::select! {
        begun = begin(asked, config, robot, &mut buses) => begun.map(Some),
        () = stopped(&mut stopping) => Ok(None),
    };
    let Begun {
        config,
        mirror,
        mut hello,
        mut shutdown,
    } = match begun {
        Ok(Some(begun)) => begun,
        over => {
            farewell::of_the_robot(&buses).await;
            return over.map(|_| End::Asked);
        }
    };
    let renewing = tokio::spawn(pairing::keep_renewed(config.clone()));
    let mut exit = mirror.exit();
    let linked = linked::keep(&config, &mirror, &mut hello).fuse();
    tokio::pin!(linked);
    let end = tokio::select! {
        refused = &mut linked => End::Refused(refused),
        ended = exit.wait_for(Option::is_some) => node_end(ended.ok().and_then(|exit| exit.clone())),
        signal = asked_to_stop(&mut stopping, &mut shutdown) => {
            tracing::debug!(signal, "asked to end");
            let other = async {
                tokio::select! {
                    _ = &mut linked => {}
                    _ = asked_to_stop(&mut stopping, &mut shutdown) => {}
                }
            };
            node_end(farewell::of_the_node(&mirror, signal, other).await)
        }
    };
    renewing.abort();
    farewell::of_all(&mirror, linked, &buses).await;
    Ok(end)
}

/// What there is before the cloud is asked for.
struct Begun {
    config: Config,
    mirror: Arc<Mirror>,
    hello: Hello,
    /// XML-RPC's `shutdown`.
    shutdown: Option<watch::Receiver<Option<String>>>,
}

/// Becomes a node of the robot; `buses` are those that it has joined so far.
async fn begin(
    asked: &crate::arguments::Run,
    config: Config,
    robot: &Robot,
    buses: &mut Vec<Arc<dyn Bus>>,
) -> anyhow::Result<Begun> {
    let bus = join(robot, &robot.node).await?;
    buses.push(Arc::clone(&bus));
    let config = with_parameters(config, &*bus, robot).await?;
    let made_of = Revision::read(&asked.node.share);
    let config = config.or(&made_of.defaults);
    if config.promises() && config.fallback_after != config::FALLBACK_AFTER {
        tracing::warn!(
            "fallback_after counts only until the server is reached for the first time where desire and max, a rate or an age are given: then those decide when the local original answers"
        );
    }
    let shutdown = bus.shutdown_requested();
    let session = session(&config);
    let label = format!("{} for {}", config.service, config.robot());
    if let Ok(lending) = bus.lending() {
        lending.set_label(&label);
    }
    let mirror = Mirror::start(bus.clone(), label, session, config.call_limit());
    if let Some(sla) = promise::sla(&config).context("the SLA")? {
        let watcher = join(robot, &format!("{}_cloudroid", robot.node)).await?;
        buses.push(Arc::clone(&watcher));
        let diagnostics = Diagnostics::new(&watcher, &robot.node, &config.robot()).await?;
        let original = local_original(asked, robot);
        let decided = Request::decided(&made_of.requests, &asked.node.node, robot);
        mirror
            .promise(sla, original, decided, diagnostics, &watcher)
            .await?;
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
        roscore: machine::roscore(&*bus).await,
        node: robot.for_the_cloud(&asked.node.package, &asked.node.node, &asked.node.share),
        sla: sla(&config),
        codecs: match config.codec {
            config::Codec::None => Vec::new(),
            wanted => link::packing::decoded_here(|codec| wanted.lossy() == Some(codec)),
        },
        quality: config.quality(),
        lends: true,
        keep_stamps: config.stamps == config::Stamps::Keep,
        parameters,
        ..Hello::default()
    };
    Ok(Begun {
        config,
        mirror,
        hello,
        shutdown,
    })
}

/// Of a node that has ended, or of which nothing is known.
fn node_end(exit: Option<Exit>) -> End {
    match exit {
        Some(exit) => {
            if exit.code != Some(0) {
                tracing::warn!("{}", exit.text);
            }
            End::Node(exit)
        }
        None => End::Asked,
    }
}

/// Joins the robot's ROS as a node of this name; waits for its Master, or for room in its domain, as every node does.
async fn join(robot: &Robot, node: &str) -> anyhow::Result<Arc<dyn Bus>> {
    let mut told = false;
    loop {
        let joined = async {
            let options = match &robot.place {
                Place::Master { host, port, own } => {
                    let master = RobotSockets.resolve(host, *port).await?;
                    JoinOptions {
                        host: own.clone(),
                        ..JoinOptions::new(master, node)
                    }
                }
                Place::Domain { id, network } => JoinOptions {
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
                tracing::warn!("{error:#}; trying again until it is there");
            }
            Err(_) => {}
        }
        sleep(Duration::from_millis(200)).await;
    }
}

/// The configuration with what parameters of the node (ROS 2), or of its namespaces (ROS 1), say instead.
async fn with_parameters(config: Config, bus: &dyn Bus, robot: &Robot) -> anyhow::Result<Config> {
    if robot.ros == RosVersion::Two {
        let settings = robot.settings();
        return config.with_parameters(&[Group {
            name: None,
            settings,
        }]);
    }
    let mut given = Vec::new();
    for name in config::groups(&robot.node) {
        match bus.parameter(&name).await {
            Ok(ParamValue::Map(settings)) => given.push(Group {
                name: Some(name),
                settings,
            }),
            Ok(_) => bail!(
                "parameter {name} is a single value, and stands where this node's settings are looked for; remove it with: rosparam delete {name}"
            ),
            Err(BusError::NoParam(_)) => {}
            Err(error) => bail!(
                "parameter {name} cannot be read ({error}); set it otherwise, or remove it with: rosparam delete {name}"
            ),
        }
    }
    config.with_parameters(&given)
}

/// How the original would have been started without this stub.
fn local_original(asked: &crate::arguments::Run, robot: &Robot) -> Setting {
    let overlay = original::overlay(&asked.node.share);
    let path = original::find(&asked.node, &|name| std::env::var(name).ok());
    let (namespace, _) = robot.node.rsplit_once('/').unwrap_or_default();
    let mut environment = original::environment(&overlay);
    let domain = match &robot.place {
        Place::Domain { id, .. } => Some(*id),
        Place::Master { .. } => {
            environment.push(("ROS_NAMESPACE", format!("{namespace}/").into()));
            None
        }
    };
    let argv = robot.original_argv.clone();
    Setting {
        program: path.map(|path| Program {
            path,
            argv,
            environment,
        }),
        node: robot.node.clone(),
        domain,
        patience: READY,
    }
}

/// Memory for what the server sends: what is under way, and what it tells until that is done. No server takes more of the robot's.
pub static FROM_SERVER: LazyLock<Budget> =
    LazyLock::new(|| Budget::new("what the server sends", 256 << 20));

/// A session with the cloud that no connection carries yet.
pub fn session(config: &Config) -> Arc<RobotSession> {
    Arc::new(RobotSession::new(session_options(config)).within(&FROM_SERVER))
}

/// How the link is watched.
fn session_options(config: &Config) -> SessionOptions {
    let max = config
        .longest()
        .and_then(|max| Duration::try_from_secs_f64(max).ok());
    SessionOptions::for_silence(max.unwrap_or(SILENT), max)
}

fn sla(config: &Config) -> Sla {
    Sla {
        desire: config.desire,
        max: config.max,
        frames_per_second: config.frames_per_second,
        desired_frames_per_second: config.desired_frames_per_second,
        age: config.age,
        desired_age: config.desired_age,
        threshold: config.threshold,
        fallback_after: (!config.promises() && config.local != Local::None)
            .then_some(config.fallback_after),
    }
}

/// The streams of signals that end a node.
struct Stopping {
    interrupt: tokio::signal::unix::Signal,
    terminate: tokio::signal::unix::Signal,
}

fn stopping() -> std::io::Result<Stopping> {
    Ok(Stopping {
        interrupt: signals(SignalKind::interrupt())?,
        terminate: signals(SignalKind::terminate())?,
    })
}

async fn stopped(stopping: &mut Stopping) {
    tokio::select! {
        _ = stopping.interrupt.recv() => {}
        _ = stopping.terminate.recv() => {}
    }
}

/// A signal, or XML-RPC's `shutdown`, which means the same as SIGINT.
async fn asked_to_stop(
    stopping: &mut Stopping,
    shutdown: &mut Option<watch::Receiver<Option<String>>>,
) -> i32 {
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

/// Ends as the real node did: by its code, or by its signal.
fn exit_as(exit: &Exit) -> ExitCode {
    if let Some(code) = exit.code {
        return ExitCode::from(u8::try_from(code).unwrap_or(1));
    }
    if let Some(number) = exit.signal.and_then(|number| Signal::try_from(number).ok()) {
        // The crash was the real node's: no core of the stub.
        let _ = nix::sys::resource::setrlimit(nix::sys::resource::Resource::RLIMIT_CORE, 0, 0);
        restore(number);
        let _ = kill(Pid::this(), number);
    }
    ExitCode::FAILURE
}

#[allow(unsafe_code)]
fn restore(number: Signal) {
    // SAFETY: the default action runs no code of this process.
    let _ = unsafe { signal(number, SigHandler::SigDfl) };
}
