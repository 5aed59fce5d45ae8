//! The end of a stub that was told to end: what is waited for then, and for how long.
//!
//! | what | at most |
//! |---|---|
//! | the real node ends, too, and its exit status is the stub's; while the cloud gives signs of itself | 12 s |
//! | a sign of the cloud, asked for again and again | 2 s |
//! | the robot's nodes take what they were sent, and the cloud is told that nobody comes back | 2 s |
//!
//! So a stub whose daemon, servant or network is gone ends within 4 s, below the 5 s after which launch (ROS 2) sends a second signal, and the 15 s of
//! roslaunch. A second signal ends the first wait at once.

use std::sync::Arc;
use std::time::Duration;

use futures_util::future::{FusedFuture, join_all};
use link::control::{Exit, FromRobot};
use ros::bus::Bus;
use tokio::time::{sleep, timeout};

use crate::mirror::Mirror;

/// For the real node to end after it was told to. roslaunch escalates after 15 s.
const NODE: Duration = Duration::from_secs(12);
/// For a sign of the cloud after it was asked for one.
const SIGN: Duration = Duration::from_millis(1500);
/// Between a sign and the next question.
const PAUSE: Duration = Duration::from_millis(500);
/// For the cloud to be told.
const TOLD: Duration = Duration::from_millis(500);

/// Tells the real node by this signal; how it has ended, unless the cloud is gone, or something else ends the wait: `other`.
pub async fn of_the_node(
    mirror: &Mirror,
    signal: i32,
    other: impl Future<Output = ()>,
) -> Option<Exit> {
    if let Some(keeper) = mirror.keeper() {
        keeper.end();
    }
    let session = mirror.session();
    session.report(&FromRobot::Signal { signal });
    if !session.is_up() {
        return None;
    }
    let mut exit = mirror.exit();
    tokio::select! {
        ended = exit.wait_for(Option::is_some) => ended.ok()?.clone(),
        () = silence(mirror) => None,
        () = sleep(NODE) => None,
        () = other => None,
    }
}

/// Returns when the cloud gives no sign any more.
async fn silence(mirror: &Mirror) {
    while mirror.session().is_there(SIGN).await {
        sleep(PAUSE).await;
    }
}

/// Says good-bye to both sides: what the robot's nodes were sent reaches them, and the cloud ends what is left of the node at once. `linked` carries the
/// link, unless it has ended.
pub async fn of_all(mirror: &Mirror, linked: impl FusedFuture, buses: &[Arc<dyn Bus>]) {
    let session = mirror.session();
    session.end(1000, "the robot's node ended");
    let told = async {
        if session.is_up() && !linked.is_terminated() {
            let _ = timeout(TOLD, linked).await;
        }
    };
    tokio::join!(told, of_the_robot(buses));
}

/// Leaves the robot's ROS; each bus waits 2 s at most for what is on its way.
pub async fn of_the_robot(buses: &[Arc<dyn Bus>]) {
    join_all(buses.iter().map(|bus| bus.close())).await;
}
