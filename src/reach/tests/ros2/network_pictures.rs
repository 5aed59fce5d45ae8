//! Images sent to another machine, whose receive buffers cannot be queried.

use std::time::Duration;

use ros::bus::{Bus, QosProfile, QosReliability, wait_for_connected};
use tokio::time::timeout;

use super::lab::{LONG, string_message, string_type};
use super::network::{machines, robot_network};

/// Size of an image of 640 by 480 pixels.
const BYTES: usize = 921_600;
const PICTURES: u64 = 60;

async fn count_received(reliability: QosReliability) -> u64 {
    let (robot, other) = machines();
    let wish = match reliability {
        QosReliability::Reliable => "reliable",
        QosReliability::BestEffort => "best_effort",
    };
    let mut viewer = other.node("network_pictures.py", &[wish]).await;
    let bus = robot.join_network("/cloudroid_bridge", robot_network()).await;
    let qos = QosProfile {
        reliability,
        // None is replaced by a later one.
        ..QosProfile::keep_last(PICTURES as usize)
    };
    let out = bus.advertise("/picture", string_type(), qos).await.unwrap();
    timeout(LONG, wait_for_connected(out.matched_subscribers(), 1)).await.expect("a viewer");
    let fill = "x".repeat(BYTES);
    let mut camera = tokio::time::interval(Duration::from_secs(1) / 30);
    for number in 0..PICTURES {
        camera.tick().await;
        out.publish(string_message(&format!("{number} {fill}")));
    }
    let told = viewer.obey(&format!("count {PICTURES}")).await;
    assert_eq!(told[1], true, "in order");
    told[0].as_u64().expect("a number")
}

#[tokio::test]
async fn all_come_where_that_is_asked_for() {
    let came = count_received(QosReliability::Reliable).await;
    assert_eq!(came, PICTURES);
}

#[tokio::test]
async fn most_come_where_it_is_not() {
    // A receiver delayed on a busy machine loses what its buffers have no room for, whoever the sender is; therefore
    // one in three is enough.
    let mut came = [0; 3];
    for (turn, count) in came.iter_mut().enumerate() {
        *count = count_received(QosReliability::BestEffort).await;
        if *count >= PICTURES / 2 {
            return;
        }
        eprintln!("turn {turn}: {count} of {PICTURES}");
    }
    panic!("{came:?} of {PICTURES}");
}
