//! How long a container takes from the wish to a running first process: this engine, libcontainer called from a bare program
//! with one thread, and `runc` where it is installed. All with the same namespaces, mounts, seccomp filter and limits.
//!
//!     cargo run --release -p servant --example create_speed -- LAYER [ROUNDS]
//!
//! LAYER is a root directory with `/bin/sleep`. The program calls itself as a shim (`shim DIRECTORY`) and as the bare
//! program (`bare BUNDLE`). Needs root; the init is found by CLOUDROID_INIT.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};
use std::time::{Duration, Instant};

use libcontainer::container::builder::ContainerBuilder;
use libcontainer::syscall::syscall::SyscallType;
use servant::engine::Engine;
use servant::local::{DEFAULT_UID_BASE, Isolation, LocalEngine, LocalEngineConfig};
use servant::rootfs::{Staged, make_skeleton};
use servant::shim::NoResident;
use servant::spec::{Limits, Profile, Spec};

type Failure = Box<dyn std::error::Error>;

fn main() -> ExitCode {
    let words: Vec<String> = std::env::args().collect();
    let words: Vec<&str> = words.iter().map(String::as_str).collect();
    let outcome = match words.as_slice() {
        [_, "shim", directory] => {
            return servant::shim::run(Path::new(directory), Box::new(NoResident));
        }
        [_, "bare", bundle] => bare(Path::new(bundle)),
        [_, layer] => compare(Path::new(layer), 20),
        [_, layer, rounds] => rounds
            .parse()
            .map_err(Failure::from)
            .and_then(|rounds| compare(Path::new(layer), rounds)),
        _ => Err("give a layer: see the head of examples/create_speed.rs".into()),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}

fn spec(id: String, layer: &Path) -> Spec {
    Spec {
        id,
        layers: vec![layer.into()],
        writable: None,
        profile: Profile::Servant,
        limits: Limits {
            cpus: Some(1.0),
            cpu_weight: None,
            memory: Some(256 << 20),
            pids: Some(100),
        },
        environment: Default::default(),
        nodes: vec![],
        owned_directories: vec![],
        mounts: vec![],
        resident: serde_json::Value::Null,
    }
}

fn compare(layer: &Path, rounds: u32) -> Result<(), Failure> {
    let layer = layer.canonicalize()?;
    let home = std::env::temp_dir().join(format!("create-speed-{}", std::process::id()));
    std::fs::create_dir_all(&home)?;
    // The peers must reach the root as the container's own root.
    let bundles = home.join("bundles");
    std::fs::create_dir_all(&bundles)?;
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()?;
    let init = std::env::var_os("CLOUDROID_INIT")
        .ok_or("set CLOUDROID_INIT to the static cloudroid-init")?;
    let own = std::env::current_exe()?;
    let command = vec![own.clone().into_os_string(), "shim".into()];
    let mut config = LocalEngineConfig::new(home.join("servants"), command, init.into());
    config.isolation = Isolation::BestEffort;
    let engine = runtime.block_on(async { LocalEngine::new(config) })?;
    engine.warm_up();
    let has_runc = Command::new("runc")
        .arg("--version")
        .output()
        .is_ok_and(|output| output.status.success());
    let (mut ours, mut theirs, mut runc) = (Vec::new(), Vec::new(), Vec::new());
    // In turn, so that the machine's moods meet all alike.
    for round in 0..rounds {
        let id = format!("speed-{}-{round}", std::process::id());
        runtime.block_on(async {
            let begun = Instant::now();
            let servant = engine.start(spec(id.clone(), &layer)).await?;
            ours.push(begun.elapsed());
            servant.stop().await
        })?;
        let bundle = bundle(&bundles.join(&id), &id, &layer)?;
        let output = Command::new(&own).arg("bare").arg(&bundle).output()?;
        let text = String::from_utf8_lossy(&output.stdout);
        let time: f64 = text
            .trim()
            .parse()
            .map_err(|_| String::from_utf8_lossy(&output.stderr).into_owned())?;
        theirs.push(Duration::from_secs_f64(time));
        if has_runc {
            runc.push(time_runc(&bundle, &id)?);
        }
        unmount(&bundle)?;
    }
    println!("create to running, ms, median (least) of {rounds}:");
    let base = median(&mut theirs);
    for (name, times) in [
        ("this engine", &mut ours),
        ("libcontainer, bare", &mut theirs),
        ("runc", &mut runc),
    ] {
        if !times.is_empty() {
            let middle = median(times);
            println!(
                "  {name:20} {:6.1} ({:.1})  ratio {:.2}",
                ms(middle),
                ms(times[0]),
                ms(middle) / ms(base)
            );
        }
    }
    drop(engine);
    std::fs::remove_dir_all(&home)?;
    Ok(())
}

fn median(times: &mut [Duration]) -> Duration {
    times.sort();
    times.get(times.len() / 2).copied().unwrap_or_default()
}

fn ms(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

/// The same container for the peers: the layer, unshifted, under an overlay on the host; network namespace and limits, which
/// the engine makes itself, in the configuration; a process that stays.
fn bundle(directory: &Path, id: &str, layer: &Path) -> Result<PathBuf, Failure> {
    let (skeleton, root) = (directory.join("skeleton"), directory.join("root"));
    std::fs::create_dir_all(&root)?;
    make_skeleton(&skeleton, id, &[], &[])?;
    let options = format!("lowerdir={}:{}", skeleton.display(), layer.display());
    nix::mount::mount(
        Some("overlay"),
        &root,
        Some("overlay"),
        nix::mount::MsFlags::MS_RDONLY,
        Some(options.as_str()),
    )?;
    let staged = Staged {
        root: root.clone(),
        volumes: vec![],
    };
    let config = servant::bundle::config(
        &spec(id.to_owned(), layer),
        &staged,
        (DEFAULT_UID_BASE, 65536),
    )?;
    let mut json = serde_json::to_value(config)?;
    json["process"]["args"] = serde_json::json!(["/bin/sleep", "60"]);
    json["linux"]["namespaces"]
        .as_array_mut()
        .ok_or("namespaces")?
        .push(serde_json::json!({ "type": "network" }));
    json["linux"]["resources"] = serde_json::json!({
        "memory": { "limit": 256 << 20 }, "cpu": { "quota": 100_000, "period": 100_000 }, "pids": { "limit": 100 }
    });
    json["linux"]["cgroupsPath"] = format!("{}/{id}", own_cgroup()?).into();
    std::fs::write(directory.join("config.json"), serde_json::to_vec(&json)?)?;
    Ok(directory.into())
}

/// Where we are in the memory hierarchy: below it the peers' containers stay within our own limits.
fn own_cgroup() -> Result<String, Failure> {
    let text = std::fs::read_to_string("/proc/self/cgroup")?;
    let find = |name: &str| {
        text.lines().find_map(|line| {
            let mut fields = line.splitn(3, ':').skip(1);
            (fields.next()? == name)
                .then(|| {
                    fields
                        .next()
                        .map(|path| path.trim_end_matches('/').to_owned())
                })
                .flatten()
        })
    };
    find("memory")
        .or_else(|| find(""))
        .ok_or_else(|| "no cgroup".into())
}

fn unmount(bundle: &Path) -> Result<(), Failure> {
    nix::mount::umount2(&bundle.join("root"), nix::mount::MntFlags::MNT_DETACH)?;
    Ok(())
}

/// One container in this process, which has one thread; prints the seconds.
fn bare(bundle: &Path) -> Result<(), Failure> {
    let id = bundle
        .file_name()
        .ok_or("a bundle has a name")?
        .to_string_lossy()
        .into_owned();
    let null = || {
        std::fs::File::options()
            .read(true)
            .write(true)
            .open("/dev/null")
    };
    let begun = Instant::now();
    let mut container = ContainerBuilder::new(id, SyscallType::default())
        .with_root_path(bundle.join("state"))?
        .with_stdin(null()?)
        .with_stdout(null()?)
        .with_stderr(null()?)
        .validate_id()?
        .as_init(bundle)
        .with_systemd(false)
        .with_detach(true)
        .build()?;
    container.start()?;
    println!("{}", begun.elapsed().as_secs_f64());
    container.kill(libcontainer::signal::Signal::try_from(libc::SIGKILL)?, true)?;
    if let Some(pid) = container.pid() {
        // Our own child; a container that has not ended cannot be deleted.
        let _ = nix::sys::wait::waitpid(nix::unistd::Pid::from_raw(pid.as_raw()), None);
    }
    container.delete(true)?;
    Ok(())
}

fn time_runc(bundle: &Path, id: &str) -> Result<Duration, Failure> {
    // runc knows the operands of a masked comparison the right way round.
    let path = bundle.join("config.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&path)?)?;
    for rule in json["linux"]["seccomp"]["syscalls"]
        .as_array_mut()
        .ok_or("seccomp")?
    {
        for argument in rule["args"].as_array_mut().into_iter().flatten() {
            let (value, mask) = (argument["value"].clone(), argument["valueTwo"].clone());
            (argument["value"], argument["valueTwo"]) = (mask, value);
        }
    }
    std::fs::write(&path, serde_json::to_vec(&json)?)?;
    let root = bundle.join("runc");
    let runc = |words: &[&str]| -> Result<(), Failure> {
        let null = || {
            std::fs::File::options()
                .read(true)
                .write(true)
                .open("/dev/null")
        };
        let mut command = Command::new("runc");
        command
            .arg("--root")
            .arg(&root)
            .args(words)
            .stdin(null()?)
            .stdout(null()?);
        let status = command
            .stderr(std::fs::File::create(bundle.join("runc.log"))?)
            .status()?;
        let complaint = || std::fs::read_to_string(bundle.join("runc.log")).unwrap_or_default();
        if status.success() {
            Ok(())
        } else {
            Err(format!("runc {}: {}", words[0], complaint()).into())
        }
    };
    let place = bundle.to_str().ok_or("UTF-8")?;
    let begun = Instant::now();
    runc(&["create", "--bundle", place, id])?;
    runc(&["start", id])?;
    let time = begun.elapsed();
    runc(&["delete", "--force", id])?;
    Ok(time)
}
