//! Pictures of a camera in a servant's network, from a node and back to it, as fast as cameras make them.

use std::time::Duration;

use ros::bus::{Bus as _, Message, Qos, WireType, reaches};
use serde_json::json;
use tokio::time::timeout;

use super::lab::{LONG, Lab};

const PICTURES: usize = 30;

#[tokio::test]
async fn pictures_of_both_sizes_go_both_ways_whole_and_in_order() {
    let lab = Lab::new();
    let mut camera = lab.node("camera.py", &[]).await;
    let bus = lab.join("/cloudroid_bridge").await;
    let qos = Qos::keep_last(PICTURES);
    let heard = bus.subscribe("/picture", WireType::any(), qos).await;
    let mut heard = heard.unwrap();
    let connected = timeout(LONG, reaches(heard.matched.clone(), 1)).await;
    connected.expect("a camera");
    let mut back = None;
    for (width, height) in [(640, 480), (1920, 1080)] {
        camera
            .tell(&format!("show {width} {height} {PICTURES}"))
            .await;
        let mut pictures: Vec<Message> = Vec::new();
        while pictures.len() < PICTURES {
            let next = timeout(LONG, heard.messages.recv()).await;
            pictures.push(next.expect("in time").expect("the bus is open"));
        }
        // header { stamp { sec … } … } behind the four bytes that say how it is written.
        let number = |picture: &Message| {
            let word = picture.bytes[4..8].try_into().expect("four bytes");
            u32::from_le_bytes(word) as usize
        };
        assert!(pictures.iter().map(number).eq(0..PICTURES));
        assert!(
            pictures
                .iter()
                .all(|picture| picture.bytes.len() > width * height * 3)
        );
        camera.says("show").await;
        if back.is_none() {
            let of = WireType::clone(&pictures[0].wire_type);
            let publisher = bus.advertise("/seen", of, qos).await.unwrap();
            let connected = timeout(LONG, reaches(publisher.matched(), 1)).await;
            connected.expect("somebody who looks");
            back = Some(publisher);
        }
        let publisher = back.as_ref().expect("it was made");
        let mut clock = tokio::time::interval(Duration::from_secs(1) / 30);
        for picture in pictures {
            clock.tick().await;
            publisher.publish(picture.bytes);
        }
        let seen = camera.obey(&format!("count {PICTURES}")).await;
        assert_eq!(seen, [json!((0..PICTURES).collect::<Vec<_>>())]);
    }
}
