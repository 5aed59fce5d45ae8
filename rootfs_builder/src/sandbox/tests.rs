//! What a site does with an engine, told by an engine that only writes down what is asked of it. Real containers are
//! run by the stories.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::SystemTime;

use async_trait::async_trait;
use servant::endpoint::Endpoint;
use servant::engine::{Adopted, ContainerState, Enforced, LogLine, NodeEvent, Servant, Usage};
use tokio::sync::{Notify, broadcast, watch};

use super::*;

/// Its one container prints a line and then runs until it is stopped, or ends by itself with `code`.
#[derive(Default)]
struct Pretended {
    code: Option<i32>,
    started: Notify,
    stopped: Arc<AtomicBool>,
    /// Whether the build's directory was still there when the container was stopped.
    saw: Arc<Mutex<Option<(PathBuf, bool)>>>,
}

struct Container {
    code: Option<i32>,
    stopped: Arc<AtomicBool>,
    saw: Arc<Mutex<Option<(PathBuf, bool)>>>,
    over: Notify,
}

#[async_trait]
impl Engine for Pretended {
    async fn start(&self, _spec: Spec) -> Result<Arc<dyn Servant>, servant::Error> {
        self.started.notify_one();
        Ok(Arc::new(Container {
            code: self.code,
            stopped: self.stopped.clone(),
            saw: self.saw.clone(),
            over: Notify::new(),
        }))
    }

    async fn adopt(&self) -> Result<Adopted, servant::Error> {
        Ok(Adopted::default())
    }
}

#[async_trait]
impl Servant for Container {
    fn id(&self) -> &str {
        "pretended"
    }

    fn state(&self) -> watch::Receiver<ContainerState> {
        watch::channel(ContainerState::Creating).1
    }

    fn events(&self) -> broadcast::Receiver<NodeEvent> {
        broadcast::channel(1).1
    }

    fn endpoint(&self) -> Endpoint {
        nobody_asks()
    }

    fn enforced(&self) -> Enforced {
        Enforced::default()
    }

    async fn processes(&self) -> Result<Vec<i32>, servant::Error> {
        Ok(Vec::new())
    }

    async fn usage(&self) -> Result<Usage, servant::Error> {
        Ok(Usage::default())
    }

    async fn set_limits(&self, _limits: Limits) -> Result<Enforced, servant::Error> {
        Ok(Enforced::default())
    }

    async fn start_node(&self, _node: NodeSpec) -> Result<(), servant::Error> {
        Ok(())
    }

    async fn signal_node(&self, _node: &str, _signal: i32) -> Result<(), servant::Error> {
        Ok(())
    }

    async fn wait_node(&self, _node: &str) -> Result<NodeExit, servant::Error> {
        let Some(code) = self.code else {
            std::future::pending().await
        };
        Ok(NodeExit {
            code: Some(code),
            signal: None,
            out_of_memory: false,
            exec_error: None,
        })
    }

    fn follow_log(&self, _from_start: bool) -> mpsc::Receiver<LogLine> {
        let (sender, receiver) = mpsc::channel(1);
        let line = LogLine {
            number: None,
            time: SystemTime::UNIX_EPOCH,
            node: "x".into(),
            stream: "stdout".into(),
            line: "hello".into(),
        };
        sender.try_send(line).expect("there is room");
        receiver
    }

    fn uid_range(&self) -> (u32, u32) {
        (700_000, 65_536)
    }

    fn log_path(&self) -> PathBuf {
        PathBuf::new()
    }

    async fn stop(&self) -> Result<(), servant::Error> {
        // Ending a container takes its time.
        for _ in 0..50 {
            tokio::task::yield_now().await;
        }
        let mut saw = self.saw.lock().expect("not poisoned");
        if let Some((directory, there)) = saw.as_mut() {
            *there = directory.exists();
        }
        self.stopped.store(true, Ordering::SeqCst);
        self.over.notify_waiters();
        Ok(())
    }
}

fn nobody_asks() -> ! {
    panic!("a build needs no endpoint")
}

fn run() -> Run {
    Run {
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

fn site(root: &Path, id: &str, engine: &Arc<Pretended>, removals: &Removals) -> Site {
    Site::new(root, id, engine.clone(), default_limits(), removals.clone()).expect("made")
}

#[tokio::test]
async fn a_build_as_deep_as_can_be_is_removed() {
    let root = tempfile::tempdir().expect("a directory");
    let (engine, removals) = (Arc::new(Pretended::default()), Removals::default());
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
    removals.done("b3").await;
    assert!(!root.path().join("b3").exists());
}

#[tokio::test]
async fn lines_are_heard_and_the_container_is_gone_at_the_end() {
    let root = tempfile::tempdir().expect("a directory");
    let engine = Arc::new(Pretended {
        code: Some(3),
        ..Pretended::default()
    });
    let removals = Removals::default();
    let site = site(root.path(), "b1", &engine, &removals);
    let mut heard = Vec::new();
    let finished = site
        .run(run(), |line| heard.push(line.to_owned()))
        .await
        .expect("it ran");
    assert_eq!(heard, ["hello"]);
    assert_eq!(
        (finished.success(), finished.exit.code, finished.uid_offset),
        (false, Some(3), 700_000)
    );
    assert!(engine.stopped.load(Ordering::SeqCst));
    drop(site);
    removals.done("b1").await;
    assert!(!root.path().join("b1").exists());
}

#[tokio::test]
async fn a_dropped_build_ends_its_container_before_its_directory_goes() {
    let root = tempfile::tempdir().expect("a directory");
    let directory = root.path().join("b2");
    let engine = Arc::new(Pretended::default());
    *engine.saw.lock().expect("not poisoned") = Some((directory.clone(), false));
    let removals = Removals::default();
    let site = site(root.path(), "b2", &engine, &removals);
    tokio::select! {
        _ = site.run(run(), |_| {}) => panic!("it runs until it is stopped"),
        () = engine.started.notified() => {}
    }
    assert!(directory.exists());
    let running = site.running.clone();
    assert_eq!(running.lock().expect("not poisoned").len(), 1);
    drop(site);
    removals.done("b2").await;
    assert!(engine.stopped.load(Ordering::SeqCst));
    assert!(!directory.exists(), "the directory is removed");
    assert_eq!(
        engine
            .saw
            .lock()
            .expect("not poisoned")
            .as_ref()
            .map(|(_, there)| *there),
        Some(true)
    );
}
