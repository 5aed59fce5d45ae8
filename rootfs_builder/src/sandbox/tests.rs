//! Tests of a build site with an engine in memory. Real containers are covered by the story tests.

use std::sync::atomic::{AtomicBool, Ordering};

use async_trait::async_trait;
use in_memory::MemoryEngine;
use servant::engine::Engine;
use servant::spec::Spec;
use tokio::sync::Notify;

use super::*;

/// Fake sandbox whose program prints a line and then runs until it is stopped, or exits by itself with `code`.
#[derive(Default)]
struct FakeSandbox {
    code: Option<i32>,
    engine: MemoryEngine,
    started: Arc<Notify>,
    /// Directory of the build, and whether it still existed when the program had ended.
    saw: Arc<Mutex<Option<(PathBuf, bool)>>>,
    stopped: Arc<AtomicBool>,
}

/// Guard that is dropped when the program has ended.
struct Last {
    stopped: Arc<AtomicBool>,
    saw: Arc<Mutex<Option<(PathBuf, bool)>>>,
}

impl Drop for Last {
    fn drop(&mut self) {
        if let Some((directory, there)) = self.saw.lock().expect("not poisoned").as_mut() {
            *there = directory.exists();
        }
        self.stopped.store(true, Ordering::SeqCst);
    }
}

#[async_trait]
impl Sandbox for FakeSandbox {
    async fn start_sandbox(&self, spec: ContainerSpec) -> Result<SandboxContainer, servant::Error> {
        let (code, started) = (self.code, Arc::clone(&self.started));
        let (stopped, saw) = (Arc::clone(&self.stopped), Arc::clone(&self.saw));
        self.engine.program("/bin/true", move |process| {
            let (stopped, saw) = (Arc::clone(&stopped), Arc::clone(&saw));
            let last = Last { stopped, saw };
            process.print("hello");
            started.notify_one();
            async move {
                let _last = last;
                match code {
                    Some(code) => code,
                    None => std::future::pending().await,
                }
            }
        });
        let spec = Spec {
            id: spec.id,
            image: String::new(),
            limits: spec.limits,
            environment: spec.environment,
            nodes: spec.nodes,
            grants: Default::default(),
            resident: spec.resident,
        };
        Ok(SandboxContainer { servant: self.engine.start(spec).await?, uid_offset: 700_000 })
    }
}

fn run() -> SandboxRun {
    SandboxRun {
        name: "x",
        profile: Profile::Compile,
        layers: Vec::new(),
        writable: None,
        owned: Vec::new(),
        mounts: Vec::new(),
        environment: BTreeMap::new(),
        argv: vec!["/bin/true".into()],
    }
}

fn site(root: &Path, id: &str, engine: &Arc<FakeSandbox>, removals: &PendingRemovals) -> BuildSite {
    BuildSite::new(root, id, engine.clone(), default_limits(), removals.clone()).expect("made")
}

#[tokio::test]
async fn a_build_as_deep_as_can_be_is_removed() {
    let root = tempfile::tempdir().expect("a directory");
    let (engine, removals) = (Arc::new(FakeSandbox::default()), PendingRemovals::default());
    let site = site(root.path(), "b3", &engine, &removals);
    let directory = root.path().join("b3");
    tokio::task::spawn_blocking(move || {
        let flags = rustix::fs::OFlags::RDONLY | rustix::fs::OFlags::DIRECTORY;
        let none = rustix::fs::Mode::empty();
        let mut at = rustix::fs::open(&directory, flags, none).expect("opened");
        for _ in 0..15_000 {
            rustix::fs::mkdirat(&at, "d", rustix::fs::Mode::RWXU).expect("made");
            at = rustix::fs::openat(&at, "d", flags, none).expect("opened");
        }
    })
    .await
    .expect("nested");
    drop(site);
    removals.wait("b3").await;
    assert!(!root.path().join("b3").exists());
}

#[tokio::test]
async fn lines_are_heard_and_the_container_is_gone_at_the_end() {
    let root = tempfile::tempdir().expect("a directory");
    let engine = Arc::new(FakeSandbox { code: Some(3), ..FakeSandbox::default() });
    let removals = PendingRemovals::default();
    let site = site(root.path(), "b1", &engine, &removals);
    let mut heard = Vec::new();
    let finished = site.run(run(), |line| heard.push(line.to_owned())).await.expect("it ran");
    assert_eq!(heard, ["hello"]);
    assert_eq!((finished.success(), finished.exit.code, finished.uid_offset), (false, Some(3), 700_000));
    assert!(engine.stopped.load(Ordering::SeqCst));
    drop(site);
    removals.wait("b1").await;
    assert!(!root.path().join("b1").exists());
}

#[tokio::test]
async fn a_dropped_build_ends_its_container_before_its_directory_goes() {
    let root = tempfile::tempdir().expect("a directory");
    let directory = root.path().join("b2");
    let engine = Arc::new(FakeSandbox::default());
    *engine.saw.lock().expect("not poisoned") = Some((directory.clone(), false));
    let removals = PendingRemovals::default();
    let site = site(root.path(), "b2", &engine, &removals);
    tokio::select! {
        _ = site.run(run(), |_| {}) => panic!("it runs until it is stopped"),
        () = engine.started.notified() => {}
    }
    assert!(directory.exists());
    let running = site.running.clone();
    assert_eq!(running.lock().expect("not poisoned").len(), 1);
    drop(site);
    removals.wait("b2").await;
    assert!(engine.stopped.load(Ordering::SeqCst));
    assert!(!directory.exists(), "the directory is removed");
    assert_eq!(engine.saw.lock().expect("not poisoned").as_ref().map(|(_, there)| *there), Some(true));
}
