//! Connections that move bytes, however slowly, and connections that only seem to.

use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};

use super::*;

/// A connection whose direction from the second end to the first carries 2 kB per second.
fn throttled_sockets() -> (WebSocket<DuplexStream>, WebSocket<DuplexStream>) {
    let (near, mut left) = duplex(1 << 10);
    let (mut right, far) = duplex(1 << 10);
    tokio::spawn(async move {
        let (mut from_near, mut to_near) = tokio::io::split(&mut left);
        let (mut from_far, mut to_far) = tokio::io::split(&mut right);
        let slowly = async {
            let mut buffer = [0; 200];
            loop {
                let read = from_far.read(&mut buffer).await?;
                tokio::time::sleep(Duration::from_millis(100)).await;
                to_near.write_all(&buffer[..read]).await?;
            }
        };
        let back = tokio::io::copy(&mut from_near, &mut to_far);
        let _: (std::io::Result<()>, _) = tokio::join!(slowly, back);
    });
    (WebSocket::client(near, b"", MAX_FRAME, MAX_RECORD, 7), WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD))
}

#[tokio::test(start_paused = true)]
async fn a_link_that_moves_bytes_is_up_however_long_a_message_takes() {
    let options = SessionOptions::for_silence(Duration::from_secs(1), None);
    let (robot, cloud) = (Session::new(options.clone()), Session::new(options.clone()));
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = throttled_sockets();
    let (to_robot, mut records) = mpsc::unbounded_channel();
    let (to_robot, nobody) = (RecordSender(to_robot), RecordSender(mpsc::unbounded_channel().0));
    // One WebSocket message, which takes longer than a silence after which the connection is closed; behind it wait the
    // answers to all pings.
    cloud.publish(data(1, 30_000), DeliveryMode::Newest);
    let begun = Instant::now();
    let (mut robot_up, mut cloud_up) = (robot.watch_up(), cloud.watch_up());
    let is_down = async {
        for up in [&mut robot_up, &mut cloud_up] {
            drop(up.wait_for(|up| *up).await.unwrap());
        }
        tokio::select! {
            down = robot_up.wait_for(|up| !*up) => drop(down.unwrap()),
            down = cloud_up.wait_for(|up| !*up) => drop(down.unwrap()),
        }
    };
    tokio::select! {
        lost = robot.run(&mut at_robot, &to_robot) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &nobody) => panic!("{lost}"),
        () = is_down => panic!("an end counts as silent after {:?}", begun.elapsed()),
        came = records.recv() => assert!(matches!(came, Some(Record::Data(_))), "{came:?}"),
    }
    assert!(begun.elapsed() > options.lost, "{:?}", begun.elapsed());
}

#[tokio::test(start_paused = true)]
async fn what_the_kernel_takes_for_a_peer_that_is_gone_is_no_sign_of_it() {
    let options = SessionOptions::for_silence(Duration::from_secs(1), None);
    let robot = Session::new(options.clone());
    robot.reconnect(0, &[], 1);
    let (near, _far) = duplex(64 << 20);
    let mut at_robot = WebSocket::client(near, b"", MAX_FRAME, MAX_RECORD, 7);
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    let publishing = async {
        loop {
            robot.publish(data(1, 10_000), DeliveryMode::Newest);
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
    };
    let begun = Instant::now();
    tokio::select! {
        lost = robot.run(&mut at_robot, &nobody) => assert!(matches!(lost, DisconnectReason::Silent(_)), "{lost}"),
        () = publishing => {}
    }
    let given_up = begun.elapsed();
    assert!(given_up >= options.lost && given_up <= options.lost + options.ping, "{given_up:?}");
}

#[tokio::test(start_paused = true)]
async fn a_peer_that_dribbles_holds_no_memory_beyond_the_time_for_a_message() {
    let unfinished = Duration::from_secs(300);
    let budget = Budget::new("robot x", 64 << 20);
    let cloud = Session::new(SessionOptions::for_silence(Duration::from_secs(7), None));
    cloud.reconnect(0, &[], 1);
    let (mut dribbling, far) = duplex(1 << 16);
    let mut at_cloud = WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD).with_budget(&budget, unfinished);
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    let dribble = async {
        // The header of a masked binary frame of 16 MiB (RFC 6455, section 5.2).
        dribbling.write_all(&[0x82, 0xff, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0]).await.unwrap();
        loop {
            dribbling.write_all(&[0]).await.unwrap();
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
    };
    let begun = Instant::now();
    let lost = tokio::select! {
        lost = cloud.run(&mut at_cloud, &nobody) => lost,
        () = dribble => panic!("it dribbles for ever"),
    };
    assert!(matches!(lost, DisconnectReason::Protocol(Error::Refused { code: 1008, .. })), "{lost}");
    assert!(begun.elapsed() < unfinished + Duration::from_secs(20), "{:?}", begun.elapsed());
    drop(at_cloud);
    assert_eq!(budget.used_bytes(), 0);
}

#[tokio::test]
async fn a_ping_is_answered_although_the_socket_takes_all_that_is_written() {
    const PICTURE: usize = 64 << 20;
    let robot = session();
    robot.reconnect(0, &[], 1);
    // Never full, as the connection to a peer that reads as fast as this end writes.
    let (near, far) = duplex(4 * PICTURE);
    let mut at_robot = WebSocket::client(near, b"", MAX_FRAME, MAX_RECORD, 7);
    let mut at_cloud = WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD);
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    robot.publish(data(1, PICTURE), DeliveryMode::Newest);
    at_cloud.queue(ws::frame::PING, Bytes::from_static(b"there?"));
    let answered = async {
        poll_fn(|cx| at_cloud.poll_flush(cx)).await.unwrap();
        loop {
            match poll_fn(|cx| at_cloud.poll_next(cx)).await.unwrap() {
                WsMessage::Pong(_) => return at_cloud.bytes_received() as usize,
                WsMessage::Binary(_) => {}
                other => panic!("{other:?}"),
            }
        }
    };
    // A task of its own: of two futures in one task, either may be starved by what the other has used of its budget.
    let running = tokio::spawn(async move { robot.run(&mut at_robot, &nobody).await });
    let behind = tokio::select! {
        lost = running => panic!("{lost:?}"),
        behind = answered => behind,
    };
    assert!(behind < PICTURE / 4, "the answer came behind {behind} bytes");
}

#[tokio::test(start_paused = true)]
async fn a_peer_that_sends_and_never_reads_makes_no_pile_of_signs() {
    let hour = Duration::from_secs(3600);
    let cloud = Session::new(SessionOptions { ping: hour, silent: hour, lost: 2 * hour, max_age: None });
    cloud.reconnect(0, &[], 1);
    // What is written is never read: after 16 bytes the rest stays in the queue.
    let (mut dribbling, far) = duplex(16);
    let mut at_cloud = WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD);
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    let dribble = async {
        dribbling.write_all(&[0x82, 0xff, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]).await.unwrap();
        for _ in 0..2000 {
            dribbling.write_all(&[0]).await.unwrap();
            tokio::time::sleep(Duration::from_millis(25)).await;
        }
    };
    tokio::select! {
        lost = cloud.run(&mut at_cloud, &nobody) => panic!("{lost}"),
        () = dribble => {}
    }
    assert!(at_cloud.bytes_queued() < 100, "{}", at_cloud.bytes_queued());
}
