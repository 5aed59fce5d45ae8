//! `cloudroidd`: one process per machine that turns pushed ROS packages into services and gives each connected robot a
//! servant of its own. This file: config → build → serve → drain.
//!
//! ```text
//!   cloudroidctl push ─▶ portal ─▶ push ─▶ rootfs_builder ─▶ image ─▶ catalogue ─▶ store
//!   robot ─▶ portal ─▶ choreographer ─▶ servant engine ─▶ shim ─▶ container
//!              └─────▶ reach: bridge, links ◀──── ros (through the container's network namespace)
//! ```

#![deny(unsafe_code)]

mod admins;
mod bases;
mod certificates;
mod config;
mod doctor;
mod freed;
mod home;
mod log;
mod machine;
mod shim;
mod supervision;
#[cfg(feature = "otel")]
mod telemetry;
mod wiring;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Parser, Subcommand};
use portal::MachineChecks;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;

use config::{Config, IsolationMode};
use home::Home;
use log::LogFormat;

/// Runs ROS packages as services for robots, on this machine.
#[derive(Debug, Parser)]
#[command(name = "cloudroidd", version)]
struct DaemonArguments {
    /// State directory (default: cloudroid in the user's data directory).
    #[arg(long, env = "CLOUDROID_HOME", value_name = "DIR")]
    home: Option<PathBuf>,
    /// Address and port of the portal (default: 127.0.0.1:9090).
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
    /// Configuration file (TOML).
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Format of the log's lines (default: text).
    #[arg(long, value_enum, value_name = "FORMAT")]
    log_format: Option<LogFormat>,
    #[command(subcommand)]
    verb: Option<DaemonCommand>,
}

#[derive(Debug, Subcommand)]
enum DaemonCommand {
    /// Check that this machine meets all requirements; needs no running daemon.
    Doctor {
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

/// Time that blocking work has to end, after everything else has ended.
const LAST_WORK: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    // A servant's shim forks, so it must start before any thread does.
    let mut words = std::env::args_os().skip(1);
    if words.next().is_some_and(|word| word == "shim") {
        let directory = PathBuf::from(words.next().unwrap_or_default());
        return servant::shim::run(&directory, Box::new(shim::MasterResident::default()));
    }
    match run_command(DaemonArguments::parse()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Runs the verb of the command line until it is done or the daemon is stopped.
fn run_command(arguments: DaemonArguments) -> anyhow::Result<()> {
    let config = Config::read(arguments.config.as_deref())?;
    log::start(arguments.log_format.unwrap_or(config.log_format));
    if let Some(DaemonCommand::Doctor { json }) = arguments.verb {
        return examine(&arguments, &config, json);
    }
    let (config, home, machine) = prepare(arguments, config)?;
    let (engine, portal) = start_threads(&config)?;
    let outcome = portal.block_on(run(config, home, machine));
    // Threads that still work for a cancelled push are not waited for: what they make is unfinished, and the next
    // daemon removes it.
    portal.shutdown_timeout(LAST_WORK);
    engine.end(LAST_WORK);
    outcome
}

/// Starts the engine's threads, which keep the capabilities that containers need, and the portal's, which have none and
/// run everything that is not handed to the engine.
fn start_threads(config: &Config) -> anyhow::Result<(privilege::Engine, tokio::runtime::Runtime)> {
    let account = config.account()?;
    privilege::limit_capabilities()?;
    let engine = privilege::Engine::start(account)?;
    // Confine one thread first, where a failure can still be reported.
    std::thread::scope(|scope| scope.spawn(|| privilege::confine(account)).join())
        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
    let portal = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .thread_name("portal")
        .on_thread_start(move || {
            if let Err(error) = privilege::confine(account) {
                tracing::error!("{error}; stopping, because threads that serve clients must not keep privileges");
                std::process::abort();
            }
        })
        .build()?;
    Ok((engine, portal))
}

fn home_path(arguments: &DaemonArguments) -> anyhow::Result<PathBuf> {
    match &arguments.home {
        Some(home) => Ok(home.clone()),
        None => Ok(home::default_path(|name| std::env::var_os(name))?),
    }
}

fn examine(arguments: &DaemonArguments, config: &Config, json: bool) -> anyhow::Result<()> {
    let mut doubts = config.machine_warnings(machine::resources());
    doubts.extend(config.ros.read_rules().err().map(|error| format!("[ros] {error}")));
    let collector = config.telemetry.as_ref();
    let doctor = doctor::examine(&home_path(arguments)?, None, &doubts, collector);
    if json {
        println!("{}", serde_json::to_string_pretty(&doctor)?);
        return Ok(());
    }
    for check in &doctor.checks {
        let mark = match check.status {
            api::CheckStatus::Ok => "ok     ",
            api::CheckStatus::Warning => "warning",
            api::CheckStatus::Missing => "MISSING",
        };
        println!("{mark} {}: {}", check.name, check.found);
        if let Some(fix) = &check.fix {
            println!("    {fix}");
        }
    }
    if doctor.is_healthy() { Ok(()) } else { bail!("requirements are missing") }
}

/// Makes all checks that need no change except to the state directory.
fn prepare(arguments: DaemonArguments, mut config: Config) -> anyhow::Result<(Config, Home, MachineChecks)> {
    if let Err(error) = machine::raise_descriptor_limit() {
        tracing::warn!("cannot raise the limit of open files: {error}");
    }
    config.listen = arguments.listen.unwrap_or(config.listen);
    config.check()?;
    let path = home_path(&arguments)?;
    require_root(nix::unistd::geteuid())?;
    let home = Home::open(&path)?;
    let (mut machine, missing) = doctor::check_requirements(home.path());
    machine.warnings.extend(config.machine_warnings(machine::resources()));
    if !missing.is_empty() {
        bail!("this machine lacks requirements for servants:\n{}", doctor::list(&missing));
    }
    if config.isolation == IsolationMode::Require && !machine.missing_limits.is_empty() {
        bail!(
            "this machine cannot limit servants in {}, and the configuration says isolation = \"require\"; \
             see cloudroidd doctor, or set isolation = \"best-effort\"",
            machine.missing_limits.join(", ")
        );
    }
    Ok((config, home, machine))
}

fn require_root(user: nix::unistd::Uid) -> anyhow::Result<()> {
    if !user.is_root() {
        bail!("creating servants needs root, but this is user {user}; run:\n    {}", sudo_command());
    }
    Ok(())
}

/// Returns this command line with sudo.
fn sudo_command() -> String {
    let quoted = |word: OsString| {
        let text = word.to_string_lossy().into_owned();
        let plain = !text.is_empty() && text.chars().all(|c| c.is_ascii_alphanumeric() || "/._-=:,@".contains(c));
        if plain { text } else { format!("'{}'", text.replace('\'', "'\\''")) }
    };
    let command: Vec<String> = std::env::args_os().map(quoted).collect();
    format!("sudo {}", command.join(" "))
}

async fn run(config: Config, home: Home, machine: MachineChecks) -> anyhow::Result<()> {
    let socket = home.socket();
    let asked = supervision::termination_token(move || {
        let _ = privilege::run_sync(move || std::fs::remove_file(socket));
    })?;
    let listener = listen(config.listen).await?;
    let looked_at = certificates::listen_for_challenges(config.tls.acme.as_ref()).await?;
    let socket = home.listen()?;
    let runtime = std::env::var_os("RUNTIME_DIRECTORY").map(PathBuf::from);
    let admins = admins::AdminSocket::from_config(&config, runtime)?;
    let admins = admins.map(|admins| admins.listen()).transpose()?;
    let app = wiring::build(&config, &home, machine, listener.local_addr()?)?;
    for warning in &app.machine.warnings {
        tracing::warn!("{warning}");
    }
    app.catalogue.repair_tags().await.context("cannot repair the image store")?;
    app.choreographer.keep_rollouts().context("cannot resume the rollouts of a previous daemon")?;
    let half_made = home.leftover_builds();
    let choreographer::AdoptionResult { adopted, removal } =
        app.choreographer.adopt().await.context("cannot adopt the servants of a previous daemon")?;
    let router = portal::router(Arc::clone(&app));
    let tcp = tokio::spawn(portal::serve_tcp(Arc::clone(&app), router.clone(), listener));
    let unix = tokio::spawn(portal::serve_unix(Arc::clone(&app), router.clone(), socket, None));
    let history = tokio::spawn(portal::keep_history(Arc::clone(&app)));
    let observers = tokio::spawn(portal::keep_observers(Arc::clone(&app)));
    let members = tokio::spawn(admins::serve(Arc::clone(&app), router, admins));
    tokio::spawn(freed::trim_periodically());
    if let Some((certificate, key)) = config.tls.certificate_files() {
        // Only root can read the key.
        let keeping = certificates::watch_certificate(Arc::clone(&app), certificate, key);
        tokio::spawn(privilege::run(keeping));
    }
    if let Some(lists) = config.tls.client_revocations.clone() {
        let keeping = certificates::watch_revocation_lists(Arc::clone(&app), lists);
        tokio::spawn(privilege::run(keeping));
    }
    if let Some(acme) = config.tls.acme.clone() {
        if let Some(looked_at) = looked_at {
            tokio::spawn(portal::serve_challenges(Arc::clone(&app), looked_at));
        }
        let renewal = certificates::Renewal::new(Arc::clone(&app), acme, &home, app.listen);
        tokio::spawn(renewal.run());
    }
    let (scheme, shown) = match &app.tls {
        Some(tls) => ("https", format!(" (certificate {})", tls.fingerprint())),
        None => ("http", String::new()),
    };
    tracing::info!(
        "cloudroidd {} listens on {scheme}://{}{shown} with state below {}; {adopted} servants adopted",
        env!("CARGO_PKG_VERSION"),
        app.listen,
        home.path().display()
    );
    supervision::notify_ready();
    tokio::spawn(remove_leftovers(Arc::clone(&app), removal, half_made));
    app.catalogue.record_missing_inventories().await?;
    app.choreographer.watch_nodes();
    app.choreographer.keep_warm_pool();
    app.choreographer.keep_watch();
    asked.cancelled().await;
    supervision::notify_stopping();
    wiring::drain(&app, config.keeps_servants()).await;
    app.ending.cancel();
    let _ = tokio::join!(tcp, unix, members, history, observers);
    let _ = std::fs::remove_file(home.socket());
    Ok(())
}

/// Removes what an earlier daemon left, while robots are already served: its containers, then their builds, then unused
/// content of the image store. If it is interrupted, the next start continues.
async fn remove_leftovers(app: Arc<portal::App>, removal: JoinHandle<()>, half_made: Vec<PathBuf>) {
    if let Err(panic) = removal.await {
        tracing::error!("cannot remove leftovers of a previous daemon: {panic}");
    }
    let _ = privilege::spawn_blocking(move || home::sweep_builds(&half_made)).await;
    app.pusher.collect_garbage().await;
}

async fn listen(address: SocketAddr) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address).await.map_err(|error| match error.kind() {
        std::io::ErrorKind::AddrInUse => anyhow::anyhow!(
            "{address} is used by another program (ss -ltnp 'sport = :{}' shows which); stop it, or choose another \
                    port with --listen {}:{}",
            address.port(),
            address.ip(),
            address.port().checked_add(1).unwrap_or(9090)
        ),
        _ => anyhow::Error::new(error).context(format!("cannot listen on {address}; choose another with --listen")),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        DaemonArguments::command().debug_assert();
    }

    #[test]
    fn a_log_format_that_does_not_exist_is_refused_with_those_that_do() {
        let parse = |format: &str| DaemonArguments::try_parse_from(["cloudroidd", "--log-format", format]);
        let refused = parse("xml").expect_err("no such format").to_string();
        assert!(refused.contains("text") && refused.contains("json"), "{refused}");
        let arguments = parse("json").expect("a format");
        assert_eq!(arguments.log_format, Some(LogFormat::Json));
    }

    #[test]
    fn without_root_the_command_that_has_it_is_named() {
        let refused = require_root(nix::unistd::Uid::from_raw(1000)).expect_err("not root").to_string();
        let this = std::env::args().next().expect("this program");
        assert!(refused.contains("user 1000") && refused.contains(&format!("sudo {this}")), "{refused}");
        require_root(nix::unistd::Uid::from_raw(0)).expect("root");
    }

    #[tokio::test]
    async fn a_taken_port_is_named_with_the_way_out() {
        let holder = listen("127.0.0.1:0".parse().expect("an address")).await.expect("a free port");
        let address = holder.local_addr().expect("bound");
        let refused = listen(address).await.expect_err("taken").to_string();
        assert!(refused.contains(&address.to_string()) && refused.contains("--listen"), "{refused}");
    }
}
