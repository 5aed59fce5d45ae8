//! Environment of each test: an engine with its own directory, a layer, and checks that nothing is left.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::future::Future;
use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::path::{Path, PathBuf};
use std::pin::Pin;
use std::process::Command;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use nix::sys::signal::Signal;
use servant::container::{ContainerSpec, Profile};
use servant::engine::{ContainerState, Engine, LogLine, ServantHandle};
use servant::launch::{self, RuntimeRecord};
use servant::local::{GracePeriods, Isolation, LocalEngine, LocalEngineConfig, LocalServant};
use servant::shim::{Resident, ResidentContext, ResidentError};
use servant::spec::{Limits, NodeSpec};

/// Runs before `main`: a shim must have one thread, and the test harness creates more.
#[used]
#[unsafe(link_section = ".init_array")]
static CHOOSE: extern "C" fn() = choose;

extern "C" fn choose() {
    let words: Vec<String> = std::env::args().collect();
    if words.first().is_some_and(|name| name.ends_with("test-node")) {
        let status = crate::node::run_action(&words[1..]);
        let _ = std::io::stdout().flush();
        std::process::exit(status);
    }
    if let [_, word, directory] = words.as_slice() {
        if word == "shim" {
            let status = servant::shim::run(Path::new(directory), Box::new(Greeter::default()));
            std::process::exit(i32::from(status != std::process::ExitCode::SUCCESS));
        }
    }
}

/// A resident that answers on the ROS Master's port with its configuration and the number of processes that have ended.
#[derive(Default)]
struct Greeter {
    ended: std::rc::Rc<std::cell::Cell<usize>>,
}

impl Resident for Greeter {
    fn start<'a>(
        &'a mut self,
        context: &'a ResidentContext,
    ) -> Pin<Box<dyn Future<Output = Result<(), ResidentError>> + 'a>> {
        Box::pin(async move {
            if let Some(reason) = context.config.get("fail") {
                return Err(reason.to_string().into());
            }
            let listener = tokio::net::TcpListener::bind("127.0.0.1:11311").await?;
            let (config, ended) = (context.config.clone(), self.ended.clone());
            let directory = context.directory.clone();
            tokio::task::spawn_local(async move {
                use tokio::io::AsyncWriteExt;
                while let Ok((mut stream, _)) = listener.accept().await {
                    if config.get("eat").is_some() {
                        std::hint::black_box(vec![7_u8; 256 << 20]);
                    }
                    if let Some(socket) = config.get("pries").and_then(|place| place.as_str()) {
                        let tried = attempt_escapes(Path::new(socket), &directory);
                        let _ = stream.write_all(tried.as_bytes()).await;
                        continue;
                    }
                    let text = format!("{config} {}", ended.get());
                    let _ = stream.write_all(text.as_bytes()).await;
                }
            });
            Ok(())
        })
    }

    fn process_exited(&mut self, _pid: i32) {
        self.ended.set(self.ended.get() + 1);
    }
}

/// Acts as a shim that was taken over: tries to escape, by a socket of root's among others, and to work in its own
/// directory. Returns a line for each attempt: `allowed`, or the error.
fn attempt_escapes(socket: &Path, directory: &Path) -> String {
    let outside = socket.with_file_name("outside");
    let tries: [(&str, std::io::Result<()>); 7] = [
        ("own file", std::fs::write(directory.join("own"), "x")),
        ("write outside", std::fs::write(&outside, "x")),
        ("read outside", std::fs::read("/etc/passwd").map(drop)),
        ("list outside", std::fs::read_dir("/etc").map(drop)),
        ("program", Command::new("/bin/true").status().map(drop)),
        ("socket of root", std::os::unix::net::UnixStream::connect(socket).map(drop)),
        ("pair of sockets", std::os::unix::net::UnixDatagram::pair().map(drop)),
    ];
    let told = tries.map(|(name, outcome)| match outcome {
        Ok(()) => format!("{name}: allowed\n"),
        Err(error) => format!("{name}: {error}\n"),
    });
    told.concat()
}

/// An engine and its resources.
pub struct World {
    pub engine: LocalEngine,
    home: tempfile::TempDir,
    config: LocalEngineConfig,
}

impl World {
    pub fn new() -> Self {
        Self::with_config(|_| {})
    }

    /// Creates an environment with a changed configuration.
    pub fn with_config(change: impl FnOnce(&mut LocalEngineConfig)) -> Self {
        assert!(nix::unistd::geteuid().is_root(), "these tests start containers: run them as root");
        let home = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).expect("a directory for the test");
        let shim: Vec<OsString> = vec![std::env::current_exe().expect("our own path").into(), "shim".into()];
        let mut config = LocalEngineConfig::new(home.path().join("servants"), shim, init());
        config.isolation = Isolation::BestEffort;
        config.grace = GracePeriods { interrupt: Duration::from_millis(300), terminate: Duration::from_millis(300) };
        change(&mut config);
        let engine = LocalEngine::new(config.clone()).expect("an engine");
        Self { engine, home, config }
    }

    /// Creates another engine on the same directory, like a restarted daemon.
    pub fn restart_engine(&self) -> LocalEngine {
        LocalEngine::new(self.config.clone()).expect("an engine")
    }

    /// Returns whether this host has a cgroup controller.
    pub fn has_controller(&self, controller: &str) -> bool {
        let controllers = self.engine.cgroups().controllers();
        controllers.iter().any(|known| known == controller)
    }

    /// Fails if this host lacks a controller, since a test of limits could not be meaningful then.
    pub fn require_controllers(&self, controllers: &[&str]) {
        for controller in controllers {
            assert!(
                self.has_controller(controller),
                "this host has no cgroup controller {controller}: run these tests where it has, or leave out `limits::`"
            );
        }
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.home.path().join(name)
    }

    pub fn servant_directory(&self, id: &str) -> PathBuf {
        self.config.home_servants_dir.join(id)
    }

    pub fn runtime(&self, id: &str) -> RuntimeRecord {
        launch::read_record(&self.servant_directory(id).join(launch::RUNTIME)).unwrap().expect("a shim writes it first")
    }

    /// Returns the single servant that an engine on the same directory adopts.
    pub async fn adopt_single(&self, engine: &LocalEngine) -> Arc<LocalServant> {
        let mut adopted = with_timeout(engine.adopt()).await.unwrap();
        let servant = adopted.running.pop().expect("one");
        assert!(adopted.running.is_empty() && adopted.failures.is_empty());
        wait_until_told(&*servant).await;
        engine.servant(servant.id()).expect("it is held")
    }

    pub async fn start(&self, spec: ContainerSpec) -> Arc<LocalServant> {
        self.engine.start_container(spec).await.unwrap_or_else(|error| panic!("{error}"))
    }

    /// Stops a servant and checks that nothing is left.
    pub async fn stop(&self, servant: Arc<LocalServant>) {
        let id = servant.id().to_owned();
        let runtime = self.runtime(&id);
        let processes = servant.processes().unwrap_or_default();
        servant.stop().await.unwrap_or_else(|error| panic!("{error}"));
        self.assert_gone(&id, &runtime, &processes);
    }

    pub fn assert_gone(&self, id: &str, runtime: &RuntimeRecord, processes: &[i32]) {
        assert!(!self.servant_directory(id).exists(), "the directory is left");
        assert!(!runtime.cgroup.exists(), "the cgroup is left");
        let of_shim = runtime.shim_cgroup.as_ref();
        assert!(!of_shim.is_some_and(servant::cgroup::Cgroup::exists), "the shim's cgroup is left");
        assert!(runtime.shim.open_pidfd().unwrap().is_none(), "the shim is left");
        for pid in processes {
            assert_ended(*pid, id);
        }
        let mounts = std::fs::read_to_string("/proc/self/mountinfo").unwrap();
        assert!(!mounts.contains(id), "a mount is left");
    }
}

impl Drop for World {
    /// Removes what servants left after a failed test. After a successful one there is nothing.
    fn drop(&mut self) {
        let Ok(entries) = std::fs::read_dir(&self.config.home_servants_dir) else {
            return;
        };
        for entry in entries.flatten() {
            let Ok(Some(runtime)) = launch::read_record::<RuntimeRecord>(&entry.path().join(launch::RUNTIME)) else {
                continue;
            };
            if let Ok(Some(pidfd)) = runtime.shim.open_pidfd() {
                kill(&pidfd);
            }
            for cgroup in runtime.shim_cgroup.iter().chain([&runtime.cgroup]) {
                let _ = cgroup.destroy(Duration::from_secs(5));
            }
        }
    }
}

/// Fails if a process of a servant does not end. A process that has ended keeps its entry in /proc, cgroup included,
/// until its parent has reaped it: so its end is awaited, not the disappearance of the entry.
fn assert_ended(pid: i32, id: &str) {
    let of_servant = || std::fs::read_to_string(format!("/proc/{pid}/cgroup")).is_ok_and(|cgroup| cgroup.contains(id));
    let Ok(process) = servant::process::ProcessIdentity::from_pid(pid) else {
        return;
    };
    // Checked after its identity was taken, since the pid may have been reused by now.
    if !of_servant() {
        return;
    }
    let Ok(Some(pidfd)) = process.open_pidfd() else {
        return;
    };
    let mut watched = [nix::poll::PollFd::new(pidfd.as_fd(), nix::poll::PollFlags::POLLIN)];
    let ended = nix::poll::poll(&mut watched, 10_000_u16).unwrap();
    assert!(ended == 1, "process {pid} is left");
}

/// Waits until the shim of an adopted servant has told its state.
pub async fn wait_until_told(servant: &dyn ServantHandle) {
    let mut state = servant.state();
    with_timeout(state.wait_for(|state| *state != ContainerState::Creating)).await.expect("it is known");
}

/// Sends a signal to a process.
pub fn send_signal(pidfd: &std::os::fd::OwnedFd, signal: Signal) {
    use std::os::fd::AsRawFd;
    // SAFETY: a null siginfo is allowed.
    unsafe {
        libc::syscall(libc::SYS_pidfd_send_signal, pidfd.as_raw_fd(), signal as i32, 0_usize, 0);
    }
}

/// Kills a process and waits for its end.
pub fn kill(pidfd: &std::os::fd::OwnedFd) {
    send_signal(pidfd, Signal::SIGKILL);
    let mut watched = [nix::poll::PollFd::new(pidfd.as_fd(), nix::poll::PollFlags::POLLIN)];
    let _ = nix::poll::poll(&mut watched, 5000_u16);
}

/// Creates a spec of the test layer; the id is unique on the host.
pub fn spec(nodes: Vec<NodeSpec>) -> ContainerSpec {
    static NUMBER: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
    let number = NUMBER.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
    ContainerSpec {
        // All of one width, so that no id is a prefix of another.
        id: format!("test-{}-{number:04}", std::process::id()),
        layers: vec![layer()],
        writable: None,
        profile: Profile::Servant,
        limits: Limits::default(),
        environment: [("SHARED".to_owned(), "yes".to_owned())].into(),
        nodes,
        owned_directories: vec![],
        mounts: vec![],
        hosts: Vec::new(),
        resident: serde_json::Value::Null,
    }
}

/// Creates a node that runs an action of [`crate::node::run_action`].
pub fn node(name: &str, words: &[&str]) -> NodeSpec {
    let argv = std::iter::once("/test-node").chain(words.iter().copied()).map(str::to_owned).collect();
    NodeSpec {
        name: name.to_owned(),
        argv,
        environment: BTreeMap::new(),
        directory: String::new(),
        respawn: false,
        respawn_delay: 0.0,
        required: false,
    }
}

/// Returns the lines of a log up to the first one that matches.
pub async fn lines_until(
    lines: &mut tokio::sync::mpsc::Receiver<LogLine>,
    fits: impl Fn(&LogLine) -> bool,
) -> Vec<LogLine> {
    let mut seen = Vec::new();
    loop {
        let line = with_timeout(lines.recv()).await.unwrap_or_else(|| panic!("the log ended after {seen:?}"));
        seen.push(line);
        if seen.last().is_some_and(&fits) {
            return seen;
        }
    }
}

/// Returns the processes in a servant's PID namespace, once there are at least `count`. The creator of the container
/// may still be in its cgroup.
pub async fn processes(servant: &LocalServant, count: usize) -> Vec<i32> {
    let inside = |pid: &i32| {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        let numbers = status.lines().find_map(|line| line.strip_prefix("NSpid:"));
        numbers.is_some_and(|numbers| numbers.split_whitespace().count() > 1)
    };
    with_timeout(async {
        loop {
            let mut processes = servant.processes().unwrap();
            processes.retain(inside);
            if processes.len() >= count {
                return processes;
            }
            tokio::task::yield_now().await;
        }
    })
    .await
}

/// Waits until a servant has ended and returns its final state.
pub async fn wait_until_ended(servant: &dyn ServantHandle) -> ContainerState {
    let mut state = servant.state();
    with_timeout(state.wait_for(ContainerState::is_over)).await.expect("a state").clone()
}

/// Fails a test that waits too long, instead of letting it hang.
pub async fn with_timeout<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(Duration::from_secs(60), future).await.expect("it took more than a minute")
}

/// Reads from a port until the connection closes.
pub async fn read_from_port(servant: &LocalServant, port: u16) -> std::io::Result<String> {
    use tokio::io::AsyncReadExt;
    let mut stream = servant.network().connect(([127, 0, 0, 1], port).into()).await?;
    let mut text = String::new();
    stream.read_to_string(&mut text).await?;
    Ok(text)
}

/// Returns a layer that contains this program as `/test-node`, and the libraries it is linked with.
fn layer() -> PathBuf {
    static LAYER: OnceLock<PathBuf> = OnceLock::new();
    let make = || {
        let layer = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("layer-{}", std::process::id()));
        std::fs::create_dir_all(layer.join("lib64")).unwrap();
        std::fs::create_dir_all(layer.join("usr")).unwrap();
        let own = std::env::current_exe().unwrap();
        // A hard link if possible, since the program is large.
        if std::fs::hard_link(&own, layer.join("test-node")).is_err() {
            copy(&own, &layer.join("test-node"));
        }
        let maps = std::fs::read_to_string("/proc/self/maps").unwrap();
        let libraries: std::collections::BTreeSet<_> = maps
            .lines()
            .filter_map(|line| line.split_whitespace().nth(5))
            .filter(|path| path.contains(".so"))
            .collect();
        for library in libraries {
            let inside = layer.join(library.trim_start_matches('/'));
            copy(Path::new(library), &inside);
            // The file is libx.so.1.2.3, but programs ask for libx.so.1.
            if let Some((stem, version)) = library.split_once(".so.") {
                let major = version.split('.').next().unwrap_or(version);
                copy(Path::new(library), &layer.join(format!("{}.so.{major}", stem.trim_start_matches('/'))));
            }
            if library.contains("/ld-linux") {
                let name = Path::new(library).file_name().unwrap();
                copy(Path::new(library), &layer.join("lib64").join(name));
                copy(Path::new(library), &layer.join("lib").join(name));
            }
        }
        // SAFETY: the function returns and does not unwind.
        unsafe { libc::atexit(remove_layer) };
        layer
    };
    LAYER.get_or_init(make).clone()
}

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to.parent().unwrap()).unwrap();
    std::fs::copy(from, to).unwrap();
}

extern "C" fn remove_layer() {
    let layer = Path::new(env!("CARGO_TARGET_TMPDIR")).join(format!("layer-{}", std::process::id()));
    let _ = std::fs::remove_dir_all(layer);
}

/// Returns the static init, built once for a test run.
fn init() -> PathBuf {
    static INIT: OnceLock<PathBuf> = OnceLock::new();
    let build = || {
        if let Some(path) = std::env::var_os("CLOUDROID_INIT") {
            return path.into();
        }
        let target = Path::new(env!("CARGO_TARGET_TMPDIR")).parent().expect("tmp is in the target directory");
        let triple = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
        let status = Command::new(env!("CARGO"))
            .args(["build", "--quiet", "--package", "init", "--profile", "init", "--target", &triple])
            .arg("--target-dir")
            .arg(target)
            .current_dir(env!("CARGO_MANIFEST_DIR"))
            .env("RUSTFLAGS", "-C target-feature=+crt-static")
            .status()
            .expect("cargo");
        assert!(status.success(), "init could not be built");
        target.join(triple).join("init/cloudroid-init")
    };
    INIT.get_or_init(build).clone()
}

/// Returns a field of /proc/PID/status.
pub fn status_field(pid: i32, field: &str) -> String {
    let mut text = String::new();
    let path = format!("/proc/{pid}/status");
    std::fs::File::open(&path).unwrap().read_to_string(&mut text).unwrap();
    let found = text.lines().find_map(|line| line.strip_prefix(field)?.strip_prefix(':'));
    found.unwrap_or_else(|| panic!("{path} has no {field}")).trim().to_owned()
}
