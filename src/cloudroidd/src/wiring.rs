//! Makes the daemon's parts and gives each what it needs of the others; ends them in the opposite order.

use std::net::{IpAddr, SocketAddr};
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use async_trait::async_trait;
use catalogue::Catalogue;
use choreographer::{Admission, Amount, Choreographer};
use portal::{App, Audit, Machine, Passwords, Principals, Tokens};
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
use crate::{bases, certificates, doctor, machine};

/// Why something is not to be had.
type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// The daemon with all its parts; nothing runs yet but the watch over the database.
pub fn build(
    config: &Config,
    home: &Home,
    machine: Machine,
    listen: SocketAddr,
) -> anyhow::Result<Arc<App>> {
    let state = Arc::new(State::open(&home.database())?);
    tokio::spawn(store::watch(Arc::clone(&state)));
    let principals = Principals::new(Tokens::new(&config.tokens)?, Arc::clone(&state))?
        .lasting(config.people.lasting());
    let provider = config.oidc.as_ref().map(|oidc| oidc.provider());
    let provider = provider.transpose()?;
    let known = provider.as_ref();
    let known = known.map(|known| (known.provider.issuer(), &known.roles));
    let principals = principals.provided(known)?;
    let images = Arc::new(image::Store::open(&home.images(), &home.layers())?);
    let catalogue = Arc::new(Catalogue::new(Arc::clone(&state), images));
    let resources = Resources {
        catalogue: Arc::clone(&catalogue),
        egress: config.allow.egress.clone(),
    };
    let local = LocalEngine::new(engine_config(config, home)?)?.with(Arc::new(resources));
    let engine: Arc<dyn Engine> = Arc::new(local.clone());
    let opener = Arc::new(LocalOpener::new(local.clone(), config.allow.egress.clone()));
    let promised = &config.capacity;
    let memory = promised
        .memory
        .map_or_else(machine::most_memory, |size| size.0);
    let capacity = Amount::new(promised.cores() * promised.overcommit, memory);
    let choreographer = Choreographer::new(
        config.choreographer(),
        Arc::clone(&state),
        Arc::clone(&catalogue),
        Arc::clone(&engine),
        Arc::clone(&opener) as Arc<dyn Opener>,
        Admission::new(capacity, promised.queue),
    );
    let definitions = bases::directory(config, home)?;
    let builder = builder(
        config,
        home,
        definitions,
        catalogue.images(),
        Arc::new(local),
    )?;
    let parts = push::Parts {
        builder: Arc::new(builder),
        catalogue: Arc::clone(&catalogue),
        engine,
        opener,
        choreographer: choreographer.clone(),
        journal: Journal::new(Arc::clone(&state)),
    };
    let pusher = Pusher::new(config.push(), home.path().to_owned(), parts);
    let examined = home.path().to_owned();
    let doubts = config.doubts(machine::has());
    let robots = certificates::robots(&config.tls, home, listen)?;
    Ok(Arc::new(App {
        principals,
        passwords: Passwords::default(),
        provider,
        audit: Audit::new(Arc::clone(&state)),
        strangers: Arc::new(portal::Strangers::new(machine::descriptors())),
        listen,
        tls: certificates::tls(&config.tls, home, listen, robots.as_ref())?,
        robots,
        signing: Arc::new(sign::SigningKey::of_file(&home.signing_key())?),
        home: home.path().to_owned(),
        state,
        catalogue,
        choreographer,
        pusher: Arc::new(pusher),
        machine,
        live: portal::Live::default(),
        inside: portal::Lookers::default(),
        observers: portal::Observers::default(),
        started: store::now(),
        sessions: TaskTracker::new(),
        ending: CancellationToken::new(),
        options: config.portal(),
        examine: Box::new(move || doctor::examine(&examined, Some(listen), &doubts)),
    }))
}

/// What the engine of this host asks the rest of the daemon.
struct Resources {
    catalogue: Arc<Catalogue>,
    /// `egress` of what the operator allows.
    egress: Vec<String>,
}

#[async_trait]
impl servant::local::Resources for Resources {
    async fn layers(&self, image: &str) -> Result<Vec<PathBuf>, BoxError> {
        Ok(self.catalogue.layers(image).await?)
    }

    fn hosts(&self, egress: &[String]) -> Result<Vec<(IpAddr, String)>, BoxError> {
        Ok(reach::egress::hosts(egress, &self.egress)?)
    }
}

/// What makes images of pushes.
fn builder(
    config: &Config,
    home: &Home,
    bases_dir: PathBuf,
    images: &Arc<image::Store>,
    sandbox: Arc<dyn Sandbox>,
) -> anyhow::Result<Builder> {
    let cache = home.cache();
    // What was compiled lies there, too.
    store::private::make_directory(&cache)
        .and_then(|()| store::private::close(&cache))
        .with_context(|| format!("cannot prepare the cache {}", cache.display()))?;
    Builder::new(rootfs_builder::Config {
        cache_dir: cache,
        cache_bytes: config.push.cache.0,
        bases_dir,
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
    let program = std::env::current_exe().context("cannot find this very program")?;
    let init = doctor::find_init().context("cloudroid-init is not beside cloudroidd")?;
    let servants = home.path().join("servants");
    let mut engine = LocalEngineConfig::new(servants, vec![program.into(), "shim".into()], init);
    engine.default_limits = choreographer::engine_limits(&config.limits);
    engine.shim_limits = servant::spec::Limits {
        cpus: Some(config.memory.shim_cpus),
        memory: Some(config.memory.shim.0),
        ..servant::spec::Limits::default()
    };
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

/// Lets pushes, sessions and, unless they are to be kept, servants end.
pub async fn drain(app: &App, keep_servants: bool) {
    app.choreographer.close();
    app.pusher.cancel_all(app.options.drain).await;
    app.choreographer.end_warm_pool().await;
    if keep_servants {
        tracing::info!(
            "ending; {} servants go on",
            app.choreographer.servants().len()
        );
        for handle in app.choreographer.servants() {
            if let Some(reach) = handle.reach() {
                reach.close_sessions("the daemon is being restarted; connect again");
            }
        }
    } else {
        let ended = app
            .choreographer
            .stop("the daemon is ending", |_| true)
            .await;
        tracing::info!("ending; {} servants ended", ended.len());
    }
    app.sessions.close();
    let _ = tokio::time::timeout(app.options.drain, app.sessions.wait()).await;
}
