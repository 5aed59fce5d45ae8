//! Starting and stopping of servants and nodes.

use std::os::fd::OwnedFd;

use servant::container::Mount;
use servant::engine::{ContainerState, LogStart, NodeEvent, ServantHandle};
use servant::process::ProcessIdentity;

use crate::support::*;

#[tokio::test]
async fn stop_leaves_nothing_of_nodes_that_do_not_want_to_end() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/stubborn", &["stubborn"]), node("/polite", &["sleep"])])).await;
    let mut lines = servant.follow(LogStart::First);
    lines_until(&mut lines, |line| line.line == "stubborn").await;
    assert_eq!(processes(&servant, 3).await.len(), 3);
    let state = servant.state();
    world.stop(servant).await;
    assert_eq!(*state.borrow(), ContainerState::Stopped { reason: "stopped".into() });
    assert!(lines.recv().await.is_none(), "the log has ended");
}

#[tokio::test]
async fn polite_nodes_are_asked_by_sigint_and_need_not_be_killed() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/polite", &["sleep"])])).await;
    let mut events = servant.events();
    let directory = world.servant_directory(servant.id());
    let waiting = tokio::spawn({
        let servant = servant.clone();
        async move { servant.wait_node("/polite").await }
    });
    world.stop(servant).await;
    assert_eq!(waiting.await.unwrap().unwrap().signal, Some(libc::SIGINT));
    let exited = with_timeout(async {
        loop {
            if let NodeEvent::Exited { signal, .. } = events.recv().await.unwrap() {
                return signal;
            }
        }
    });
    assert_eq!(exited.await, Some(libc::SIGINT));
    assert!(!directory.exists());
}

#[tokio::test]
async fn exit_codes_signals_and_programs_that_are_not_there_are_told_apart() {
    let world = World::new();
    let mut missing = node("/missing", &[]);
    missing.argv = vec!["/no/such/program".into()];
    let mut lost = node("/lost", &["exit", "0"]);
    lost.directory = "/no/such/directory".into();
    let nodes = vec![
        node("/fine", &["exit", "0"]),
        node("/seven", &["exit", "7"]),
        node("/dead", &["die", "11"]),
        missing,
        lost,
    ];
    let servant = world.start(spec(nodes)).await;
    let exit = async |name: &str| with_timeout(servant.wait_node(name)).await.unwrap();
    assert_eq!(exit("/fine").await.code, Some(0));
    assert_eq!(exit("/seven").await.code, Some(7));
    assert_eq!((exit("/dead").await.code, exit("/dead").await.signal), (None, Some(11)));
    let reason = exit("/missing").await.exec_error.unwrap();
    assert!(reason.contains("could not be executed: No such file"), "{reason}");
    let reason = exit("/lost").await.exec_error.unwrap();
    assert!(reason.contains("working directory"), "{reason}");
    let error = servant.wait_node("/unheard-of").await.unwrap_err().to_string();
    assert!(error.contains("/unheard-of"), "{error}");
    assert!(matches!(*servant.state().borrow(), ContainerState::Running), "no node was required");
    world.stop(servant).await;
}

#[tokio::test]
async fn the_end_of_a_required_node_ends_the_servant() {
    let world = World::new();
    let mut required = node("/required", &["exit", "3"]);
    required.required = true;
    let servant = world.start(spec(vec![node("/other", &["sleep"])])).await;
    // A required node that ends during the start makes that fail; this one is started afterwards.
    servant.start_node(required).await.unwrap();
    let ContainerState::Stopped { reason } = wait_until_ended(&*servant).await else { panic!("it failed") };
    assert!(reason.contains("/required") && reason.contains('3'), "{reason}");
    assert_eq!(with_timeout(servant.wait_node("/required")).await.unwrap().code, Some(3));
    let error = servant.start_node(node("/late", &["sleep"])).await.unwrap_err().to_string();
    assert!(error.contains("ended"), "{error}");
    world.stop(servant).await;
}

#[tokio::test]
async fn a_respawning_node_comes_back_and_can_still_be_stopped() {
    let world = World::new();
    let mut again = node("/again", &["exit", "1"]);
    (again.respawn, again.respawn_delay) = (true, 0.05);
    let servant = world.start(spec(vec![again])).await;
    let mut events = servant.events();
    let three = with_timeout(async {
        let (mut starts, mut respawning) = (0, 0);
        while starts < 3 || respawning < 2 {
            match events.recv().await.unwrap() {
                NodeEvent::Started { .. } => starts += 1,
                NodeEvent::Respawning { node } => {
                    assert_eq!(node, "/again");
                    respawning += 1;
                }
                _ => {}
            }
        }
    });
    three.await;
    world.stop(servant).await;
}

#[tokio::test]
async fn nodes_that_end_for_good_do_not_come_back_and_end_nothing_with_them() {
    let world = World::new();
    let mut again = node("/again", &["sleep"]);
    (again.respawn, again.respawn_delay) = (true, 0.05);
    let mut needed = node("/needed", &["sleep"]);
    needed.required = true;
    let servant = world.start(spec(vec![again, needed])).await;
    let mut events = servant.events();
    for name in ["/again", "/needed"] {
        servant.end_node(name, libc::SIGKILL).await.unwrap();
        with_timeout(servant.wait_node(name)).await.unwrap();
    }
    // The next event must be that of the next start.
    servant.start_node(node("/last", &["sleep"])).await.unwrap();
    loop {
        match with_timeout(events.recv()).await.unwrap() {
            NodeEvent::Respawning { node } => panic!("{node} comes back"),
            NodeEvent::Started { node } if node == "/last" => break,
            _ => {}
        }
    }
    let running = *servant.state().borrow() == ContainerState::Running;
    assert!(running, "it ended with its node");
    world.stop(servant).await;
}

#[tokio::test]
async fn nodes_have_their_environment_and_directory_and_a_name_once() {
    let world = World::new();
    let mut speaker = node("/speaker", &["environment"]);
    speaker.environment = [("OWN".to_owned(), "1".to_owned())].into();
    speaker.directory = "/tmp".into();
    let servant = world.start(spec(vec![speaker, node("/stays", &["sleep"])])).await;
    let mut lines = servant.follow(LogStart::First);
    let told = lines_until(&mut lines, |line| line.node == "/speaker").await;
    assert_eq!(told.last().unwrap().line, r#"{"OWN": "1", "SHARED": "yes"} "/tmp""#);
    let error = servant.start_node(node("/stays", &["sleep"])).await.unwrap_err().to_string();
    assert!(error.contains("/stays runs already"), "{error}");
    with_timeout(servant.wait_node("/speaker")).await.unwrap();
    servant.start_node(node("/speaker", &["exit", "5"])).await.unwrap();
    world.stop(servant).await;
}

#[tokio::test]
async fn orphans_are_reaped_and_the_resident_is_told_of_every_end() {
    let world = World::new();
    let mut spec = spec(vec![node("/parent", &["orphan"])]);
    spec.resident = serde_json::json!("x");
    let servant = world.start(spec).await;
    with_timeout(servant.wait_node("/parent")).await.unwrap();
    with_timeout(async {
        while read_from_port(&servant, 11311).await.unwrap() != "\"x\" 2" {
            tokio::task::yield_now().await;
        }
    })
    .await;
    assert_eq!(servant.processes().unwrap(), Vec::<i32>::new());
    world.stop(servant).await;
}

#[tokio::test]
async fn a_killed_init_is_a_failure() {
    let world = World::new();
    let servant = world.start(spec(vec![])).await;
    servant.start_node(node("/a", &["sleep"])).await.unwrap();
    let pidfd: OwnedFd =
        ProcessIdentity::from_pid(servant.init_pid().unwrap()).unwrap().open_pidfd().unwrap().expect("it runs");
    kill(&pidfd);
    let ContainerState::Failed { reason } = wait_until_ended(&*servant).await else { panic!("it did not fail") };
    assert!(reason.contains("init was killed by signal 9"), "{reason}");
    assert_eq!(with_timeout(servant.wait_node("/a")).await.unwrap().signal, Some(libc::SIGKILL));
    world.stop(servant).await;
}

#[tokio::test]
async fn what_cannot_start_says_why_and_leaves_nothing() {
    let world = World::with_config(|config| config.uid_base = servant::local::DEFAULT_UID_BASE);
    let mut unshiftable = spec(vec![]);
    unshiftable.layers = vec!["/proc/sys".into()];
    let mut residentless = spec(vec![]);
    residentless.resident = serde_json::json!({ "fail": "no room" });
    let mut nodeless = spec(vec![node("/a", &[])]);
    nodeless.nodes[0].argv = vec!["relative".into()];
    for (spec, words) in
        [(unshiftable, "proc, which cannot be mounted"), (residentless, "no room"), (nodeless, "absolute path")]
    {
        let id = spec.id.clone();
        let error = world.engine.start_container(spec).await.map(|_| ()).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
        assert!(!world.servant_directory(&id).exists(), "{words}");
    }
    let spec = spec(vec![]);
    let servant = world.start(spec.clone()).await;
    let error = world.engine.start_container(spec).await.map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("exists already"), "{error}");
    world.stop(servant).await;
}

#[tokio::test]
async fn a_creation_that_libcontainer_fails_harms_nobody() {
    let world = World::new();
    let mut bystander = std::process::Command::new("cat").stdin(std::process::Stdio::piped()).spawn().unwrap();
    let mut spec = spec(vec![]);
    // No directory can be created there, which libcontainer notices half-way.
    spec.mounts = vec![Mount {
        source: "/usr".into(),
        target: "/proc/nowhere".into(),
        writable: false,
        device: false,
        opened: None,
    }];
    let id = spec.id.clone();
    let error = world.engine.start_container(spec).await.map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("failed to create container"), "{error}");
    assert!(!world.servant_directory(&id).exists());
    // Its cleanup kills what it takes for the container's processes.
    assert!(bystander.try_wait().unwrap().is_none(), "a process of the host was killed");
    drop(bystander.stdin.take());
    bystander.wait().unwrap();
}

#[tokio::test]
async fn a_start_that_nobody_waits_for_any_more_is_undone() {
    let world = World::new();
    let spec = spec(vec![node("/a", &["sleep"])]);
    let directory = world.servant_directory(&spec.id);
    let engine = world.engine.clone();
    let start = tokio::spawn(async move { engine.start_container(spec).await.map(|_| ()) });
    with_timeout(async {
        while !directory.exists() {
            tokio::task::yield_now().await;
        }
    })
    .await;
    start.abort();
    with_timeout(async {
        while directory.exists() {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn twenty_start_at_once_from_a_program_with_many_threads() {
    let world = World::new();
    let starts = (0..20).map(|_| {
        let engine = world.engine.clone();
        tokio::spawn(async move { engine.start_container(spec(vec![node("/a", &["sleep"])])).await })
    });
    let mut servants = Vec::new();
    for start in starts.collect::<Vec<_>>() {
        servants.push(with_timeout(start).await.unwrap().unwrap_or_else(|error| panic!("{error}")));
    }
    let uids: std::collections::BTreeSet<_> = servants.iter().map(|servant| servant.uid_range().0).collect();
    assert_eq!(uids.len(), 20);
    for servant in servants {
        world.stop(servant).await;
    }
}
