//! Output of nodes arrives in the log.

use api::KeptLog;
use servant::engine::{Engine, LogStart, ServantHandle};

use crate::support::*;

#[tokio::test]
async fn every_line_arrives_once_and_in_order() {
    const LINES: u64 = 200_000;
    // More than the default burst.
    let world = World::with_config(|config| config.quotas.log_rate = u64::MAX);
    let servant = world.start(spec(vec![node("/talks", &["print", &LINES.to_string()])])).await;
    let mut lines = servant.follow(LogStart::First);
    let reader = tokio::spawn(async move {
        let mut expected = 0;
        while let Some(line) = lines.recv().await {
            assert_eq!(line.line, expected.to_string());
            expected += 1;
        }
        expected
    });
    assert_eq!(with_timeout(servant.wait_node("/talks")).await.unwrap().code, Some(0));
    let log = world.servant_directory(servant.id()).join(servant::logs::FILE);
    assert!(log.exists());
    world.stop(servant).await;
    assert_eq!(with_timeout(reader).await.unwrap(), LINES, "also what was read after the end");
}

#[tokio::test]
async fn a_follower_from_now_on_sees_only_what_comes() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/early", &["print", "10"])])).await;
    let mut all = servant.follow(LogStart::First);
    lines_until(&mut all, |line| line.line == "9").await;
    let mut late = servant.follow(LogStart::Now);
    servant.start_node(node("/late", &["print", "2"])).await.unwrap();
    let seen = lines_until(&mut late, |line| line.line == "1").await;
    assert!(seen.iter().all(|line| line.node == "/late" && line.stream == "stdout"), "{seen:?}");
    world.stop(servant).await;
}

#[tokio::test]
async fn a_kept_log_is_read_when_its_servant_is_gone() {
    let world = World::new();
    let servant = world.start(spec(vec![node("/talks", &["print", "3"])])).await;
    assert_eq!(with_timeout(servant.wait_node("/talks")).await.unwrap().code, Some(0));
    let id = servant.id().to_owned();
    let about = KeptLog {
        servant: id.clone(),
        service: "talks".into(),
        revision: 1,
        robot: "rover".into(),
        created: 1,
        ended: 2,
        failed: false,
        reason: "it was stopped".into(),
        bytes: api::Size(0),
    };
    let kept = with_timeout(servant.keep_log(about)).await.unwrap();
    assert!(kept.bytes > api::Size(0), "{kept:?}");
    world.stop(servant).await;
    let engine = world.restart_engine();
    assert_eq!(engine.kept_logs().await.unwrap(), [kept]);
    let lines = engine.read_kept_log(&id, 2).await;
    assert_eq!(lines.iter().map(|line| &*line.line).collect::<Vec<_>>(), ["1", "2"]);
    let failures = engine.remove_kept_logs(vec![id.clone()]).await;
    assert!(failures.is_empty(), "{failures:?}");
    assert!(engine.read_kept_log(&id, 2).await.is_empty());
    assert!(engine.kept_logs().await.unwrap().is_empty());
}
