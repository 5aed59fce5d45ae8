//! Shared memory, by which nodes of one servant may exchange messages (as Fast DDS does): separate for each servant,
//! and bounded.

use servant::engine::{LogStart, ServantHandle};
use servant::spec::NodeSpec;

use crate::support::*;

#[tokio::test]
async fn nodes_of_one_servant_share_memory_that_no_other_sees() {
    let world = World::new();
    // Two servants may have segments of the same name, as Fast DDS does.
    let name = format!("/servant-test-{}", std::process::id());
    let writes = |text: &str| node("/writes", &["share", &name, text]);
    let first = world.start(spec(vec![writes("of the first")])).await;
    let second = world.start(spec(vec![])).await;
    let mut lines = first.follow(LogStart::First);
    lines_until(&mut lines, |line| line.line == "shared").await;
    let reads = || -> NodeSpec { node("/reads", &["shared", &name]) };
    first.start_node(reads()).await.unwrap();
    let exit = with_timeout(first.wait_node("/reads")).await.unwrap();
    assert_eq!(exit.code, Some(0));
    let told = lines_until(&mut lines, |line| line.node == "/reads").await;
    assert_eq!(told.last().unwrap().line, "of the first");
    second.start_node(reads()).await.unwrap();
    let exit = with_timeout(second.wait_node("/reads")).await.unwrap();
    assert_eq!(exit.code, Some(libc::ENOENT));
    let of_host = std::path::Path::new("/dev/shm").join(name.trim_start_matches('/'));
    assert!(!of_host.exists(), "the host sees it");
    world.stop(first).await;
    world.stop(second).await;
}

#[tokio::test]
async fn shared_memory_counts_as_the_servants_and_ends_at_its_bound() {
    let world = World::new();
    world.require_controllers(&["memory"]);
    let mut spec = spec(vec![node("/fills", &["fill", "/dev/shm/piece", "24"])]);
    // Half of it is the limit of shared memory.
    spec.limits.memory = Some(servant::spec::Size(64 << 20));
    let servant = world.start(spec).await;
    let mut lines = servant.follow(LogStart::First);
    lines_until(&mut lines, |line| line.line == "filled").await;
    let usage = servant.usage().await.unwrap();
    assert!(usage.memory >= 24 << 20, "{usage:?}");
    let more = node("/more", &["fill", "/dev/shm/more", "9"]);
    servant.start_node(more).await.unwrap();
    let exit = with_timeout(servant.wait_node("/more")).await.unwrap();
    assert_eq!(exit.code, Some(libc::ENOSPC));
    world.stop(servant).await;
}
