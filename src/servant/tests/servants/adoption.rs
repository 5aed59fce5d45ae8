//! Servants outlive the daemon that started them.

use std::sync::Arc;

use nix::sys::signal::Signal;
use servant::engine::{ContainerState, Engine, LogStart, ServantHandle};

use crate::support::*;

#[tokio::test]
async fn a_servant_is_found_again_by_the_next_daemon() {
    let world = World::new();
    let mut spec = spec(vec![node("/stays", &["sleep"]), node("/goes", &["sleep"])]);
    spec.resident = serde_json::json!("same");
    let id = spec.id.clone();
    let first = world.start(spec).await;
    let (uids, network) = (first.uid_range(), Arc::clone(first.network()));
    let enforced = first.enforced_limits();
    let of_first = processes(&first, 2).await;
    assert_eq!(first.load_handover::<String>().await.unwrap(), None);
    for what in ["replaced", "of the first"] {
        first.save_handover(what).await.unwrap();
    }
    drop(first);
    let second = world.adopt_single(&world.restart_engine()).await;
    assert_eq!(second.id(), id);
    assert_eq!(*second.state().borrow(), ContainerState::Running);
    assert_eq!(second.nodes(), ["/goes", "/stays"]);
    assert_eq!((second.uid_range(), second.enforced_limits()), (uids, enforced));
    assert_eq!(*second.network(), network);
    let left: Option<String> = second.load_handover().await.unwrap();
    assert_eq!(left.as_deref(), Some("of the first"));
    assert_eq!(processes(&second, 2).await, of_first, "the same");
    assert!(read_from_port(&second, 11311).await.unwrap().starts_with("\"same\""));
    second.signal_node("/goes", libc::SIGTERM).await.unwrap();
    assert_eq!(with_timeout(second.wait_node("/goes")).await.unwrap().signal, Some(libc::SIGTERM));
    drop(second);
    // The third daemon knows what happened meanwhile.
    let third = world.adopt_single(&world.restart_engine()).await;
    assert_eq!(with_timeout(third.wait_node("/goes")).await.unwrap().signal, Some(libc::SIGTERM));
    world.stop(third).await;
}

#[tokio::test]
async fn a_shim_that_does_not_answer_delays_the_adoption_of_no_other_servant() {
    let world = World::new();
    let stuck = world.start(spec(vec![node("/a", &["sleep"])])).await;
    let sound = world.start(spec(vec![node("/a", &["sleep"])])).await;
    let ids = [stuck.id().to_owned(), sound.id().to_owned()];
    let shim = world.runtime(&ids[0]).shim.open_pidfd().unwrap().expect("it runs");
    send_signal(&shim, Signal::SIGSTOP);
    drop((stuck, sound));
    let engine = world.restart_engine();
    let adopted = with_timeout(engine.adopt()).await.unwrap();
    let [stuck, sound] = ids.map(|id| engine.servant(&id).expect("it is adopted"));
    wait_until_told(&*sound).await;
    assert_eq!((adopted.running.len(), adopted.ended.len()), (2, 0));
    assert_eq!(*stuck.state().borrow(), ContainerState::Creating);
    // It tells its state as soon as it can.
    send_signal(&shim, Signal::SIGCONT);
    wait_until_told(&*stuck).await;
    assert_eq!(stuck.nodes(), ["/a"]);
    world.stop(stuck).await;
    world.stop(sound).await;
}

#[tokio::test]
async fn user_ids_of_an_adopted_servant_are_given_to_no_other_although_its_lock_is_gone() {
    let place = tempfile::tempdir().unwrap();
    let locks = place.path().join("uid-ranges");
    // Far from the default range, so that no other lock file covers these ids.
    let world = World::with_config(|config| {
        config.uid_locks = locks.clone();
        config.uid_base = 0x7f00_0000;
    });
    let first = world.start(spec(vec![])).await;
    let uids = first.uid_range();
    drop(first);
    // As a cleanup of /run does when a service ends.
    std::fs::remove_file(&locks).unwrap();
    let engine = world.restart_engine();
    let first = world.adopt_single(&engine).await;
    let second = engine.start_container(spec(vec![])).await.unwrap();
    assert_eq!(first.uid_range(), uids);
    assert_ne!(second.uid_range(), uids);
    world.stop(first).await;
    world.stop(second).await;
}

#[tokio::test]
async fn what_cannot_be_removed_is_told_and_in_nobodys_way() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/a", &["sleep"])])).await;
    let id = servant.id().to_owned();
    drop(servant);
    let stray = world.servant_directory("x");
    std::fs::write(&stray, "somebody's").unwrap();
    let engine = world.restart_engine();
    let mut adopted = with_timeout(engine.adopt()).await.unwrap();
    let told: Vec<_> = adopted.failures.iter().map(ToString::to_string).collect();
    assert!(told.len() == 1 && told[0].contains(&*stray.to_string_lossy()), "{told:?}");
    assert_eq!(std::fs::read_to_string(&stray).unwrap(), "somebody's");
    let servant = adopted.running.pop().expect("the servant beside it");
    assert_eq!(servant.id(), id);
    world.stop(engine.servant(&id).expect("it is held")).await;
}

#[tokio::test]
async fn an_end_while_no_daemon_watched_is_told_and_swept() {
    let world = World::new();
    let mut required = node("/required", &["sleep"]);
    required.required = true;
    let spec = spec(vec![required]);
    let id = spec.id.clone();
    let servant = world.start(spec).await;
    let pid = processes(&servant, 1).await[0];
    let runtime = world.runtime(&id);
    let shim = runtime.shim.open_pidfd().unwrap().expect("it runs");
    drop(servant);
    kill(&servant::process::ProcessIdentity::from_pid(pid).unwrap().open_pidfd().unwrap().expect("it runs"));
    let mut watched = [nix::poll::PollFd::new(std::os::fd::AsFd::as_fd(&shim), nix::poll::PollFlags::POLLIN)];
    assert_eq!(nix::poll::poll(&mut watched, 20_000_u16).unwrap(), 1, "the shim ends with its servant");
    let engine = world.restart_engine();
    let adoption = with_timeout(engine.adopt()).await.unwrap();
    assert!(adoption.running.is_empty());
    assert!(world.servant_directory(&id).exists(), "robots wait for no removal");
    let failures = with_timeout(engine.sweep(&adoption.ended)).await;
    assert!(failures.is_empty(), "{failures:?}");
    assert!(adoption.failures.is_empty(), "{:?}", adoption.failures);
    assert_eq!(adoption.ended[0].id, id);
    let Some(ContainerState::Stopped { reason }) = &adoption.ended[0].state else { panic!("{:?}", adoption.ended) };
    assert!(reason.contains("/required was killed by signal 9"), "{reason}");
    world.assert_gone(&id, &runtime, &[pid]);
}

#[tokio::test]
async fn a_killed_shim_takes_its_servant_with_it_and_is_swept() {
    let world = World::new();
    let spec = spec(vec![node("/stubborn", &["stubborn"])]);
    let id = spec.id.clone();
    let servant = world.start(spec).await;
    let mut lines = servant.follow(LogStart::First);
    lines_until(&mut lines, |line| line.line == "stubborn").await;
    let processes = processes(&servant, 2).await;
    let runtime = world.runtime(&id);
    let nodes: Vec<_> =
        processes.iter().map(|pid| servant::process::ProcessIdentity::from_pid(*pid).unwrap()).collect();
    kill(&runtime.shim.open_pidfd().unwrap().expect("it runs"));
    let ContainerState::Failed { reason } = wait_until_ended(&*servant).await else { panic!("it did not fail") };
    assert!(reason.contains("shim was killed"), "{reason}");
    let error = servant.usage().await.unwrap_err().to_string();
    assert!(error.contains("shim was killed"), "{error}");
    drop(servant);
    // Init notices the end of the shim without a daemon.
    with_timeout(async {
        while nodes.iter().any(|node| node.open_pidfd().unwrap().is_some()) {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let engine = world.restart_engine();
    let adoption = with_timeout(engine.adopt()).await.unwrap();
    let failures = with_timeout(engine.sweep(&adoption.ended)).await;
    assert!(failures.is_empty(), "{failures:?}");
    assert!(adoption.failures.is_empty(), "{:?}", adoption.failures);
    assert_eq!(
        adoption.ended.iter().map(|ended| (ended.id.as_str(), ended.state.is_some())).collect::<Vec<_>>(),
        [(id.as_str(), false)]
    );
    world.assert_gone(&id, &runtime, &processes);
}

#[tokio::test]
async fn what_a_daemon_left_half_made_is_removed() {
    let world = World::new();
    std::fs::create_dir(world.servant_directory("half")).unwrap();
    std::fs::write(world.servant_directory("half").join("spec.json"), "{ \"half").unwrap();
    let adoption = with_timeout(world.engine.adopt()).await.unwrap();
    assert_eq!((adoption.ended.len(), adoption.failures.len()), (1, 0));
    assert!(with_timeout(world.engine.sweep(&adoption.ended)).await.is_empty());
    assert!(!world.servant_directory("half").exists());
}

#[tokio::test]
async fn a_pid_that_now_belongs_to_another_is_left_alone() {
    let world = World::new();
    let mut bystander = std::process::Command::new("cat").stdin(std::process::Stdio::piped()).spawn().unwrap();
    let spec = spec(vec![]);
    let id = spec.id.clone();
    let servant = world.start(spec).await;
    let mut runtime = world.runtime(&id);
    world.stop(servant).await;
    runtime.shim = servant::process::ProcessIdentity::from_pid(bystander.id() as i32).unwrap();
    // The same pid, but of a process with another start time.
    runtime.shim.start -= 1;
    std::fs::create_dir(world.servant_directory(&id)).unwrap();
    servant::launch::write_record(&world.servant_directory(&id).join(servant::launch::RUNTIME), &runtime).unwrap();
    let adoption = with_timeout(world.engine.adopt()).await.unwrap();
    assert_eq!(adoption.ended.len(), 1);
    with_timeout(world.engine.sweep(&adoption.ended)).await;
    assert!(bystander.try_wait().unwrap().is_none(), "it still runs");
    drop(bystander.stdin.take());
    bystander.wait().unwrap();
}
