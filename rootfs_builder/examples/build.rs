//! Builds the image of a package without a daemon, and looks at its interface: for trying the builder.
//!
//!     cargo run -p rootfs_builder --example build -- [--home DIR] [--cache DIR] [--base NAME] [--launch FILE]
//!         [--node EXE]... [--param K=V]... [--arg K:=V]... [--remap A:=B]... [--map K=DEB]... [--with NAME]...
//!         [--no-probe] [--cancel-after SECONDS] (PATH | --apt NAME)
//!
//! The program is its own shim (`build shim DIRECTORY`). The init is found by CLOUDROID_INIT, or beside the build's
//! other profiles. A PATH is copied before it is built.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::{Command, ExitCode};
use std::sync::Arc;
use std::time::{Duration, Instant};

use rootfs_builder::probe::{ProbeOptions, Work, Worked, probe};
use rootfs_builder::{BuildEvent, BuildOutcome, Builder, Config, PushRequest, Source, Sources};
use ros::bus::ParamValue;
use ros::net::{LoopbackSockets, Sockets};
use ros::ros1::Ros1Bus;
use ros::ros1::master::{Master, MasterOptions};
use ros::schema::Registry;
use servant::container::{ContainerSpec, Profile};
use servant::engine::{LogStart, Servant};
use servant::local::{LocalEngine, LocalEngineConfig, LocalServant};
use servant::shim::{Resident, ResidentContext, ResidentError};
use servant::spec::Limits;

type Failure = Box<dyn std::error::Error>;

const MASTER: &str = "127.0.0.1:11311";
const OWN_NAME: &str = "/cloudroid_bridge";

fn main() -> ExitCode {
    let arguments: Vec<OsString> = std::env::args_os().collect();
    // Before anything else: a shim must have one thread.
    if let [_, word, directory] = arguments.as_slice()
        && word == "shim"
    {
        return servant::shim::run(Path::new(directory), Box::new(WithMaster(None)));
    }
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::FAILURE
        }
    }
}

struct WithMaster(Option<Master>);

impl Resident for WithMaster {
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>> {
        Box::pin(async move {
            let parameters: Option<BTreeMap<String, ParamValue>> =
                serde_json::from_value(context.config.clone())?;
            let Some(parameters) = parameters else {
                return Ok(());
            };
            let listener = tokio::net::TcpListener::bind(MASTER).await?;
            let master = Master::new(MasterOptions {
                parameters,
                ..MasterOptions::default()
            });
            self.0 = Some(master.clone());
            tokio::task::spawn_local(async move {
                master.serve(listener, Arc::new(LoopbackSockets)).await
            });
            Ok(())
        })
    }

    fn process_exited(&mut self, _pid: i32) {
        if let Some(master) = self.0.clone() {
            tokio::task::spawn_local(async move { master.process_exited().await });
        }
    }
}

struct Inside(Arc<servant::netns::NetNs>);

#[async_trait::async_trait]
impl Sockets for Inside {
    async fn connect(
        &self,
        address: std::net::SocketAddr,
    ) -> std::io::Result<tokio::net::TcpStream> {
        self.0.connect(address).await
    }

    async fn listen(
        &self,
        address: std::net::SocketAddr,
    ) -> std::io::Result<tokio::net::TcpListener> {
        self.0.listen(address).await
    }
}

struct Wish {
    home: PathBuf,
    cache: PathBuf,
    probe: bool,
    cancel_after: Option<f64>,
    path: Option<PathBuf>,
    request: PushRequest,
}

fn parse() -> Result<Wish, Failure> {
    let scratch = std::env::temp_dir().join("cloudroid-build");
    let mut wish = Wish {
        home: scratch.join("home"),
        cache: scratch.join("cache"),
        probe: true,
        cancel_after: None,
        path: None,
        request: PushRequest {
            id: format!("try-{}", std::process::id()),
            ..PushRequest::default()
        },
    };
    let mut words = std::env::args().skip(1);
    while let Some(word) = words.next() {
        if !word.starts_with("--") {
            wish.path = Some(std::fs::canonicalize(word)?);
            continue;
        }
        if word == "--no-probe" {
            wish.probe = false;
            continue;
        }
        let value = words
            .next()
            .ok_or_else(|| format!("{word} needs a value"))?;
        let pair = |separator: &str| -> Result<(String, String), Failure> {
            let (key, value) = value
                .split_once(separator)
                .ok_or_else(|| format!("{value}: no {separator}"))?;
            Ok((key.to_owned(), value.to_owned()))
        };
        let request = &mut wish.request;
        match word.as_str() {
            "--home" => wish.home = std::path::absolute(&value)?,
            "--cache" => wish.cache = std::path::absolute(&value)?,
            "--cancel-after" => wish.cancel_after = Some(value.parse()?),
            "--apt" => request.source = Source::Packaged(value),
            "--base" => request.base = Some(value),
            "--launch" => request.launch = Some(value),
            "--node" => request.nodes.push(value),
            "--with" => request.with.push(value),
            "--map" => request.map.extend([pair("=")?]),
            "--arg" => request.args.extend([pair(":=")?]),
            "--remap" => request.remaps.extend([pair(":=")?]),
            "--param" => {
                let (key, value) = pair("=")?;
                let value =
                    serde_json::from_str(&value).unwrap_or(serde_json::Value::String(value));
                request.params.insert(key, value);
            }
            _ => {
                return Err(
                    format!("unknown option {word}: see the head of examples/build.rs").into(),
                );
            }
        }
    }
    Ok(wish)
}

#[tokio::main]
async fn run() -> Result<(), Failure> {
    let mut wish = parse()?;
    let own = std::env::current_exe()?;
    let init = match std::env::var_os("CLOUDROID_INIT") {
        Some(path) => path.into(),
        None => own
            .ancestors()
            .nth(3)
            .ok_or("no target directory")?
            .join("x86_64-unknown-linux-gnu/init/cloudroid-init"),
    };
    for name in ["images", "layers", "servants", "build"] {
        std::fs::create_dir_all(wish.home.join(name))?;
    }
    let command = vec![own.into_os_string(), "shim".into()];
    let engine = LocalEngine::new(LocalEngineConfig::new(
        wish.home.join("servants"),
        command,
        init,
    ))?;
    let store = Arc::new(image::Store::open(
        &wish.home.join("images"),
        &wish.home.join("layers"),
    )?);
    let builder = Builder::new(Config {
        cache_dir: wish.cache.clone(),
        bases_dir: Path::new(env!("CARGO_MANIFEST_DIR")).join("../images"),
        build_dir: wish.home.join("build"),
        logs_dir: wish.home.join("logs"),
        sources: Sources::Automatic,
        store: store.clone(),
        sandbox: Arc::new(engine.clone()),
        limits: servant::spec::Limits::default(),
    })?;
    if let Some(path) = &wish.path {
        // In the build's own directory, as the daemon unpacks it: it goes with all the rest.
        let site = wish.home.join("build").join(&wish.request.id);
        std::fs::create_dir_all(&site)?;
        let copy = site.join("pushed");
        let status = Command::new("cp")
            .arg("-rP")
            .arg(path)
            .arg(&copy)
            .status()?;
        if !status.success() {
            return Err("copying failed".into());
        }
        wish.request.source = Source::Tree(copy);
    }
    let begun = Instant::now();
    let (sender, mut events) = tokio::sync::mpsc::channel(64);
    let printer = tokio::spawn(async move {
        while let Some(event) = events.recv().await {
            let at = begun.elapsed().as_secs_f64();
            match event {
                BuildEvent::Step { title } => println!("{at:7.2} == {title}"),
                BuildEvent::Log { line } => println!("{at:7.2}    {line}"),
                BuildEvent::Warning { message } => println!("{at:7.2} !! {message}"),
                BuildEvent::Progress { .. } => {}
            }
        }
    });
    let build = builder.build(&wish.request, sender);
    let result = match wish.cancel_after {
        None => build.await,
        Some(seconds) => {
            match tokio::time::timeout(Duration::from_secs_f64(seconds), build).await {
                Ok(result) => result,
                Err(_) => return cancelled(&wish).await,
            }
        }
    };
    printer.await?;
    let outcome = result?;
    println!(
        "{:7.2} == built {} {}: {}",
        begun.elapsed().as_secs_f64(),
        outcome.package,
        outcome.version,
        outcome.image
    );
    for layer in &outcome.layers {
        println!(
            "  {:<13} {} {:>9} bytes, cached: {}",
            layer.name, layer.info.digest, layer.info.size, layer.cached
        );
    }
    for node in &outcome.plan.nodes {
        println!("  node {} {:?}", node.name, node.argv);
    }
    println!(
        "  {} parameters, {} definitions",
        outcome.plan.parameters.len(),
        outcome.inventory.definitions.len()
    );
    if wish.probe {
        let begun = Instant::now();
        look(&wish, &outcome, &store, &engine).await?;
        println!("probed in {:.2} s", begun.elapsed().as_secs_f64());
    }
    Ok(())
}

/// What a cancelled build leaves is removed in the background.
async fn cancelled(wish: &Wish) -> Result<(), Failure> {
    let begun = Instant::now();
    let left =
        |name: &str| std::fs::read_dir(wish.home.join(name)).map_or(0, |entries| entries.count());
    while left("build") + left("servants") > 0 && begun.elapsed() < Duration::from_secs(30) {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    println!(
        "cancelled; after {:.2} s {} builds and {} servants are left",
        begun.elapsed().as_secs_f64(),
        left("build"),
        left("servants")
    );
    Ok(())
}

async fn look(
    wish: &Wish,
    outcome: &BuildOutcome,
    store: &image::Store,
    engine: &LocalEngine,
) -> Result<(), Failure> {
    let mut environment = outcome.environment.clone();
    environment.extend(outcome.flavour.environment("/root"));
    let layers = outcome
        .layers
        .iter()
        .map(|layer| store.extracted(&layer.info.diff_id))
        .collect::<Result<_, _>>()?;
    let servant = engine
        .start_container(ContainerSpec {
            id: format!("{}-probe", wish.request.id),
            layers,
            writable: None,
            profile: Profile::Servant,
            limits: Limits::default(),
            environment,
            nodes: outcome
                .plan
                .nodes
                .iter()
                .map(|node| node.spec("/root"))
                .collect(),
            owned_directories: Vec::new(),
            mounts: Vec::new(),
            hosts: Vec::new(),
            resident: serde_json::to_value(&outcome.plan.parameters)?,
        })
        .await?;
    let mut log = servant.follow(LogStart::First);
    let printer = tokio::spawn(async move {
        while let Some(line) = log.recv().await {
            println!("        {}: {}", line.node, line.line);
        }
    });
    let found = watch(outcome, &servant).await;
    servant.stop().await?;
    printer.await?;
    let found = found?;
    for warning in found.warnings {
        println!("!! {warning}");
    }
    let interface = found.interface;
    for topic in &interface.topics {
        let marks = [(topic.lazy, "lazy"), (topic.latched, "latched")];
        let marks: Vec<&str> = marks
            .into_iter()
            .filter(|(set, _)| *set)
            .map(|(_, mark)| mark)
            .collect();
        println!(
            "  {:?} {} {} {} {}",
            topic.direction,
            topic.name,
            topic.type_name,
            topic.md5,
            marks.join(" ")
        );
    }
    for service in &interface.services {
        println!("  Service {} {}", service.name, service.type_name);
    }
    for action in &interface.actions {
        println!("  Action {} {}", action.name, action.type_name);
    }
    for parameter in &interface.parameters {
        println!(
            "  Parameter {} {:?}",
            parameter.name,
            parameter.value.as_ref().map(ToString::to_string)
        );
    }
    println!("  {} definitions", interface.definitions.len());
    Ok(())
}

async fn watch(
    outcome: &BuildOutcome,
    servant: &Arc<LocalServant>,
) -> Result<rootfs_builder::probe::Found, Failure> {
    let bus = Ros1Bus::connect(
        Arc::new(Inside(Arc::clone(servant.network()))),
        MASTER.parse()?,
        OWN_NAME,
    )
    .await?;
    let registry = Registry::from_definitions(&outcome.inventory.definitions)?;
    let names = outcome
        .plan
        .nodes
        .iter()
        .map(|node| node.name.clone())
        .collect();
    let exited = async {
        let ends = outcome.plan.nodes.iter().map(|node| {
            Box::pin(async { (node.name.clone(), servant.wait_node(&node.name).await) })
        });
        let ((name, exit), ..) = futures_util::future::select_all(ends).await;
        format!("node {name} ended: {exit:?}")
    };
    let asked = servant.clone();
    let work = Work::new(move || {
        let servant = asked.clone();
        async move {
            let usage = servant.usage().await.ok()?;
            Some(Worked {
                ran: Duration::from_micros(usage.cpu_usec),
                ..Worked::default()
            })
        }
    });
    let options = ProbeOptions {
        work: Some(work),
        ..ProbeOptions::new(names, OWN_NAME)
    };
    Ok(probe(
        &*bus,
        &registry,
        &outcome.inventory.definitions,
        &options,
        exited,
    )
    .await?)
}
