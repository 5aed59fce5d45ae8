//! `cloudroidd`: one process per machine that turns pushed ROS packages into services, and gives each robot that
//! connects a servant of its own. Here: config → build → serve → drain.
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
mod machine;
mod shim;
mod supervision;
mod wiring;

use std::ffi::OsString;
use std::io::IsTerminal;
use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Parser, Subcommand};
use portal::Machine;
use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tracing_subscriber::EnvFilter;

use config::{Config, IsolationMode};
use home::Home;

/// Robot packages as services, on this machine.
#[derive(Debug, Parser)]
#[command(name = "cloudroidd", version)]
struct Arguments {
    /// State directory; cloudroid below the user's data directory by default.
    #[arg(long, env = "CLOUDROID_HOME", value_name = "DIR")]
    home: Option<PathBuf>,
    /// Address and port of the portal; 127.0.0.1:9090 by default.
    #[arg(long, value_name = "ADDR")]
    listen: Option<SocketAddr>,
    /// Configuration file (TOML).
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Check what this machine needs, without a daemon.
    Doctor {
        /// Print JSON.
        #[arg(long)]
        json: bool,
    },
}

/// How long blocking work may take to end, once everything else has.
const LAST_WORK: Duration = Duration::from_secs(1);

fn main() -> ExitCode {
    // A servant's shim forks: it must begin before any thread does.
    let mut words = std::env::args_os().skip(1);
    if words.next().is_some_and(|word| word == "shim") {
        let directory = PathBuf::from(words.next().unwrap_or_default());
        return servant::shim::run(&directory, Box::new(shim::MasterResident::default()));
    }
    let arguments = Arguments::parse();
    let filter =
        EnvFilter::try_from_env("CLOUDROID_LOG").unwrap_or_else(|_| EnvFilter::new("info"));
    tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_writer(std::io::stderr)
        .with_ansi(std::io::stderr().is_terminal())
        .with_target(false)
        .init();
    let outcome = match &arguments.verb {
        Some(Verb::Doctor { json }) => examine(&arguments, *json),
        None => prepare(arguments).and_then(|(config, home, machine)| {
            let (engine, portal) = threads(&config)?;
            let outcome = portal.block_on(run(config, home, machine));
            // Threads that still work for a cancelled push are not waited for: what they make is half-made, and the
            // next daemon sweeps it.
            portal.shutdown_timeout(LAST_WORK);
            engine.end(LAST_WORK);
            outcome
        }),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// The engine's threads, which keep what containers take, and the portal's, which have no rights and on which everything runs
/// that is not handed over.
fn threads(config: &Config) -> anyhow::Result<(privilege::Engine, tokio::runtime::Runtime)> {
    let account = config.account()?;
    privilege::limit()?;
    let engine = privilege::Engine::start(account)?;
    // Tried once where it can be said why it fails.
    std::thread::scope(|scope| scope.spawn(|| privilege::confine(account)).join())
        .unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
    let portal = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .thread_name("portal")
        .on_thread_start(move || {
            if let Err(error) = privilege::confine(account) {
                tracing::error!(
                    "{error}; ending, because no thread may answer strangers with rights"
                );
                std::process::abort();
            }
        })
        .build()?;
    Ok((engine, portal))
}

fn home_of(arguments: &Arguments) -> anyhow::Result<PathBuf> {
    match &arguments.home {
        Some(home) => Ok(home.clone()),
        None => Ok(home::default_path(|name| std::env::var_os(name))?),
    }
}

fn examine(arguments: &Arguments, json: bool) -> anyhow::Result<()> {
    let config = Config::read(arguments.config.as_deref())?;
    let doubts = config.doubts(machine::has());
    let doctor = doctor::examine(&home_of(arguments)?, None, &doubts);
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
    if doctor.well() {
        Ok(())
    } else {
        bail!("something that is needed is missing")
    }
}

/// Everything that can be refused without having changed anything but the state directory.
fn prepare(arguments: Arguments) -> anyhow::Result<(Config, Home, Machine)> {
    if let Err(error) = machine::raise_descriptors() {
        tracing::warn!("the number of open files cannot be raised: {error}");
    }
    let mut config = Config::read(arguments.config.as_deref())?;
    config.listen = arguments.listen.unwrap_or(config.listen);
    config.check()?;
    let path = home_of(&arguments)?;
    require_root(nix::unistd::geteuid())?;
    let home = Home::open(&path)?;
    let (mut machine, missing) = doctor::look(home.path());
    machine.warnings.extend(config.doubts(machine::has()));
    if !missing.is_empty() {
        bail!(
            "this machine lacks what servants need:\n{}",
            doctor::list(&missing)
        );
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
        bail!(
            "servants are made by root, and this is user {user}; run:\n    {}",
            as_root()
        );
    }
    Ok(())
}

/// This very command, by sudo.
fn as_root() -> String {
    let quoted = |word: OsString| {
        let text = word.to_string_lossy().into_owned();
        let plain = !text.is_empty()
            && text
                .chars()
                .all(|c| c.is_ascii_alphanumeric() || "/._-=:,@".contains(c));
        if plain {
            text
        } else {
            format!("'{}'", text.replace('\'', "'\\''"))
        }
    };
    let command: Vec<String> = std::env::args_os().map(quoted).collect();
    format!("sudo {}", command.join(" "))
}

async fn run(config: Config, home: Home, machine: Machine) -> anyhow::Result<()> {
    let socket = home.socket();
    let asked = supervision::end_asked(move || {
        let _ = privilege::now(move || std::fs::remove_file(socket));
    })?;
    let listener = listen(config.listen).await?;
    let looked_at = certificates::listen_for_challenges(config.tls.acme.as_ref()).await?;
    let socket = home.listen()?;
    let runtime = std::env::var_os("RUNTIME_DIRECTORY").map(PathBuf::from);
    let admins = admins::Admins::of(&config, runtime)?;
    let admins = admins.map(|admins| admins.listen()).transpose()?;
    let app = wiring::build(&config, &home, machine, listener.local_addr()?)?;
    for warning in &app.machine.warnings {
        tracing::warn!("{warning}");
    }
    app.catalogue
        .repair()
        .await
        .context("cannot repair the image store")?;
    app.choreographer
        .keep_rollouts()
        .context("cannot go on with the rollouts of an earlier daemon")?;
    let half_made = home.half_made_builds();
    let choreographer::Inheritance { adopted, removal } = app
        .choreographer
        .adopt()
        .await
        .context("cannot take over the servants of an earlier daemon")?;
    let router = portal::router(Arc::clone(&app));
    let tcp = tokio::spawn(portal::serve_tcp(
        Arc::clone(&app),
        router.clone(),
        listener,
    ));
    let unix = tokio::spawn(portal::serve_unix(
        Arc::clone(&app),
        router.clone(),
        socket,
        None,
    ));
    let history = tokio::spawn(portal::keep_history(Arc::clone(&app)));
    let observers = tokio::spawn(portal::keep_observers(Arc::clone(&app)));
    let members = tokio::spawn(admins::serve(Arc::clone(&app), router, admins));
    tokio::spawn(freed::give_back());
    if let Some((certificate, key)) = config.tls.files() {
        // The key is root's.
        let keeping = certificates::keep(Arc::clone(&app), certificate, key);
        tokio::spawn(privilege::run(keeping));
    }
    if let Some(lists) = config.tls.client_revocations.clone() {
        let keeping = certificates::keep_lists(Arc::clone(&app), lists);
        tokio::spawn(privilege::run(keeping));
    }
    if let Some(acme) = config.tls.acme.clone() {
        if let Some(looked_at) = looked_at {
            tokio::spawn(portal::serve_challenges(Arc::clone(&app), looked_at));
        }
        let renewal = certificates::Renewal::new(Arc::clone(&app), acme, &home, app.listen);
        tokio::spawn(renewal.keep());
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
    supervision::ready();
    tokio::spawn(tidy(Arc::clone(&app), removal, half_made));
    app.catalogue.complete().await?;
    app.choreographer.watch_nodes();
    app.choreographer.keep_warm_pool();
    app.choreographer.keep_watch();
    asked.cancelled().await;
    supervision::stopping();
    wiring::drain(&app, config.keeps_servants()).await;
    app.ending.cancel();
    let _ = tokio::join!(tcp, unix, members, history, observers);
    let _ = std::fs::remove_file(home.socket());
    Ok(())
}

/// Removes what an earlier daemon left, beside robots that are served already: containers, then the builds that they worked at,
/// then what of the image store nothing needs. What is interrupted the next start goes on with.
async fn tidy(app: Arc<portal::App>, removal: JoinHandle<()>, half_made: Vec<PathBuf>) {
    if let Err(panic) = removal.await {
        tracing::error!("what an earlier daemon left could not be removed: {panic}");
    }
    let _ = privilege::blocking(move || home::sweep_builds(&half_made)).await;
    app.pusher.collect_garbage().await;
}

async fn listen(address: SocketAddr) -> anyhow::Result<TcpListener> {
    TcpListener::bind(address)
        .await
        .map_err(|error| match error.kind() {
            std::io::ErrorKind::AddrInUse => anyhow::anyhow!(
                "{address} is taken by another program (ss -ltnp 'sport = :{}' shows which); \
             end it, or choose another port with --listen {}:{}",
                address.port(),
                address.ip(),
                address.port().checked_add(1).unwrap_or(9090)
            ),
            _ => anyhow::Error::new(error).context(format!(
                "cannot listen on {address}; choose another with --listen"
            )),
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Arguments::command().debug_assert();
    }

    #[test]
    fn without_root_the_command_that_has_it_is_named() {
        let refused = require_root(nix::unistd::Uid::from_raw(1000))
            .expect_err("not root")
            .to_string();
        let this = std::env::args().next().expect("this program");
        assert!(
            refused.contains("user 1000") && refused.contains(&format!("sudo {this}")),
            "{refused}"
        );
        require_root(nix::unistd::Uid::from_raw(0)).expect("root");
    }

    #[tokio::test]
    async fn a_taken_port_is_named_with_the_way_out() {
        let holder = listen("127.0.0.1:0".parse().expect("an address"))
            .await
            .expect("a free port");
        let address = holder.local_addr().expect("bound");
        let refused = listen(address).await.expect_err("taken").to_string();
        assert!(
            refused.contains(&address.to_string()) && refused.contains("--listen"),
            "{refused}"
        );
    }
}
