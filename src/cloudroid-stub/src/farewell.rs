//! The end of a stub that was told to end, with its time limits.
//!
//! | step | limit |
//! |---|---|
//! | the real node ends, too, and its exit status becomes the stub's, as long as the cloud responds | 12 s |
//! | a response of the cloud to each repeated ping | 2 s |
//! | the robot's nodes receive what they were sent, and the cloud is told that the stub does not return | 2 s |
//!
//! So a stub whose daemon, servant or network is gone ends within 4 s: before launch (ROS 2) sends a second signal
//! after 5 s, and before the 15 s of roslaunch. A second signal ends the first wait at once.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::{FusedFuture, join_all};
use link::control::{Exit, FromRobot};
use ros::bus::Bus;
use tokio::time::{sleep, timeout};

use crate::mirror::Mirror;

/// Time allowed for the real node to end after the signal. roslaunch escalates after 15 s.
const NODE: Duration = Duration::from_secs(12);
/// Time allowed for the cloud to respond to a ping.
const SIGN: Duration = Duration::from_millis(1500);
/// Pause between a response and the next ping.
const PAUSE: Duration = Duration::from_millis(500);
/// Time allowed for telling the cloud that the stub ends.
const FAREWELL_TIMEOUT: Duration = Duration::from_millis(500);

/// Sends this signal to the real node and returns its exit, unless the cloud stops responding or `other` ends the wait.
pub async fn stop_node(mirror: &Mirror, signal: i32, other: impl Future<Output = ()>) -> Option<Exit> {
    if let Some(keeper) = mirror.keeper() {
        keeper.end();
    }
    let session = mirror.session();
    session.send_control(&FromRobot::Signal { signal });
    if !session.is_up() {
        return None;
    }
    let mut exit = mirror.exit();
    tokio::select! {
        ended = exit.wait_for(Option::is_some) => ended.ok()?.clone(),
        () = wait_for_silence(mirror) => None,
        () = sleep(NODE) => None,
        () = other => None,
    }
}

/// Returns when the cloud stops responding.
async fn wait_for_silence(mirror: &Mirror) {
    while mirror.session().probe(SIGN).await {
        sleep(PAUSE).await;
    }
}

/// Leaves both sides: the robot's nodes receive what they were sent, and the cloud ends what is left of the node at
/// once. `linked` carries the link, unless it has ended.
pub async fn close_all(mirror: &Mirror, linked: impl FusedFuture, buses: &[Arc<dyn Bus>]) {
    let session = mirror.session();
    session.close(1000, "the robot's node ended");
    let told = async {
        if session.is_up() && !linked.is_terminated() {
            let _ = timeout(FAREWELL_TIMEOUT, linked).await;
        }
    };
    tokio::join!(told, close_buses(buses));
}

/// Leaves the robot's ROS system; each bus waits at most 2 s for pending messages.
pub async fn close_buses(buses: &[Arc<dyn Bus>]) {
    join_all(buses.iter().map(|bus| bus.close())).await;
}
