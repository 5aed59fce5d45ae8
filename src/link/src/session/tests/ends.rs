//! How connections and sessions end without the cooperation of the peer.

use super::*;

/// More than the buffers of a socket hold if nobody reads it.
const UNREAD_BYTES: usize = 4 << 20;

#[tokio::test]
async fn a_session_whose_connection_is_dropped_is_down() {
    let (robot, cloud) = (session(), session());
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    let mut up = robot.watch_up();
    tokio::select! {
        lost = robot.run(&mut at_robot, &nobody) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &nobody) => panic!("{lost}"),
        // Its borrows must not outlive the other values.
        () = async { drop(up.wait_for(|up| *up).await.unwrap()) } => {}
    }
    assert!(!robot.is_up() && !cloud.is_up());
}

#[tokio::test(start_paused = true)]
async fn a_session_ends_although_the_other_end_takes_nothing_any_more() {
    let (robot, cloud) = (session(), session());
    open(&robot, &cloud);
    let (mut at_robot, _at_cloud) = sockets();
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    robot.answer(1, 0, Ok(vec![0; UNREAD_BYTES].into()));
    let begun = Instant::now();
    let (lost, ()) = tokio::join!(robot.run(&mut at_robot, &nobody), async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        robot.close(1000, "the node has ended");
    });
    assert!(matches!(lost, DisconnectReason::Ended), "{lost}");
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
}

#[tokio::test(start_paused = true)]
async fn a_close_is_heard_though_whoever_sent_it_reads_nothing_any_more() {
    let (robot, cloud) = (session(), session());
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    robot.answer(1, 0, Ok(vec![0; UNREAD_BYTES].into()));
    let begun = Instant::now();
    let (lost, ()) = tokio::join!(robot.run(&mut at_robot, &nobody), async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        at_cloud.queue_close(1012, "the service moves");
        poll_fn(|cx| at_cloud.poll_flush(cx)).await.unwrap();
    });
    let DisconnectReason::Closed { code: 1012, reason } = lost else {
        panic!("{lost}");
    };
    assert_eq!(reason, "the service moves");
    assert!(begun.elapsed() < Duration::from_secs(5), "{:?}", begun.elapsed());
}
