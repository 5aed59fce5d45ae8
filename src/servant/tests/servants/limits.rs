//! Limits are enforced, reported and can be changed.

use servant::engine::{ContainerState, LogStart, NodeEvent, ServantHandle};
use servant::local::Isolation;
use servant::spec::{Limits, Size};

use crate::support::*;

#[tokio::test]
async fn the_memory_limit_kills_and_is_told() {
    let world = World::new();
    let mut spec = spec(vec![node("/quiet", &["sleep"])]);
    spec.limits.memory = Some(Size(48 << 20));
    world.require_controllers(&["memory"]);
    let servant = world.start(spec).await;
    let mut events = servant.events();
    servant.start_node(node("/greedy", &["eat"])).await.unwrap();
    let exit = with_timeout(servant.wait_node("/greedy")).await.unwrap();
    assert_eq!((exit.signal, exit.out_of_memory), (Some(libc::SIGKILL), true));
    let told = with_timeout(async {
        loop {
            if let NodeEvent::Exited { node, out_of_memory, .. } = events.recv().await.unwrap() {
                return (node, out_of_memory);
            }
        }
    });
    assert_eq!(told.await, ("/greedy".to_owned(), true));
    assert!(servant.usage().await.unwrap().oom_kills >= 1);
    // A kill by hand is not taken for an OOM kill.
    servant.signal_node("/quiet", libc::SIGKILL).await.unwrap();
    let exit = with_timeout(servant.wait_node("/quiet")).await.unwrap();
    assert_eq!((exit.signal, exit.out_of_memory), (Some(libc::SIGKILL), false));
    world.stop(servant).await;
}

#[tokio::test]
async fn a_required_node_out_of_memory_is_a_failure_that_names_the_limit() {
    let world = World::new();
    let mut greedy = node("/greedy", &["eat"]);
    greedy.required = true;
    let mut spec = spec(vec![]);
    spec.limits.memory = Some(Size(48 << 20));
    world.require_controllers(&["memory"]);
    let servant = world.start(spec).await;
    servant.start_node(greedy).await.unwrap();
    let ContainerState::Failed { reason } = wait_until_ended(&*servant).await else { panic!("it did not fail") };
    assert!(reason.contains("/greedy") && reason.contains("48M"), "{reason}");
    world.stop(servant).await;
}

#[tokio::test]
async fn the_pids_limit_stops_a_fork_bomb() {
    let world = World::new();
    let mut spec = spec(vec![node("/bomb", &["fork", "500"])]);
    spec.limits.pids = Some(20);
    world.require_controllers(&["pids"]);
    let servant = world.start(spec).await;
    let mut lines = servant.follow(LogStart::First);
    let told = lines_until(&mut lines, |line| line.stream == "stdout").await;
    assert!(told[0].line.contains("temporarily unavailable"), "{told:?}");
    assert!(servant.usage().await.unwrap().pids <= 20);
    world.stop(servant).await;
}

#[tokio::test]
async fn limits_are_read_back_and_changed_while_it_runs() {
    let world = World::new();
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    spec.limits = Limits {
        cpus: Some(0.5),
        cpu_weight: Some(200),
        memory: Some(Size(64 << 20)),
        pids: Some(50),
        ..Limits::default()
    };
    let asked = spec.limits;
    world.require_controllers(&["cpu", "memory", "pids"]);
    let servant = world.start(spec).await;
    let enforced = servant.enforced_limits();
    assert_eq!(enforced.limits, asked);
    let change = Limits { cpus: Some(1.5), memory: Some(Size(96 << 20)), ..Limits::default() };
    let now = servant.set_limits(change).await.unwrap();
    assert_eq!(now.limits, Limits { cpus: Some(1.5), memory: Some(Size(96 << 20)), ..asked });
    assert_eq!(servant.enforced_limits(), now);
    processes(&servant, 1).await;
    let usage = servant.usage().await.unwrap();
    assert!(usage.memory > 0 && usage.pids >= 2, "{usage:?}");
    // If a v2 hierarchy is mounted, alone or beside v1, and the kernel supports PSI.
    let unified = std::fs::read_to_string("/proc/self/mounts").unwrap();
    let told = unified.contains(" cgroup2 ") && std::path::Path::new("/proc/pressure").exists();
    assert_eq!(usage.pressure.is_some(), told, "{usage:?}");
    world.stop(servant).await;
}

#[tokio::test]
async fn input_and_output_are_limited_where_the_host_can() {
    let world = World::new();
    let can = world.has_controller("io") || world.has_controller("blkio");
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    // On a disk, or on something else.
    let device = std::os::unix::fs::MetadataExt::dev(&std::fs::metadata(&spec.layers[0]).unwrap());
    let on_disk =
        std::path::Path::new(&format!("/sys/dev/block/{}:{}", libc::major(device), libc::minor(device))).exists();
    spec.limits.io_write = Some(Size(5 << 20));
    let servant = world.start(spec).await;
    let limits = servant.enforced_limits().limits;
    let expected = (can && on_disk).then_some(Size(5 << 20));
    assert_eq!((limits.io_read, limits.io_write), (None, expected));
    world.stop(servant).await;
}

#[tokio::test]
async fn nodes_stay_on_the_cores_they_were_given() {
    let world = World::new();
    world.require_controllers(&["cpuset"]);
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    // The last core that this process may use.
    let own = std::fs::read_to_string("/proc/self/status").unwrap();
    let own = own.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:")).unwrap();
    let core: usize = own.trim().rsplit([',', '-']).next().unwrap().parse().unwrap();
    let cores = core.to_string().parse().ok();
    spec.limits.cpuset = cores;
    let servant = world.start(spec).await;
    assert_eq!(servant.enforced_limits().limits.cpuset, cores);
    let pid = processes(&servant, 1).await[0];
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    assert!(status.contains(&format!("Cpus_allowed_list:\t{core}\n")), "{status}");
    world.stop(servant).await;
}

#[tokio::test]
async fn what_nobody_reads_of_sockets_is_bounded_with_the_memory() {
    let world = World::new();
    world.require_controllers(&["memory"]);
    const MEMORY: u64 = 32 << 20;
    let mut spec = spec(vec![node("/sends", &["buffer"])]);
    spec.limits.memory = Some(Size(MEMORY));
    let servant = world.start(spec).await;
    let mut lines = servant.follow(LogStart::First);
    let told = lines_until(&mut lines, |line| line.stream == "stdout").await;
    let kept: Vec<u64> = told[told.len() - 1].line.split(' ').map(|bytes| bytes.parse().unwrap()).collect();
    // Without a limit it is about a hundred MiB by TCP, and 60 by UDP.
    for kept in &kept {
        assert!((1..MEMORY).contains(kept), "{kept:?}");
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn a_soft_limit_of_memory_holds_or_is_refused_by_name() {
    let world = World::new();
    world.require_controllers(&["memory"]);
    let servant = world.start(spec(vec![node("/a", &["sleep"])])).await;
    let high = Limits { memory_high: Some(Size(64 << 20)), ..Limits::default() };
    let outcome = servant.set_limits(high).await;
    if servant.enforced_limits().cgroup_version == 2 {
        assert_eq!(outcome.unwrap().limits.memory_high, high.memory_high);
    } else {
        let refused = outcome.unwrap_err().to_string();
        assert!(refused.contains("memory_high (cgroup v1 has no memory.high"), "{refused}");
        assert_eq!(servant.enforced_limits().unmet_limits(&high).len(), 1);
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn where_isolation_is_required_a_limit_that_does_not_hold_is_refused() {
    let world = World::with_config(|config| config.isolation = Isolation::Require);
    let mut spec = spec(vec![]);
    // More than any kernel accepts as a limit.
    spec.limits.memory = Some(Size(1 << 62));
    let (id, error) = (spec.id.clone(), world.engine.start_container(spec).await.map(|_| ()).unwrap_err().to_string());
    assert!(error.contains("memory") && error.contains("best-effort"), "{error}");
    assert!(!world.servant_directory(&id).exists());
}

/// Reads the number in a control file of the shim's cgroup, in the hierarchy that has it.
fn read_shim_limit(world: &World, id: &str, names: [&str; 2]) -> Option<u64> {
    let cgroup = std::fs::read_to_string(format!("/proc/{}/cgroup", world.runtime(id).shim.pid));
    let cgroup = cgroup.expect("the shim runs");
    let mounts = ["/sys/fs/cgroup/memory", "/sys/fs/cgroup/cpu,cpuacct", "/sys/fs/cgroup/cpu", "/sys/fs/cgroup"];
    let paths = cgroup.lines().filter_map(|line| line.rsplit(':').next());
    let ours: Vec<&str> = paths.filter(|path| path.ends_with(&format!("{id}.shim"))).collect();
    assert!(!ours.is_empty(), "the shim is in no cgroup of its own: {cgroup}");
    let files = mounts.iter().flat_map(|mount| {
        let ours = ours.iter();
        ours.flat_map(move |path| names.map(|name| format!("{mount}{path}/{name}")))
    });
    let text = files.filter_map(|file| std::fs::read_to_string(file).ok()).next()?;
    text.split_whitespace().next()?.parse().ok()
}

#[tokio::test]
async fn the_shim_has_limits_of_its_own() {
    let world = World::with_config(|config| {
        config.shim_limits = Limits { cpus: Some(0.5), memory: Some(Size(96 << 20)), ..Limits::default() };
    });
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    spec.limits.cpus = Some(0.2);
    let servant = world.start(spec).await;
    world.require_controllers(&["cpu", "memory"]);
    let id = servant.id().to_owned();
    assert_eq!(servant.enforced_limits().shim.memory, Some(Size(96 << 20)));
    let names = ["memory.max", "memory.limit_in_bytes"];
    assert_eq!(read_shim_limit(&world, &id, names), Some(96 << 20));
    // No more than its servant has, and more when the servant is given more.
    assert_eq!(servant.enforced_limits().shim.cpus, Some(0.2));
    assert_eq!(read_shim_limit(&world, &id, ["cpu.max", "cpu.cfs_quota_us"]), Some(20_000));
    let more = Limits { cpus: Some(1.5), ..Limits::default() };
    assert_eq!(servant.set_limits(more).await.unwrap().shim.cpus, Some(0.5));
    // The next daemon finds them unchanged, and leaves nothing of them.
    let enforced = servant.enforced_limits();
    drop(servant);
    let servant = world.adopt_single(&world.restart_engine()).await;
    assert_eq!(servant.enforced_limits(), enforced);
    let own = world.runtime(&id).shim_cgroup.expect("it has one");
    assert!(own.exists());
    world.stop(servant).await;
    assert!(!own.exists(), "the shim's cgroup is left");
}

#[tokio::test]
async fn a_shim_that_takes_too_much_ends_its_servant_and_says_why() {
    let world = World::with_config(|config| config.shim_limits.memory = Some(Size(48 << 20)));
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    spec.resident = serde_json::json!({ "eat": true });
    world.require_controllers(&["memory"]);
    let servant = world.start(spec).await;
    // The resident allocates memory as soon as a client connects.
    let _ = read_from_port(&servant, 11311).await;
    let ContainerState::Failed { reason } = wait_until_ended(&*servant).await else { panic!("it did not fail") };
    assert!(reason.contains("its shim was killed") && reason.contains("its 48M of memory"), "{reason}");
    world.stop(servant).await;
}

#[tokio::test]
async fn what_protects_the_daemon_does_not_protect_nodes() {
    let score = |pid: i32| -> i32 {
        let path = format!("/proc/{pid}/oom_score_adj");
        let text = std::fs::read_to_string(path).expect("it runs");
        text.trim().parse().expect("a number")
    };
    let own = score(std::process::id() as i32);
    // As set by a unit with OOMScoreAdjust=; if that fails there is nothing to inherit.
    let protects = std::fs::write("/proc/self/oom_score_adj", "-500").is_ok();
    let world = World::new();
    let servant = world.start(spec(vec![node("/a", &["sleep"])])).await;
    let shim = world.runtime(servant.id()).shim.pid;
    let expected = if protects { -500 } else { own };
    assert_eq!(score(shim), expected, "the shim is part of the daemon");
    for pid in processes(&servant, 1).await {
        assert_eq!(score(pid), own.max(0), "a node");
    }
    let _ = std::fs::write("/proc/self/oom_score_adj", own.to_string());
    world.stop(servant).await;
}
