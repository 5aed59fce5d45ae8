use std::future::poll_fn;
use std::sync::Arc;

use tokio::io::duplex;
use tokio::sync::mpsc;
use ws::{WebSocket, WsMessage};

use super::*;
use crate::frame::Frame;
use crate::{MAX_FRAME, MAX_RECORD};

mod ends;
mod lanes;
mod slow;

/// Either end; the type of its control messages does not matter here.
type Session = RobotSession;

struct RecordSender(mpsc::UnboundedSender<Record<FromCloud>>);

impl SessionHandler<FromCloud> for RecordSender {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        let _ = self.0.send(record);
    }
}

fn session() -> Arc<Session> {
    Arc::new(Session::new(SessionOptions {
        ping: Duration::from_millis(50),
        silent: Duration::from_millis(500),
        lost: Duration::from_secs(60),
        max_age: None,
    }))
}

fn sockets() -> (WebSocket<tokio::io::DuplexStream>, WebSocket<tokio::io::DuplexStream>) {
    let (robot, cloud) = duplex(1 << 16);
    (WebSocket::client(robot, b"", MAX_FRAME, MAX_RECORD, 7), WebSocket::new(cloud, b"", MAX_FRAME, MAX_RECORD))
}

fn data(channel: u32, size: usize) -> Data {
    Data {
        channel,
        encoded: false,
        latching: false,
        born: now(),
        left: 0,
        serialise: 0,
        answered: None,
        message: Bytes::from(vec![1; size]),
    }
}

/// Exchanges what each end has received, as hello and welcome do.
fn open(robot: &Session, cloud: &Session) {
    let (robot_has, robot_ahead, robot_next) = robot.position();
    let (cloud_has, cloud_ahead, cloud_next) = cloud.position();
    robot.reconnect(cloud_has, &cloud_ahead, cloud_next);
    cloud.reconnect(robot_has, &robot_ahead, robot_next);
}

#[tokio::test]
async fn calls_are_answered_once_however_often_the_link_is_cut() {
    let (robot, cloud) = (session(), session());
    let (to_robot, mut answers) = mpsc::unbounded_channel();
    let (to_cloud, mut calls) = mpsc::unbounded_channel();
    const CALLS: u32 = 2000;
    let serving = cloud.clone();
    tokio::spawn(async move {
        while let Some(record) = calls.recv().await {
            if let Record::Call(Call { id, request, .. }) = record {
                serving.answer(id, 0, Ok(request));
            }
        }
    });
    let calling = robot.clone();
    tokio::spawn(async move {
        for n in 0..CALLS {
            let request = if n % 100 == 0 { 100_000 } else { 10 };
            calling.call(1, vec![0; request].into());
            calling.publish(data(1, 50_000), DeliveryMode::Newest);
            tokio::task::yield_now().await;
        }
    });
    let asking = robot.clone();
    let collected = tokio::spawn(async move {
        let mut ids = Vec::new();
        while ids.len() < CALLS as usize {
            match answers.recv().await {
                Some(Record::Answer { id, .. }) => ids.push(id),
                _ => break,
            }
        }
        // Duplicate responses arrive before the response to the current call.
        let last = asking.call(1, Bytes::new());
        while let Some(record) = answers.recv().await {
            match record {
                Record::Answer { id, .. } if id == last => break,
                Record::Answer { id, .. } => ids.push(id),
                _ => {}
            }
        }
        ids
    });
    let mut round = 0_u64;
    while !collected.is_finished() {
        open(&robot, &cloud);
        let (mut at_robot, mut at_cloud) = sockets();
        let (to_robot, to_cloud) = (RecordSender(to_robot.clone()), RecordSender(to_cloud.clone()));
        let both = async { tokio::join!(robot.run(&mut at_robot, &to_robot), cloud.run(&mut at_cloud, &to_cloud)) };
        // Cut at an arbitrary point, later each time, because a busy machine may transfer almost nothing at first.
        round += 1;
        let later = Duration::from_micros(300 * (round % 40 + 1)) * (1 + round as u32 / 100);
        let _ = tokio::time::timeout(later, both).await;
    }
    let mut ids = collected.await.unwrap();
    ids.sort_unstable();
    assert_eq!(ids.len(), CALLS as usize);
    ids.dedup();
    assert_eq!(ids.len(), CALLS as usize);
}

#[tokio::test]
async fn a_peer_gives_a_sign_when_it_is_asked_for_one() {
    let quiet = || {
        let seldom = SessionOptions::for_silence(Duration::from_secs(600), None);
        Arc::new(Session::new(SessionOptions { ping: Duration::from_secs(600), ..seldom }))
    };
    let (robot, cloud) = (quiet(), quiet());
    let nobody = RecordSender(mpsc::unbounded_channel().0);
    let limit = Duration::from_millis(200);
    assert!(!robot.probe(limit).await, "there is no connection");
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    let asking = async {
        // The initial pings are over.
        while *robot.pongs.borrow() < 6 {
            tokio::task::yield_now().await;
        }
        for _ in 0..3 {
            assert!(robot.probe(Duration::from_secs(60)).await);
        }
    };
    tokio::select! {
        lost = robot.run(&mut at_robot, &nobody) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &nobody) => panic!("{lost}"),
        () = asking => {}
    }
    // The peer holds the connection but sends nothing any more. Earlier pongs may still be in flight.
    let asking = async { while robot.probe(limit).await {} };
    tokio::select! {
        lost = robot.run(&mut at_robot, &nobody) => panic!("{lost}"),
        silent = timeout(Duration::from_secs(60), asking) => silent.expect("it gives no sign any more"),
    }
}

#[tokio::test]
async fn a_link_that_has_carried_four_billion_records_is_not_deaf() {
    let (robot, cloud) = (session(), session());
    for side in [&robot, &cloud] {
        side.begin_at(u64::from(u32::MAX) - 10);
    }
    let (to_robot, mut answers) = mpsc::unbounded_channel();
    let (to_cloud, mut calls) = mpsc::unbounded_channel();
    let (to_robot, to_cloud) = (RecordSender(to_robot), RecordSender(to_cloud));
    open(&robot, &cloud);
    // Over two connections, because the numbers are also exchanged at their beginning.
    for connection in 0..2 {
        let (mut at_robot, mut at_cloud) = sockets();
        let asking = async {
            for _ in 0..20 {
                let id = robot.call(1, Bytes::from_static(b"asked"));
                let Some(Record::Call(Call { id: asked, .. })) = calls.recv().await else {
                    panic!("a call should come");
                };
                cloud.answer(asked, 0, Ok(Bytes::new()));
                let answer = answers.recv().await;
                assert!(matches!(answer, Some(Record::Answer { id: answered, .. }) if answered == id), "{answer:?}");
            }
        };
        tokio::select! {
            lost = robot.run(&mut at_robot, &to_robot) => panic!("{lost}"),
            lost = cloud.run(&mut at_cloud, &to_cloud) => panic!("{lost}"),
            done = tokio::time::timeout(Duration::from_secs(60), asking) => {
                done.unwrap_or_else(|_| panic!("connection {connection} is deaf"));
            }
        }
        open(&robot, &cloud);
    }
    assert!(robot.position().2 > 1 << 32, "the numbers have passed 2^32");
}

/// A peer whose clock is `ahead` nanoseconds ahead of this machine's. It answers three pings and then stays connected
/// silently.
async fn answers_ahead(socket: &mut WebSocket<tokio::io::DuplexStream>, ahead: i64) {
    let mut pongs = 0;
    while pongs < 3 {
        let message = poll_fn(|cx| socket.poll_next(cx)).await.unwrap();
        let WsMessage::Binary(bytes) = message else { panic!("{message:?}") };
        let arrived = now() + ahead;
        let Frame::Ping { sent, received } = Frame::decode(bytes).unwrap() else {
            continue;
        };
        let pong = Frame::Pong { sent, arrived, left: now() + ahead, received };
        socket.queue(ws::frame::BINARY, pong.encode());
        poll_fn(|cx| socket.poll_flush(cx)).await.unwrap();
        pongs += 1;
    }
}

#[tokio::test]
async fn a_clock_an_hour_ahead_is_measured_and_a_silent_peer_is_noticed() {
    const HOUR: i64 = 3600 * 1_000_000_000;
    let (robot, cloud) = (session(), session());
    let (sender, _records) = mpsc::unbounded_channel();
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    let mut up = robot.watch_up();
    let to_robot = RecordSender(sender);
    let running = robot.run(&mut at_robot, &to_robot);
    tokio::select! {
        lost = running => panic!("{lost}"),
        () = async {
            let is_up = async { up.wait_for(|up| *up).await.map(drop).unwrap() };
            tokio::join!(answers_ahead(&mut at_cloud, HOUR), is_up);
            // Still connected, but silent.
            up.wait_for(|up| !*up).await.unwrap();
        } => {}
    }
    let sample = robot.clock().unwrap();
    assert!((sample.offset - HOUR).abs() <= sample.delay / 2 + 1, "{sample:?}");
}

/// Measures a link that silently carries nothing any more: the time until it is detected, and the time until the
/// connection is closed.
async fn measure_detection(options: SessionOptions) -> (Duration, Duration) {
    let max = options.silent;
    let (robot, cloud) = (Session::new(options), session());
    let (sender, _records) = mpsc::unbounded_channel();
    let (to_robot, to_cloud) = (RecordSender(sender.clone()), RecordSender(sender));
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    let mut up = robot.watch_up();
    let running = robot.run(&mut at_robot, &to_robot);
    let watching = async {
        // The link works for a while; then, between two pings, the peer stops answering.
        tokio::select! {
            lost = cloud.run(&mut at_cloud, &to_cloud) => panic!("{lost}"),
            () = tokio::time::sleep(max * 7 + max / 3) => {}
        }
        let cut = Instant::now();
        assert!(*up.borrow_and_update(), "it was there all the time");
        up.wait_for(|up| !*up).await.unwrap();
        (cut, cut.elapsed())
    };
    let (lost, (cut, noticed)) = tokio::join!(running, watching);
    assert!(matches!(lost, DisconnectReason::Silent(_)), "{lost}");
    (noticed, cut.elapsed())
}

#[tokio::test(start_paused = true)]
async fn a_silent_link_is_noticed_within_t_max() {
    for milliseconds in [50, 100, 300, 500, 1000, 2000, 10_000] {
        let max = Duration::from_millis(milliseconds);
        let options = SessionOptions::for_silence(max, None);
        let (ping, lost) = (options.ping, options.lost);
        let (noticed, given_up) = measure_detection(options).await;
        assert!(noticed <= max, "{noticed:?} for {max:?}");
        // Silence is measured from the last message, which was at most a ping before the cut.
        assert!(given_up <= lost && given_up + ping >= lost, "{given_up:?} for {max:?}: {ping:?}, {lost:?}");
    }
}

#[tokio::test]
async fn a_call_is_not_lost_when_a_welcome_is() {
    let (robot, cloud) = (session(), session());
    let (to_robot, _answers) = mpsc::unbounded_channel();
    let (to_cloud, mut calls) = mpsc::unbounded_channel();
    let (to_robot, to_cloud) = (RecordSender(to_robot), RecordSender(to_cloud));
    robot.call(1, Bytes::from_static(b"asked"));
    // It is sent and not received.
    open(&robot, &cloud);
    let (mut at_robot, at_cloud) = sockets();
    let gone = robot.run(&mut at_robot, &to_robot);
    let _ = tokio::time::timeout(Duration::from_millis(20), gone).await;
    drop(at_cloud);
    // The cloud receives a hello and its welcome is lost; the next one is not.
    let (has, ahead, next) = robot.position();
    cloud.reconnect(has, &ahead, next);
    open(&robot, &cloud);
    let (mut at_robot, mut at_cloud) = sockets();
    tokio::select! {
        lost = robot.run(&mut at_robot, &to_robot) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &to_cloud) => panic!("{lost}"),
        call = calls.recv() => assert!(matches!(call, Some(Record::Call(_))), "{call:?}"),
        () = tokio::time::sleep(Duration::from_secs(60)) => panic!("the call was lost"),
    }
}

/// A compressible image.
fn picture(number: u8) -> Bytes {
    let mut message = vec![number, 0, 0, 0];
    message.extend([0; 8]);
    message.extend([0; 4]);
    for word in [120_u32, 160] {
        message.extend(word.to_le_bytes());
    }
    message.extend(4_u32.to_le_bytes());
    message.extend(b"rgb8");
    message.push(0);
    message.extend(480_u32.to_le_bytes());
    message.extend(57_600_u32.to_le_bytes());
    message.extend((0..57_600_u32).map(|at| (at / 480) as u8 ^ number));
    message.into()
}

#[tokio::test]
async fn over_a_slow_link_pictures_are_made_smaller_and_arrive_as_they_were() {
    let (robot, cloud) = (session(), session());
    let codecs = crate::packing::supported_codecs(|_| false);
    robot.set_peer_codecs(&codecs, None);
    cloud.set_peer_codecs(&codecs, None);
    robot.open_channel(1, "/image", codec::Schema::Image);
    open(&robot, &cloud);
    let (near, mut slow) = duplex(1 << 12);
    let (mut slower, far) = duplex(1 << 12);
    let mut at_robot = WebSocket::client(near, b"", MAX_FRAME, MAX_RECORD, 7);
    let mut at_cloud = WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD);
    // Some MB/s: what is in the pipe is forwarded every millisecond.
    tokio::spawn(async move {
        let (mut up, mut down) = tokio::io::split(&mut slow);
        let (mut from, mut to) = tokio::io::split(&mut slower);
        let upwards = async {
            let mut buffer = vec![0; 4096];
            loop {
                let read = tokio::io::AsyncReadExt::read(&mut up, &mut buffer).await?;
                tokio::time::sleep(Duration::from_millis(1)).await;
                tokio::io::AsyncWriteExt::write_all(&mut to, &buffer[..read]).await?;
            }
        };
        let back = tokio::io::copy(&mut from, &mut down);
        let _: (std::io::Result<()>, _) = tokio::join!(upwards, back);
    });
    let (to_robot, _records) = mpsc::unbounded_channel();
    let (to_cloud, mut records) = mpsc::unbounded_channel();
    let (to_robot, to_cloud) = (RecordSender(to_robot), RecordSender(to_cloud));
    let sending = async {
        let mut encoded = 0;
        for number in 0..=255 {
            let mut picture_data = data(1, 0);
            picture_data.message = picture(number);
            let before = robot.state.lock().out.sent;
            robot.publish(picture_data, DeliveryMode::Newest);
            let Some(Record::Data(came)) = records.recv().await else {
                panic!("a picture should come");
            };
            assert_eq!(came.message, picture(number));
            assert!(!came.encoded, "the handler has messages, not frames");
            encoded += u32::from(robot.state.lock().out.sent - before < 57_600 / 4);
            if encoded > 3 {
                return;
            }
        }
        panic!("no picture was made smaller");
    };
    tokio::select! {
        lost = robot.run(&mut at_robot, &to_robot) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &to_cloud) => panic!("{lost}"),
        () = sending => {}
    }
}

/// An occupancy grid of 80×80 cells as a message.
fn map() -> Bytes {
    let mut message = vec![0; 24];
    message.extend_from_slice(&0.5_f32.to_le_bytes());
    message.extend_from_slice(&[80, 0, 0, 0, 80, 0, 0, 0]);
    message.extend_from_slice(&[0; 56]);
    message.extend_from_slice(&6400_u32.to_le_bytes());
    let noise = |at: usize| [0, 100][((at * at * 2_654_435_761) >> 40) & 1];
    message.extend((0..6400).map(|at| if at < 4000 { noise(at) } else { 255 }));
    message.into()
}

/// Counts undecodable messages and collects records.
struct CountingHandler(mpsc::UnboundedSender<Record<FromCloud>>, std::sync::atomic::AtomicUsize);

impl SessionHandler<FromCloud> for CountingHandler {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        let _ = self.0.send(record);
    }
    fn on_undecodable(&self, _channel: u32) {
        self.1.fetch_add(1, Ordering::Relaxed);
    }
}

#[tokio::test]
async fn a_latched_map_that_is_damaged_on_its_way_is_not_given_out_and_comes_again() {
    let (robot, cloud) = (session(), session());
    robot.set_peer_codecs(&crate::packing::supported_codecs(|_| false), None);
    robot.open_channel(1, "/map", codec::Schema::OccupancyGrid);
    open(&robot, &cloud);
    // As on a slow link.
    robot.state.lock().out.encoding.pays = true;
    let (near, mut damaging) = duplex(1 << 16);
    let (mut beyond, far) = duplex(1 << 16);
    let mut at_robot = WebSocket::client(near, b"", MAX_FRAME, MAX_RECORD, 7);
    let mut at_cloud = WebSocket::new(far, b"", MAX_FRAME, MAX_RECORD);
    tokio::spawn(async move {
        let (mut up, mut down) = tokio::io::split(&mut damaging);
        let (mut from, mut to) = tokio::io::split(&mut beyond);
        let upwards = async {
            let (mut buffer, mut damaged) = (vec![0; 1 << 16], false);
            loop {
                let read = tokio::io::AsyncReadExt::read(&mut up, &mut buffer).await?;
                // Flips one bit of the map, which is longer than everything else.
                if read > 300 && !damaged {
                    damaged = true;
                    buffer[read / 2] ^= 4;
                }
                tokio::io::AsyncWriteExt::write_all(&mut to, &buffer[..read]).await?;
            }
        };
        let back = tokio::io::copy(&mut from, &mut down);
        let _: (std::io::Result<()>, _) = tokio::join!(upwards, back);
    });
    let (to_robot, _records) = mpsc::unbounded_channel();
    let (to_cloud, mut records) = mpsc::unbounded_channel();
    let (to_robot, to_cloud) = (RecordSender(to_robot), CountingHandler(to_cloud, Default::default()));
    let mut latched = data(1, 0);
    latched.latching = true;
    latched.message = map();
    robot.publish(latched, DeliveryMode::Each);
    tokio::select! {
        lost = robot.run(&mut at_robot, &to_robot) => panic!("{lost}"),
        lost = cloud.run(&mut at_cloud, &to_cloud) => panic!("{lost}"),
        came = tokio::time::timeout(Duration::from_secs(60), records.recv()) => {
            let Ok(Some(Record::Data(came))) = came else {
                panic!("the map does not come: {came:?}");
            };
            assert!(came.message == map(), "another map");
            assert!(came.latching && !came.encoded);
        }
    }
    assert_eq!(to_cloud.1.load(Ordering::Relaxed), 1, "it was told of");
}

/// Keeps control messages like a slow consumer.
#[derive(Default)]
struct SlowHandler(Mutex<Vec<(Record<FromCloud>, Permit)>>, Notify);

impl SessionHandler<FromCloud> for SlowHandler {
    fn on_record(&self, record: Record<FromCloud>, held: Permit, _arrived: i64) {
        self.0.lock().push((record, held));
        self.1.notify_one();
    }
}

/// Sends control records to an end with a budget of `limit` bytes, and returns how its link ends.
async fn deliver_control(limit: usize, orders: impl IntoIterator<Item = Bytes>) -> (DisconnectReason, usize, Budget) {
    let budget = Budget::new("robot x", limit);
    let told = Arc::new(Arc::into_inner(session()).expect("the only one").with_budget(&budget));
    let tells = session();
    open(&told, &tells);
    let (mut at_told, mut at_teller) = sockets();
    for json in orders {
        tells.push(&Record::Control(json), DeliveryMode::Each);
    }
    tells.close(1000, "all is told");
    let (slow, nobody) = (SlowHandler::default(), RecordSender(mpsc::unbounded_channel().0));
    let (lost, _) = tokio::join!(told.run(&mut at_told, &slow), tells.run(&mut at_teller, &nobody));
    let kept = slow.0.into_inner().len();
    (lost, kept, budget)
}

#[tokio::test]
async fn orders_count_until_they_are_obeyed() {
    let line = Bytes::from_static(br#"{"line":{"error":false,"text":"a"}}"#);
    let (lost, kept, budget) = deliver_control(1 << 20, vec![line.clone(); 100]).await;
    assert!(matches!(lost, DisconnectReason::Closed { code: 1000, .. }), "{lost}");
    assert_eq!((kept, budget.used_bytes()), (100, 0));
    let (lost, kept, _) = deliver_control(1 << 20, vec![line; 10_000]).await;
    let DisconnectReason::Protocol(Error::Exceeded(_)) = lost else {
        panic!("all of them wait at once: {lost}");
    };
    assert!((100..5000).contains(&kept), "{kept} were kept");
}

#[tokio::test]
async fn an_order_is_as_long_as_it_may_be() {
    let line = |length: usize| {
        let text = "x".repeat(length);
        Bytes::from(format!(r#"{{"line":{{"error":false,"text":"{text}"}}}}"#))
    };
    let (lost, kept, _) = deliver_control(64 << 20, [line(crate::MAX_CONTROL - 100)]).await;
    assert!(matches!(lost, DisconnectReason::Closed { code: 1000, .. }), "{lost}");
    assert_eq!(kept, 1);
    let (lost, kept, _) = deliver_control(64 << 20, [line(crate::MAX_CONTROL)]).await;
    let DisconnectReason::Protocol(error @ Error::TooMuch { .. }) = lost else {
        panic!("it is too long: {lost}");
    };
    assert!(error.to_string().contains("a control record of 10486"), "{error}");
    assert_eq!(kept, 0);
    // Parameters may be long texts.
    let text = "x".repeat(4 << 20);
    let parameters = format!(r#"{{"parameters":[["/robot_description","{text}"]]}}"#);
    let (lost, kept, _) = deliver_control(64 << 20, [parameters.into()]).await;
    assert!(matches!(lost, DisconnectReason::Closed { code: 1000, .. }), "{lost}");
    assert_eq!(kept, 1);
}

#[tokio::test]
async fn parameters_are_read_if_what_they_become_has_room() {
    // Each map with one entry takes seven bytes of text and hundreds of bytes of memory.
    let maps = vec![r#"{"a":1}"#; 100_000].join(",");
    let parameters = Bytes::from(format!(r#"{{"parameters":[["/a",[{maps}]]]}}"#));
    let (lost, kept, _) = deliver_control(usize::MAX, [parameters]).await;
    let DisconnectReason::Protocol(Error::Exceeded(full)) = lost else {
        panic!("it takes more than a session may: {lost}");
    };
    assert_eq!((kept, full.limit), (0, MAX_TOLD));
}

#[test]
fn what_takes_more_memory_than_the_peer_gives_is_not_sent() {
    let told = || FromRobot::Parameters(vec![("x".repeat(1 << 20), None)]);
    for (room, is_sent) in [(MAX_TOLD, true), (2 << 20, false)] {
        let robot = session();
        robot.set_peer_limits(LinkLimits { told: room, ..LinkLimits::default() });
        robot.send_control(&told());
        assert_eq!(!robot.state.lock().out.is_empty(), is_sent, "{room}");
    }
}

#[tokio::test]
async fn a_hello_is_read_if_what_it_becomes_has_room() {
    let (mut at_robot, mut at_cloud) = sockets();
    let tree = vec![r#""a":{"b":1}"#; 10_000].join(",");
    let hello = Bytes::from(format!(r#"{{"run":"r","parameters":{{{tree}}}}}"#));
    let budget = Budget::new("robot x", 64 << 20);
    for (limit, is_read) in [(64 << 20, true), (4 << 20, false)] {
        at_robot.queue(ws::frame::BINARY, Frame::Open(hello.clone()).encode());
        let mut held = budget.child("hello", limit).permit();
        let hello = receive_open::<crate::control::Hello>(&mut at_cloud, "hello", &mut held);
        let (sent, hello) = tokio::join!(poll_fn(|cx| at_robot.poll_flush(cx)), hello);
        sent.expect("sent");
        match hello {
            Ok(hello) => assert!(is_read && hello.parameters.len() == 1),
            Err(lost) => {
                assert!(!is_read && lost.to_string().contains("hello"), "{lost}");
            }
        }
        assert_eq!(held.bytes() > 0, is_read);
    }
}

#[tokio::test]
async fn calls_count_until_they_are_answered() {
    // Half of the budget is for calls, so that records in flight are not affected.
    let budget = Budget::new("robot x", 2 << 20);
    let asked = Arc::new(Arc::into_inner(session()).expect("the only one").with_budget(&budget));
    let asks = session();
    open(&asked, &asks);
    let (mut at_asked, mut at_asking) = sockets();
    for _ in 0..10 {
        asks.call(1, vec![1; 200 << 10].into());
    }
    let (slow, (to, mut answers)) = (SlowHandler::default(), mpsc::unbounded_channel());
    let to = RecordSender(to);
    let answered = async {
        let Some(Record::Answer { response, .. }) = answers.recv().await else {
            panic!("one does not fit");
        };
        response.expect_err("it does not fit")
    };
    let reason = tokio::select! {
        lost = asked.run(&mut at_asked, &slow) => panic!("{lost}"),
        lost = asks.run(&mut at_asking, &to) => panic!("{lost}"),
        reason = answered => reason,
    };
    assert!(reason.as_str().contains("the memory for calls"), "{reason}");
    let kept = slow.0.into_inner();
    assert_eq!(kept.len(), 5);
    assert!(budget.used_bytes() >= 5 * (200 << 10));
    drop((kept, asked));
    assert_eq!(budget.used_bytes(), 0);
}
