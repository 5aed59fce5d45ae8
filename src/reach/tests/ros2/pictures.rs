//! Camera images in a servant's network, from a node and back to it, at the rate of a camera.

use std::time::Duration;

use ros::bus::{Bus as _, QosProfile, SerializedMessage, WireType, wait_for_connected};
use serde_json::json;
use tokio::time::timeout;

use super::lab::{LONG, Lab};

/// A writer keeps 64 MiB for a slow reader, as on a busy machine; this many of the larger images.
const AT_ONCE: usize = 10;
const ROUNDS: usize = 3;

#[tokio::test]
async fn pictures_of_both_sizes_go_both_ways_whole_and_in_order() {
    let lab = Lab::new();
    let mut camera = lab.node("camera.py", &[]).await;
    let bus = lab.join("/cloudroid_bridge").await;
    let qos = QosProfile::keep_last(AT_ONCE);
    let heard = bus.subscribe("/picture", WireType::any(), qos).await;
    let mut heard = heard.unwrap();
    let connected = timeout(LONG, wait_for_connected(heard.matched.clone(), 1)).await;
    connected.expect("a camera");
    let mut back = None;
    let sizes = [(640, 480), (1920, 1080)];
    for (width, height) in sizes.into_iter().flat_map(|size| [size; ROUNDS]) {
        camera.tell(&format!("show {width} {height} {AT_ONCE}")).await;
        let mut pictures: Vec<SerializedMessage> = Vec::new();
        while pictures.len() < AT_ONCE {
            let next = timeout(LONG, heard.messages.recv()).await;
            pictures.push(next.expect("in time").expect("the bus is open"));
        }
        // header { stamp { sec … } … } after the four bytes of the CDR header.
        let number = |picture: &SerializedMessage| {
            let word = picture.bytes[4..8].try_into().expect("four bytes");
            u32::from_le_bytes(word) as usize
        };
        assert!(pictures.iter().map(number).eq(0..AT_ONCE));
        assert!(pictures.iter().all(|picture| picture.bytes.len() > width * height * 3));
        camera.wait_for("show").await;
        if back.is_none() {
            let of = WireType::clone(&pictures[0].wire_type);
            let publisher = bus.advertise("/seen", of, qos).await.unwrap();
            let connected = timeout(LONG, wait_for_connected(publisher.matched_subscribers(), 1)).await;
            connected.expect("somebody who looks");
            back = Some(publisher);
        }
        let publisher = back.as_ref().expect("it was made");
        let mut clock = tokio::time::interval(Duration::from_secs(1) / 30);
        for picture in pictures {
            clock.tick().await;
            publisher.publish(picture.bytes);
        }
        let seen = camera.obey(&format!("count {AT_ONCE}")).await;
        assert_eq!(seen, [json!((0..AT_ONCE).collect::<Vec<_>>())]);
    }
}
