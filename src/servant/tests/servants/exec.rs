//! Exec sessions: programs beside the nodes.

use std::collections::BTreeMap;

use api::exec::TerminalSize;
use servant::engine::ServantHandle;
use servant::exec::{ExecSession, ExecSpec, ExecStream};
use servant::local::LocalServant;

use crate::support::*;

fn program(words: &[&str]) -> ExecSpec {
    let argv = std::iter::once("/test-node").chain(words.iter().copied()).map(str::to_owned).collect();
    ExecSpec { argv, environment: BTreeMap::from([("ASKED".to_owned(), "yes".to_owned())]), terminal: false }
}

/// Reads a stream until these words have come, or its end.
async fn read_until(stream: &ExecStream, words: &str) -> String {
    let (mut text, mut block) = (String::new(), [0; 4096]);
    while !text.contains(words) {
        let length = with_timeout(stream.read(&mut block)).await.unwrap();
        if length == 0 {
            break;
        }
        text += std::str::from_utf8(&block[..length]).unwrap();
    }
    text
}

/// Waits until the servant has exactly so many processes.
async fn wait_for_processes(servant: &LocalServant, count: usize) {
    with_timeout(async {
        while processes(servant, 0).await.len() != count {
            tokio::task::yield_now().await;
        }
    })
    .await;
}

#[tokio::test]
async fn a_program_runs_beside_the_nodes_with_streams_of_its_own() {
    let world = World::new();
    let mut spec = spec(vec![node("/node", &["sleep"])]);
    spec.environment = BTreeMap::from([("SERVANTS".to_owned(), "own".to_owned())]);
    let servant = world.start(spec).await;
    let ExecSession { output, error, mut end, .. } = servant.exec(program(&["environment"]), None).await.unwrap();
    let printed = read_until(&output, "no such words").await;
    assert!(printed.contains(r#""ASKED": "yes""#) && printed.contains(r#""SERVANTS": "own""#), "{printed}");
    assert_eq!(read_until(&error.unwrap(), "no such words").await, "");
    assert_eq!(with_timeout(end.wait()).await, Some(0));
    let mut failed = servant.exec(program(&["exit", "7"]), None).await.unwrap();
    assert_eq!(with_timeout(failed.end.wait()).await, Some(7));
    let mut killed = servant.exec(program(&["die", "9"]), None).await.unwrap();
    assert_eq!(with_timeout(killed.end.wait()).await, Some(137));
    let missing = ExecSpec { argv: vec!["/missing".to_owned()], ..program(&[]) };
    let refused = servant.exec(missing, None).await.unwrap_err().to_string();
    assert!(refused.contains("could not be executed: No such file"), "{refused}");
    assert_eq!(servant.nodes(), ["/node"], "it is no node");
    world.stop(servant).await;
}

#[tokio::test]
async fn a_session_that_is_left_leaves_nothing_and_ends_with_its_servant() {
    let world = World::new();
    let first = world.start(spec(vec![node("/node", &["sleep"])])).await;
    drop(first);
    // The servant's shim serves the next daemon's sessions, too.
    let servant = world.adopt_single(&world.restart_engine()).await;
    let size = TerminalSize { columns: 80, rows: 24 };
    for terminal in [None, Some(size)] {
        let session = servant.exec(program(&["stubborn"]), terminal).await.unwrap();
        read_until(&session.output, "stubborn").await;
        // The program, its child and their supervisor.
        wait_for_processes(&servant, 4).await;
        drop(session);
        wait_for_processes(&servant, 1).await;
    }
    let mut session = servant.exec(program(&["stubborn"]), None).await.unwrap();
    read_until(&session.output, "stubborn").await;
    world.stop(servant).await;
    // Killed with its servant, or a moment before.
    let told = with_timeout(session.end.wait()).await;
    assert!(told.is_none_or(|status| status == 137), "{told:?}");
}

#[tokio::test]
async fn a_servant_has_so_many_sessions() {
    let world = World::new();
    let servant = world.start(spec(vec![])).await;
    let mut sessions = Vec::new();
    for _ in 0..16 {
        sessions.push(servant.exec(program(&["sleep"]), None).await.unwrap());
    }
    let refused = servant.exec(program(&["sleep"]), None).await.unwrap_err().to_string();
    assert!(refused.contains("which is the limit"), "{refused}");
    drop(sessions);
    wait_for_processes(&servant, 0).await;
    servant.exec(program(&["exit", "0"]), None).await.unwrap();
    world.stop(servant).await;
}
