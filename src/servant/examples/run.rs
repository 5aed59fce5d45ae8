//! Runs one program in a servant made of layer directories, to try the engine without a daemon.
//!
//!     cargo run -p servant --example run -- --layer DIR [--layer DIR]... [--memory BYTES] [--pids N] [--cpus N]
//!         [--home DIR] [--hold] -- /bin/program argument...
//!
//! With `--hold` the servant stays until Enter is pressed, and what it costs is printed. The program is its own shim: it calls
//! itself as `run shim DIRECTORY`. The init is found by CLOUDROID_INIT, or beside the build's other profiles.

use std::ffi::OsString;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Instant;

use servant::container::{ContainerSpec, Profile};
use servant::engine::{LogStart, Servant};
use servant::local::{LocalEngine, LocalEngineConfig};
use servant::shim::NoResident;
use servant::spec::NodeSpec;

type Failure = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    // Before anything else: a shim must have one thread.
    if let [_, word, directory] = arguments.as_slice() {
        if word == "shim" {
            return servant::shim::run(Path::new(directory), Box::new(NoResident));
        }
    }
    match run(arguments) {
        Ok(code) => code,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

#[derive(Default)]
struct Wish {
    layers: Vec<PathBuf>,
    home: Option<PathBuf>,
    limits: servant::spec::Limits,
    hold: bool,
    argv: Vec<String>,
}

fn parse(arguments: Vec<OsString>) -> Result<Wish, Failure> {
    let mut wish = Wish::default();
    let mut words = arguments
        .into_iter()
        .skip(1)
        .map(|word| word.into_string().map_err(|_| "arguments must be UTF-8"));
    while let Some(word) = words.next().transpose()? {
        let mut value = || {
            words
                .next()
                .transpose()?
                .ok_or_else(|| Failure::from(format!("{word} needs a value")))
        };
        match word.as_str() {
            "--layer" => wish.layers.push(std::fs::canonicalize(value()?)?),
            "--home" => wish.home = Some(value()?.into()),
            "--memory" => wish.limits.memory = Some(value()?.parse()?),
            "--pids" => wish.limits.pids = Some(value()?.parse()?),
            "--cpus" => wish.limits.cpus = Some(value()?.parse()?),
            "--hold" => wish.hold = true,
            "--" => break,
            _ => {
                return Err(
                    format!("unknown option {word}: see the head of examples/run.rs").into(),
                );
            }
        }
    }
    wish.argv = words.collect::<Result<_, _>>()?;
    if wish.argv.is_empty() || wish.layers.is_empty() {
        return Err(
            "give --layer DIR and, after --, a program: see the head of examples/run.rs".into(),
        );
    }
    Ok(wish)
}

#[tokio::main]
async fn run(arguments: Vec<OsString>) -> Result<ExitCode, Failure> {
    let wish = parse(arguments)?;
    let home = wish
        .home
        .unwrap_or_else(|| std::env::temp_dir().join("cloudroid-run"));
    let own = std::env::current_exe()?;
    let command = vec![own.clone().into_os_string(), "shim".into()];
    let engine = LocalEngine::new(LocalEngineConfig::new(home, command, find_init(&own)?))?;
    engine.warm_up();
    let cgroups = engine.cgroups();
    eprintln!(
        "cgroup v{}: {} {}",
        cgroups.version,
        cgroups.controllers().join(" "),
        cgroups.reason
    );
    let node: NodeSpec =
        serde_json::from_value(serde_json::json!({ "name": "/node", "argv": wish.argv }))?;
    let spec = ContainerSpec {
        id: format!("run-{}", std::process::id()),
        layers: wish.layers,
        writable: None,
        profile: Profile::Servant,
        limits: wish.limits,
        environment: [("PATH".to_owned(), "/usr/bin:/bin".to_owned())].into(),
        nodes: vec![node],
        owned_directories: vec![],
        mounts: vec![],
        hosts: Vec::new(),
        resident: serde_json::Value::Null,
    };
    let begun = Instant::now();
    let servant = engine.start_container(spec).await?;
    eprintln!(
        "running after {:.1} ms; in force: {:?}",
        begun.elapsed().as_secs_f64() * 1e3,
        servant.enforced()
    );
    let mut lines = servant.follow(LogStart::First);
    let printer = tokio::spawn(async move {
        while let Some(line) = lines.recv().await {
            println!("{}", line.line);
        }
    });
    if wish.hold {
        eprintln!(
            "processes {:?}, {:?}; Enter ends it",
            servant.processes()?,
            servant.usage().await?
        );
        tokio::task::spawn_blocking(|| std::io::stdin().read_line(&mut String::new())).await??;
    }
    let exit = if wish.hold {
        None
    } else {
        Some(servant.wait_node("/node").await?)
    };
    let begun = Instant::now();
    servant.stop().await?;
    printer.await?;
    eprintln!(
        "{exit:?}; gone after {:.1} ms",
        begun.elapsed().as_secs_f64() * 1e3
    );
    let code = exit
        .map_or(Some(0), |exit| exit.code)
        .and_then(|code| u8::try_from(code).ok());
    Ok(code.map_or(ExitCode::FAILURE, ExitCode::from))
}

/// `CLOUDROID_INIT`, or where `cargo build -p init --profile init` puts it.
fn find_init(own: &Path) -> Result<PathBuf, Failure> {
    if let Some(path) = std::env::var_os("CLOUDROID_INIT") {
        return Ok(path.into());
    }
    let target = own
        .ancestors()
        .nth(3)
        .ok_or("this program is not in a cargo target directory")?;
    let found = target.join("x86_64-unknown-linux-gnu/init/cloudroid-init");
    if found.exists() {
        Ok(found)
    } else {
        Err(format!(
            "{} is not there: build it or set CLOUDROID_INIT",
            found.display()
        )
        .into())
    }
}
