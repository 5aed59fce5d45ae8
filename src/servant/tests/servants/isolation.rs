//! Restrictions of nodes and shims.

use servant::container::{Mount, OpenedSource, Profile};
use servant::engine::{LogStart, ServantHandle};
use servant::{bundle, idmap};

use crate::support::*;

#[tokio::test]
async fn a_shim_may_end_processes_and_nothing_else() {
    let world = World::new();
    let servant = world.start(spec(vec![])).await;
    let shim = world.runtime(servant.id()).shim.pid;
    let kill = "0000000000000020";
    let none = "0000000000000000";
    for (name, value) in
        [("CapInh", none), ("CapPrm", kill), ("CapEff", kill), ("CapBnd", kill), ("CapAmb", none), ("NoNewPrivs", "1")]
    {
        assert_eq!(status_field(shim, name), value, "{name}");
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn a_shim_that_was_taken_over_reaches_nothing_of_roots() {
    let world = World::new();
    let socket = world.path("of-root.sock");
    let _listener = std::os::unix::net::UnixListener::bind(&socket).unwrap();
    let mut spec = spec(vec![]);
    spec.resident = serde_json::json!({ "pries": socket });
    let servant = world.start(spec).await;
    let told = read_from_port(&servant, 11311).await.unwrap();
    let mut lines = told.lines();
    assert_eq!(lines.next(), Some("own file: allowed"), "{told}");
    assert_eq!(lines.clone().count(), 6, "{told}");
    assert!(lines.all(|line| !line.ends_with("allowed")), "{told}");
    let shim = world.runtime(servant.id()).shim.pid;
    assert_eq!(status_field(shim, "Seccomp"), "2");
    // It can still change limits and end its servant.
    let change = servant::spec::Limits { memory: Some(servant::spec::Size(64 << 20)), ..Default::default() };
    if world.has_controller("memory") {
        let enforced = servant.set_limits(change).await.unwrap();
        assert_eq!(enforced.limits.memory, change.memory);
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn every_process_is_confined_as_seen_from_the_host() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/one", &["family"]), node("/two", &["sleep"])])).await;
    let mut lines = servant.follow(LogStart::First);
    lines_until(&mut lines, |line| line.line == "family").await;
    let processes = processes(&servant, 3).await;
    assert_eq!(processes.len(), 3, "two nodes and a child");
    let (first, count) = servant.uid_range();
    for pid in processes {
        assert_eq!(status_field(pid, "Seccomp"), "2");
        assert_eq!(status_field(pid, "NoNewPrivs"), "1");
        for set in ["CapEff", "CapPrm", "CapBnd", "CapAmb", "CapInh"] {
            assert_eq!(status_field(pid, set), "0000000000000000", "{set}");
        }
        let map = std::fs::read_to_string(format!("/proc/{pid}/uid_map")).unwrap();
        let map: Vec<u32> = map.split_whitespace().map(|number| number.parse().unwrap()).collect();
        assert_eq!(map, [0, first, count]);
        assert_eq!(status_field(pid, "Uid").split_whitespace().next().unwrap(), first.to_string());
        for kind in ["user", "mnt", "pid", "net", "ipc", "uts", "cgroup"] {
            let namespace = |who: &str| std::fs::read_link(format!("/proc/{who}/ns/{kind}")).unwrap();
            assert_ne!(namespace(&pid.to_string()), namespace("self"), "{kind}");
        }
    }
    world.stop(servant).await;
}

#[tokio::test]
async fn no_way_out_is_open() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/curious", &["calls"])])).await;
    let mut lines = servant.follow(LogStart::First);
    let told = lines_until(&mut lines, |line| line.line == "end of calls").await;
    assert!(told.len() > 40, "everything was tried: {told:?}");
    let allowed: Vec<_> = told.iter().filter(|line| line.line.ends_with("allowed")).collect();
    assert!(allowed.is_empty(), "{allowed:#?}");
    let answer = |name: &str| told.iter().find_map(|line| line.line.strip_prefix(name)).unwrap().to_owned();
    assert!(answer("clone3: ").contains("not implemented"), "so that the C library falls back");
    // Refused by the filter, not by the kernel, which has such families or loads them.
    for family in ["netlink", "tipc"] {
        let answer = answer(&format!("{family} socketpair: "));
        assert!(answer.contains("not implemented"), "{family}: {answer}");
    }
    assert!(
        answer("clone with a new user namespace: ").contains("not implemented")
            || answer("clone with a new user namespace: ").contains("not permitted")
    );
    world.stop(servant).await;
}

#[tokio::test]
async fn a_servant_uses_up_counts_of_its_own_alone() {
    let world = World::new();
    let mut told = Vec::new();
    let mut servants = Vec::new();
    // The second servant finds as much as the first, which still holds everything it got.
    for _ in 0..2 {
        let servant = world.start(spec(vec![node("/greedy", &["exhaust"])])).await;
        let mut lines = servant.follow(LogStart::First);
        let line = lines_until(&mut lines, |line| line.stream == "stdout").await;
        let counts: Vec<u64> = line[line.len() - 1].line.split(' ').map(|count| count.parse().unwrap()).collect();
        told.push(counts);
        servants.push(servant);
    }
    assert!(told[0].iter().all(|count| *count > 0), "{told:?}");
    let [queues, signals, instances, terminals] = told[0][..] else { panic!("{told:?}") };
    // A signal pending for the servant's first process at that moment counts as well.
    let others = told[1][1];
    assert!(signals.abs_diff(others) < 8, "{told:?}");
    assert_eq!([queues, others, instances, terminals], told[1][..]);
    assert!(signals <= idmap::PENDING_SIGNALS, "{told:?}");
    assert!(instances <= bundle::INOTIFY_INSTANCES, "{told:?}");
    assert!(terminals <= bundle::TERMINALS, "{told:?}");
    // This process, which is root's, still has its own limits.
    let watch = nix::sys::inotify::Inotify::init(nix::sys::inotify::InitFlags::empty());
    watch.expect("an inotify instance for root");
    let mut timer = std::ptr::null_mut();
    // SAFETY: no event, which means a signal, and a location for the timer.
    let made = unsafe { libc::timer_create(libc::CLOCK_MONOTONIC, std::ptr::null_mut(), &raw mut timer) };
    assert_eq!(made, 0, "a timer for root: {}", std::io::Error::last_os_error());
    // SAFETY: just created.
    unsafe { libc::timer_delete(timer) };
    for servant in servants {
        world.stop(servant).await;
    }
}

#[tokio::test]
async fn builds_open_no_way_out_either() {
    let world = World::new();
    for profile in [Profile::Compile, Profile::Install] {
        let mut spec = spec(vec![node("/curious", &["calls"])]);
        spec.profile = profile;
        spec.writable = Some(world.path("upper"));
        let servant = world.start(spec).await;
        let mut lines = servant.follow(LogStart::First);
        let told = lines_until(&mut lines, |line| line.line == "end of calls").await;
        let mut allowed = told.iter().map(|line| line.line.as_str()).filter(|line| line.ends_with("allowed"));
        // An install may write its root; that is its purpose.
        let expected =
            |line: &str| profile == Profile::Install && line.starts_with("write /") && !line.contains("/proc");
        assert_eq!(allowed.find(|line| !expected(line)), None);
        world.stop(servant).await;
    }
}

#[tokio::test]
async fn a_volume_is_there_and_read_only() {
    let world = World::new();
    let models = world.path("models");
    std::fs::create_dir(&models).unwrap();
    std::fs::write(models.join("weights"), "heavy\n").unwrap();
    let mut spec =
        spec(vec![node("/reads", &["read", "/opt/models/weights"]), node("/writes", &["write", "/opt/models/x"])]);
    spec.mounts = vec![Mount {
        source: models.clone(),
        target: "/opt/models".into(),
        writable: false,
        device: false,
        opened: None,
    }];
    let servant = world.start(spec).await;
    assert_eq!(with_timeout(servant.wait_node("/reads")).await.unwrap().code, Some(0));
    assert_eq!(with_timeout(servant.wait_node("/writes")).await.unwrap().code, Some(libc::EROFS));
    world.stop(servant).await;
    assert!(models.join("weights").exists());
}

#[tokio::test]
async fn what_was_opened_is_mounted_whatever_took_its_place() {
    let world = World::new();
    let (models, secret) = (world.path("models"), world.path("secret"));
    for directory in [&models, &secret] {
        std::fs::create_dir(directory).unwrap();
    }
    std::fs::write(models.join("weights"), "heavy\n").unwrap();
    std::fs::write(secret.join("key"), "of the host\n").unwrap();
    let mut spec =
        spec(vec![node("/reads", &["read", "/opt/models/weights"]), node("/pries", &["read", "/opt/models/key"])]);
    spec.mounts = vec![Mount {
        source: models.clone(),
        target: "/opt/models".into(),
        writable: false,
        device: false,
        opened: Some(OpenedSource::new(std::fs::File::open(&models).unwrap().into())),
    }];
    std::fs::rename(&models, world.path("moved")).unwrap();
    std::os::unix::fs::symlink(&secret, &models).unwrap();
    let servant = world.start(spec).await;
    let (reads, pries) = (servant.wait_node("/reads"), servant.wait_node("/pries"));
    assert_eq!(with_timeout(reads).await.unwrap().code, Some(0));
    assert_eq!(with_timeout(pries).await.unwrap().code, Some(libc::ENOENT));
    world.stop(servant).await;
}

#[tokio::test]
async fn two_servants_share_nothing_and_their_networks_are_apart() {
    let world = World::new();
    let mut first = spec(vec![]);
    first.resident = serde_json::json!({ "name": "first" });
    let mut second = spec(vec![]);
    second.resident = serde_json::json!({ "name": "second" });
    let (first, second) = (world.start(first).await, world.start(second).await);
    assert!(read_from_port(&first, 11311).await.unwrap().contains("first"));
    assert!(read_from_port(&second, 11311).await.unwrap().contains("second"));
    assert_ne!(first.uid_range().0, second.uid_range().0);
    assert_ne!(first.network(), second.network());
    world.stop(first).await;
    world.stop(second).await;
}
