//! The bridge's node is killed with the daemon and comes back: nodes must not wait for the dead one, whose lease has
//! not expired.

use std::sync::Arc;
use std::time::{Duration, Instant};

use async_trait::async_trait;
use bytes::Bytes;
use parking_lot::Mutex;
use ros::bus::{Bus as _, FailureReason, ServiceHandler};
use ros::ros2::Ros2Bus;
use ros::{JoinOptions, ParticipantPrefix, Succession};
use serde_json::{Value, json};
use tokio::sync::oneshot;
use tokio::time::timeout;

use super::lab::{LONG, Lab, Peer, cdr, set_bool, set_bool_type};

/// The record in a servant's directory.
#[derive(Debug, Default)]
struct ParticipantNotes(Mutex<Vec<ParticipantPrefix>>);

#[async_trait]
impl Succession for ParticipantNotes {
    async fn record_join(&self, _node: &str, participant: ParticipantPrefix) -> Vec<ParticipantPrefix> {
        let mut noted = self.0.lock();
        let earlier = noted.clone();
        noted.push(participant);
        earlier
    }
}

/// Returns its name.
struct NamedService(&'static str);

#[async_trait]
impl ServiceHandler for NamedService {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        let answer = format!(r#"{{"success":true,"message":"{}"}}"#, self.0);
        Ok(cdr(&set_bool().response, &answer))
    }
}

async fn join(lab: &Lab, notes: &Arc<ParticipantNotes>) -> Arc<Ros2Bus> {
    let options =
        JoinOptions { succession: Some(Arc::clone(notes) as _), ..JoinOptions::in_domain(0, "/cloudroid_bridge") };
    lab.join_with(options).await
}

/// Starts a node of ours that serves `/ask` until the returned function kills it, after which nothing of it runs and it
/// sends no farewell.
fn start_mortal(lab: &Lab, notes: &Arc<ParticipantNotes>) -> impl FnOnce() {
    let (kill, killed) = oneshot::channel();
    let network = Arc::clone(&lab.network);
    let notes = Arc::clone(notes);
    let lives = std::thread::spawn(move || {
        let lab = Lab { network };
        let mut runtime = tokio::runtime::Builder::new_current_thread();
        let runtime = runtime.enable_all().build().expect("a runtime");
        runtime.block_on(async {
            let bus = join(&lab, &notes).await;
            let served = bus.serve("/ask", set_bool_type(), Arc::new(NamedService("first")));
            let served = served.await.unwrap();
            let _ = killed.await;
            // Dropping them would announce their departure.
            std::mem::forget((bus, served));
        });
        std::mem::forget(runtime);
    });
    move || {
        let _ = kill.send(());
        lives.join().expect("it served");
    }
}

async fn expect_answer(peer: &mut Peer) -> [Value; 2] {
    let answer = peer.obey("call true").await;
    let (_, last) = answer.split_last_chunk().expect("an answer");
    last.clone()
}

async fn a_killed_daemon_is_not_waited_for(program: &str) {
    let lab = Lab::new();
    let mut peer = lab.node(program, &[]).await;
    let notes = Arc::default();
    let kill = start_mortal(&lab, &notes);
    assert_eq!(expect_answer(&mut peer).await, [json!(true), json!("first")]);
    kill();
    assert_eq!(peer.obey("served").await, [json!(true)]);
    let begun = Instant::now();
    let second = join(&lab, &notes).await;
    let gone = async {
        while peer.obey("served").await != [json!(false)] {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    timeout(LONG, gone).await.expect("in time");
    // The lease is 10 s and was renewed less than 4 s ago.
    let after = begun.elapsed();
    assert!(after < Duration::from_secs(4), "{after:?}");
    let served = second.serve("/ask", set_bool_type(), Arc::new(NamedService("second")));
    let _served = served.await.unwrap();
    assert_eq!(expect_answer(&mut peer).await, [json!(true), json!("second")]);
}

#[tokio::test]
async fn a_node_of_rclpy_calls_whoever_comes_in_the_place_of_one_that_was_killed() {
    a_killed_daemon_is_not_waited_for("peer.py").await;
}

#[tokio::test]
async fn a_participant_of_cyclone_calls_whoever_comes_in_the_place_of_one_that_was_killed() {
    a_killed_daemon_is_not_waited_for("cyclone.py").await;
}
