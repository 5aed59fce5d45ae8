//! Creates the daemon's components and connects them; shuts them down in reverse order.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use async_trait::async_trait;
use catalogue::Catalogue;
use choreographer::{Admission, Amount, Choreographer, RequestTracer};
use portal::{App, Audit, MachineChecks, Passwords, Principals, Tokens};
use push::Pusher;
use reach::{LocalOpener, Opener};
use rootfs_builder::Builder;
use servant::engine::Engine;
use servant::local::{Isolation, LocalEngine, LocalEngineConfig};
use servant::sandbox::Sandbox;
use store::{Journal, State};
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use crate::config::{Config, IsolationMode};
use crate::home::Home;
#[cfg(feature = "otel")]
use crate::telemetry;
use crate::{bases, certificates, doctor, machine};

/// Error of another crate.
type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// Builds the daemon with all its components; only the watch over the database runs yet.
pub fn build(config: &Config, home: &Home, machine: MachineChecks, listen: SocketAddr) -> anyhow::Result<Arc<App>> {
    let state = Arc::new(State::open(&home.database())?);
    tokio::spawn(store::flush_pending_writes(Arc::clone(&state)));
    let principals = Principals::new(Tokens::new(&config.tokens)?, Arc::clone(&state))?
        .with_session_lifetimes(config.people.session_lifetimes());
    let provider = config.oidc.as_ref().map(|oidc| oidc.identity_provider());
    let provider = provider.transpose()?;
    let known = provider.as_ref();
    let known = known.map(|known| (known.provider.issuer(), &known.roles));
    let principals = principals.with_provider(known)?;
    let images = Arc::new(image::Store::open(&home.images(), &home.layers())?);
    let rules = config.ros.read_rules().context("[ros] of the configuration")?;
    let catalogue = Arc::new(Catalogue::new(Arc::clone(&state), images).with_translation_rules(rules));
    let resources = EngineResources { catalogue: Arc::clone(&catalogue), egress: config.allow.egress.clone() };
    let local = LocalEngine::new(engine_config(config, home)?)?.with_resources(Arc::new(resources));
    let engine: Arc<dyn Engine> = Arc::new(local.clone());
    let opener = Arc::new(LocalOpener::new(local.clone(), config.allow.egress.clone()));
    let promised = &config.capacity;
    let memory = promised.memory.map_or_else(machine::usable_memory, |size| size.0);
    let capacity = Amount::new(promised.cores() * promised.overcommit, memory);
    let choreographer = Choreographer::new(
        choreographer::Options { tracer: start_tracer(config)?, ..config.choreographer_options() },
        Arc::clone(&state),
        Arc::clone(&catalogue),
        Arc::clone(&engine),
        Arc::clone(&opener) as Arc<dyn Opener>,
        Admission::new(capacity, promised.queue),
    );
    let definitions = bases::write_definitions(config, home)?;
    let builder = image_builder(config, home, definitions, catalogue.images(), Arc::new(local))?;
    let parts = push::PusherParts {
        builder: Arc::new(builder),
        catalogue: Arc::clone(&catalogue),
        engine,
        opener,
        choreographer: choreographer.clone(),
        journal: Journal::new(Arc::clone(&state)),
        state: Arc::clone(&state),
    };
    let pusher = Pusher::new(config.push_options(), home.path().to_owned(), parts);
    let examined = home.path().to_owned();
    let doubts = config.machine_warnings(machine::resources());
    let collector = config.telemetry.clone();
    let robots = certificates::open_robot_authority(&config.tls, home, listen)?;
    Ok(Arc::new(App {
        principals,
        passwords: Passwords::default(),
        provider,
        audit: Audit::new(Arc::clone(&state)),
        strangers: Arc::new(portal::Strangers::new(machine::descriptor_limit())),
        listen,
        tls: certificates::build_tls(&config.tls, home, listen, robots.as_ref())?,
        robots,
        signing: Arc::new(sign::SigningKey::load_or_create(&home.signing_key())?),
        home: home.path().to_owned(),
        state,
        catalogue,
        choreographer,
        pusher: Arc::new(pusher),
        machine,
        live: portal::LiveSamples::default(),
        inside: portal::InsideConnections::default(),
        execs: portal::Slots::default(),
        observers: portal::Observers::default(),
        started: store::now(),
        sessions: TaskTracker::new(),
        ending: CancellationToken::new(),
        options: config.portal_options(),
        examine: Box::new(move || doctor::examine(&examined, Some(listen), &doubts, collector.as_ref())),
    }))
}

/// Starts to export traces of requests, if the configuration has a collector.
#[cfg(feature = "otel")]
fn start_tracer(config: &Config) -> anyhow::Result<Option<Arc<dyn RequestTracer>>> {
    config.telemetry.as_ref().map(telemetry::start).transpose()
}

/// Returns no tracer: a configuration with a collector is refused before.
#[cfg(not(feature = "otel"))]
fn start_tracer(_config: &Config) -> anyhow::Result<Option<Arc<dyn RequestTracer>>> {
    Ok(None)
}

/// Resources that the engine of this host requests from the rest of the daemon.
struct EngineResources {
    catalogue: Arc<Catalogue>,
    /// Destinations that the operator allows (`egress` of `[allow]`).
    egress: Vec<String>,
}

#[async_trait]
impl servant::local::Resources for EngineResources {
    async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, BoxError> {
        Ok(self.catalogue.layers(image).await?)
    }

    fn hosts(&self, egress: &[String]) -> Result<Vec<(IpAddr, String)>, BoxError> {
        Ok(reach::egress::hosts(egress, &self.egress)?)
    }
}

/// Creates the builder of images for pushes.
fn image_builder(
    config: &Config,
    home: &Home,
    bases_dir: PathBuf,
    images: &Arc<image::Store>,
    sandbox: Arc<dyn Sandbox>,
) -> anyhow::Result<Builder> {
    let cache = home.cache();
    // The cache contains compiled code, too: nobody else may change it.
    store::private::make_directory(&cache)
        .and_then(|()| store::private::restrict_to_owner(&cache))
        .with_context(|| format!("cannot prepare the cache {}", cache.display()))?;
    Builder::new(rootfs_builder::Config {
        cache_dir: cache,
        cache_bytes: config.push.cache.0,
        bases_dir,
        imported_dir: home.path().join(bases::IMPORTED_DIRECTORY),
        build_dir: home.path().join("build"),
        logs_dir: home.path().join("logs"),
        sources: config.archives.sources(),
        store: Arc::clone(images),
        sandbox,
        limits: config.push.limits(),
    })
    .context("cannot prepare for building images")
}

fn engine_config(config: &Config, home: &Home) -> anyhow::Result<LocalEngineConfig> {
    let program = std::env::current_exe().context("cannot find the path of this program")?;
    let init = doctor::find_init().context("cloudroid-init is not beside cloudroidd")?;
    let servants = home.path().join("servants");
    let mut engine = LocalEngineConfig::new(servants, vec![program.into(), "shim".into()], init);
    engine.kept_logs_dir = home.path().join("ended");
    engine.default_limits = config.limits;
    engine.shim_limits =
        api::Limits { cpus: Some(config.memory.shim_cpus), memory: Some(config.memory.shim), ..api::Limits::default() };
    engine.quotas = servant::quotas::Quotas {
        scratch: config.servant.scratch.map(|size| size.0),
        inodes: config.servant.inodes,
        log_rate: config.servant.log_rate.0,
    };
    engine.allow = config.allow.clone();
    engine.isolation = match config.isolation {
        IsolationMode::Require => Isolation::Require,
        IsolationMode::BestEffort => Isolation::BestEffort,
    };
    Ok(engine)
}

/// Ends pushes, sessions and, unless they are to be kept, servants.
pub async fn drain(app: &App, keep_servants: bool) {
    app.choreographer.close();
    app.pusher.cancel_all(app.options.drain).await;
    app.choreographer.end_warm_pool().await;
    if keep_servants {
        tracing::info!("stopping; {} servants keep running", app.choreographer.servants().len());
        for handle in app.choreographer.servants() {
            if let Some(reach) = handle.reach() {
                reach.close_sessions("the daemon is being restarted; connect again");
            }
        }
    } else {
        let ended = app.choreographer.stop("the daemon is shutting down", |_| true).await;
        tracing::info!("stopping; {} servants ended", ended.len());
    }
    app.sessions.close();
    let _ = tokio::time::timeout(app.options.drain, app.sessions.wait()).await;
}
