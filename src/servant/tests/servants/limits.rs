//! Limits that hold, are told, and can be changed.

use servant::engine::{ContainerState, Engine, NodeEvent};
use servant::local::Isolation;
use servant::spec::Limits;

use crate::support::*;

#[tokio::test]
async fn the_memory_limit_kills_and_is_told() {
    let world = World::new();
    let mut spec = spec(vec![node("/quiet", &["sleep"])]);
    spec.limits.memory = Some(48 << 20);
    let servant = world.start(spec).await;
    if servant.enforced().limits.memory.is_none() {
        // A host without the memory controller says so; there is nothing to see here.
        return world.stop(servant).await;
    }
    let mut events = servant.events();
    servant.start_node(node("/greedy", &["eat"])).await.unwrap();
    let exit = within(servant.wait_node("/greedy")).await.unwrap();
    assert_eq!(
        (exit.signal, exit.out_of_memory),
        (Some(libc::SIGKILL), true)
    );
    let told = within(async {
        loop {
            if let NodeEvent::Exited {
                node,
                out_of_memory,
                ..
            } = events.recv().await.unwrap()
            {
                return (node, out_of_memory);
            }
        }
    });
    assert_eq!(told.await, ("/greedy".to_owned(), true));
    assert!(servant.usage().await.unwrap().oom_kills >= 1);
    // Killed by hand it is not taken for the same.
    servant.signal_node("/quiet", libc::SIGKILL).await.unwrap();
    let exit = within(servant.wait_node("/quiet")).await.unwrap();
    assert_eq!(
        (exit.signal, exit.out_of_memory),
        (Some(libc::SIGKILL), false)
    );
    world.stop(servant).await;
}

#[tokio::test]
async fn a_required_node_out_of_memory_is_a_failure_that_names_the_limit() {
    let world = World::new();
    let mut greedy = node("/greedy", &["eat"]);
    greedy.required = true;
    let mut spec = spec(vec![greedy]);
    spec.limits.memory = Some(48 << 20);
    let servant = world.start(spec).await;
    let enforced = servant.enforced();
    if enforced.limits.memory.is_none() {
        return world.stop(servant).await;
    }
    let ContainerState::Failed { reason } = ended(&*servant).await else {
        panic!("it did not fail")
    };
    assert!(
        reason.contains("/greedy") && reason.contains(&(48 << 20).to_string()),
        "{reason}"
    );
    world.stop(servant).await;
}

#[tokio::test]
async fn the_pids_limit_stops_a_fork_bomb() {
    let world = World::new();
    let mut spec = spec(vec![node("/bomb", &["fork", "500"])]);
    spec.limits.pids = Some(20);
    let servant = world.start(spec).await;
    if servant.enforced().limits.pids.is_none() {
        return world.stop(servant).await;
    }
    let mut lines = servant.follow_log(true);
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
        memory: Some(64 << 20),
        pids: Some(50),
        ..Limits::default()
    };
    let asked = spec.limits;
    let servant = world.start(spec).await;
    let enforced = servant.enforced();
    if enforced.cgroup_version == 0 {
        return world.stop(servant).await;
    }
    assert_eq!(enforced.limits, asked);
    let change = Limits {
        cpus: Some(1.5),
        memory: Some(96 << 20),
        ..Limits::default()
    };
    let now = servant.set_limits(change).await.unwrap();
    assert_eq!(
        now.limits,
        Limits {
            cpus: Some(1.5),
            memory: Some(96 << 20),
            ..asked
        }
    );
    assert_eq!(servant.enforced(), now);
    processes(&*servant, 1).await;
    let usage = servant.usage().await.unwrap();
    assert!(usage.memory > 0 && usage.pids >= 2, "{usage:?}");
    // Where a v2 hierarchy is mounted, alone or beside v1, and the kernel counts it.
    let unified = std::fs::read_to_string("/proc/self/mounts").unwrap();
    let told = unified.contains(" cgroup2 ") && std::path::Path::new("/proc/pressure").exists();
    assert_eq!(usage.pressure.is_some(), told, "{usage:?}");
    world.stop(servant).await;
}

#[tokio::test]
async fn input_and_output_are_limited_where_the_host_can() {
    let world = World::new();
    let can = world
        .engine
        .cgroups()
        .controllers()
        .iter()
        .any(|name| name == "io" || name == "blkio");
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    // On a disk, or on something that is none.
    let device = std::os::unix::fs::MetadataExt::dev(&std::fs::metadata(&spec.layers[0]).unwrap());
    let on_disk = std::path::Path::new(&format!(
        "/sys/dev/block/{}:{}",
        libc::major(device),
        libc::minor(device)
    ))
    .exists();
    spec.limits.io_write = Some(5 << 20);
    let servant = world.start(spec).await;
    let limits = servant.enforced().limits;
    let expected = (can && on_disk).then_some(5 << 20);
    assert_eq!((limits.io_read, limits.io_write), (None, expected));
    world.stop(servant).await;
}

#[tokio::test]
async fn nodes_stay_on_the_cores_they_were_given() {
    let world = World::new();
    let can = world.engine.cgroups().controllers();
    let can = can.iter().any(|name| name == "cpuset");
    let mut spec = spec(vec![node("/a", &["sleep"])]);
    // The last of those that this very process may use.
    let own = std::fs::read_to_string("/proc/self/status").unwrap();
    let own = own
        .lines()
        .find_map(|line| line.strip_prefix("Cpus_allowed_list:"))
        .unwrap();
    let core: usize = own
        .trim()
        .rsplit([',', '-'])
        .next()
        .unwrap()
        .parse()
        .unwrap();
    let mut cores = [0; 4];
    cores[core / 64] |= 1 << (core % 64);
    spec.limits.cpuset = Some(cores);
    let servant = world.start(spec).await;
    assert_eq!(servant.enforced().limits.cpuset, can.then_some(cores));
    if can {
        let pid = processes(&*servant, 1).await[0];
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
        assert!(
            status.contains(&format!("Cpus_allowed_list:\t{core}\n")),
            "{status}"
        );
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn what_version_1_cannot_limit_is_refused_by_name() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/a", &["sleep"])])).await;
    if servant.enforced().cgroup_version == 1 {
        let high = Limits {
            memory_high: Some(64 << 20),
            ..Limits::default()
        };
        let refused = servant.set_limits(high).await.unwrap_err().to_string();
        assert!(
            refused.contains("memory_high (cgroup v1 has no memory.high"),
            "{refused}"
        );
        assert_eq!(servant.enforced().unmet(&high).len(), 1);
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn where_isolation_is_required_a_limit_that_does_not_hold_is_refused() {
    let world = World::with(|config| config.isolation = Isolation::Require);
    let mut spec = spec(vec![]);
    // More than any kernel takes for a limit.
    spec.limits.memory = Some(1 << 62);
    let (id, error) = (
        spec.id.clone(),
        world
            .engine
            .start(spec)
            .await
            .map(|_| ())
            .unwrap_err()
            .to_string(),
    );
    assert!(
        error.contains("memory") && error.contains("best-effort"),
        "{error}"
    );
    assert!(!world.servant_directory(&id).exists());
}
