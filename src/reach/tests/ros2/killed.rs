//! A node that is killed while it publishes images, in a servant's environment.

use std::time::Duration;

use budget::Budget;
use ros::JoinOptions;
use ros::bus::{Bus as _, QosProfile, Subscription};
use tokio::time::timeout;

use super::lab::{LONG, Lab, string_type, wait_graph};

/// Room for some images of 6 MB.
const LIMIT: usize = 64 << 20;

async fn picture(pictures: &mut Subscription) {
    let next = timeout(LONG, pictures.messages.recv()).await;
    let picture = next.expect("in time").expect("the bus is open");
    assert!(picture.bytes.len() > 6_000_000);
}

async fn soon(what: &str, mut holds: impl FnMut() -> bool) {
    let waits = async {
        while !holds() {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    };
    let came = timeout(LONG, waits).await;
    came.unwrap_or_else(|_| panic!("{what}"));
}

#[tokio::test]
async fn a_node_that_is_killed_amid_a_picture_is_gone_with_what_it_began() {
    let lab = Lab::new();
    let budget = Budget::new("samples", LIMIT);
    let options = JoinOptions { budget: budget.clone(), ..JoinOptions::in_domain(0, "/cloudroid_bridge") };
    let bus = lab.join_with(options).await;
    let of = string_type();
    let heard = bus.subscribe("/picture", of, QosProfile::keep_last(1)).await;
    let mut pictures = heard.unwrap();
    for _ in 0..2 {
        let mut painter = lab.node("painter.py", &[]).await;
        picture(&mut pictures).await;
        picture(&mut pictures).await;
        soon("a part of one should come", || budget.used_bytes() != 0).await;
        painter.kill_and_wait().await;
        bus.on_process_exit();
        let matched = pictures.matched.clone();
        soon("it should be gone", || matched.borrow().peers.is_empty()).await;
        wait_graph(&bus, |graph| !graph.nodes.contains_key("/painter")).await;
        // Complete images are delivered, and nothing of the incomplete one is kept.
        soon("nothing should be kept", || {
            while pictures.messages.try_recv().is_some() {}
            budget.used_bytes() == 0
        })
        .await;
    }
}
