//! An hour of a robot with a camera, commands and goals and of a node that prints, in simulated time, over a slow link
//! that is cut every minute and away for a minute every ten: what both ends hold stays below their limits and does not
//! grow.

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use budget::Permit;
use bytes::Bytes;
use link::control::{FromCloud, FromRobot};
use link::record::{Call, Data, Record};
use link::{CloudSession, DeliveryMode, MAX_FRAME, MAX_RECORD, RobotSession, SessionHandler, SessionOptions};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex, split};
use tokio::time::{interval, sleep, timeout};
use ws::WebSocket;

static HELD_BYTES: AtomicUsize = AtomicUsize::new(0);

/// The system's allocator, counting the bytes that the process holds.
struct Counting;

// SAFETY: every call goes to the system's allocator as it is; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        HELD_BYTES.fetch_add(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        HELD_BYTES.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Bytes of a picture, and of a command.
const PICTURE: &[u8] = &[7; 30_000];
const COMMAND: &[u8] = &[7; 16];
/// Channels of the pictures, of their answers, of the commands, of the goals, and of their results.
const PICTURES: u32 = 1;
const ANSWERS: u32 = 2;
const COMMANDS: u32 = 3;
const GOALS: u32 = 4;
const RESULTS: u32 = 5;
/// The node prints this many lines in a second, every 90 s: also right after the link has gone for a minute.
const LINES: usize = 10_000;
const LINES_EVERY: Duration = Duration::from_secs(90);
/// Bytes that both ends may hold: for each, 4 MiB of sent messages and lines that are not acknowledged; for the cloud
/// 1 MiB of lines, which take up to four times their length. The payloads of messages are static here.
const HOLDS: usize = 12 << 20;
/// Bytes that the link carries each way in 50 ms: 500 kbit/s.
const SLICE: usize = 3125;
const SLICE_TIME: Duration = Duration::from_millis(50);
/// Growth over the last half hour that is no leak: how much waits differs from cut to cut. A leak of one byte per
/// message is more.
const FLUCTUATION: usize = 128 << 10;

fn message(channel: u32, bytes: &'static [u8]) -> Data {
    Data {
        channel,
        encoded: false,
        latching: false,
        born: 0,
        left: 0,
        serialise: 0,
        answered: None,
        message: Bytes::from_static(bytes),
    }
}

/// The cloud's end: answers each call and each goal.
struct CloudEnd(Arc<CloudSession>);

impl SessionHandler<FromRobot> for CloudEnd {
    fn on_record(&self, record: Record<FromRobot>, _held: Permit, _arrived: i64) {
        match record {
            Record::Call(Call { id, request, .. }) => self.0.answer(id, 0, Ok(request)),
            Record::Data(Data { channel: GOALS, .. }) => {
                self.0.publish(message(RESULTS, COMMAND), DeliveryMode::Each);
            }
            _ => {}
        }
    }
}

/// The robot's end: counts what arrives.
#[derive(Default)]
struct RobotEnd {
    records: AtomicUsize,
    results: AtomicUsize,
    lines: AtomicUsize,
    left_out: AtomicUsize,
}

impl SessionHandler<FromCloud> for RobotEnd {
    fn on_record(&self, record: Record<FromCloud>, _held: Permit, _arrived: i64) {
        self.records.fetch_add(1, Ordering::Relaxed);
        match record {
            Record::Data(Data { channel: RESULTS, .. }) => {
                self.results.fetch_add(1, Ordering::Relaxed);
            }
            Record::Control(FromCloud::Line { text, .. }) => {
                // The notice of lines that were left out begins with their number.
                let number = text.strip_prefix('[').and_then(|text| text.split(' ').next()?.parse().ok());
                let counter = if number.is_some() { &self.left_out } else { &self.lines };
                counter.fetch_add(number.unwrap_or(1), Ordering::Relaxed);
            }
            _ => {}
        }
    }
}

/// Carries bytes one way, [`SLICE`] at a time.
async fn carry_slowly(mut from: tokio::io::ReadHalf<DuplexStream>, mut to: tokio::io::WriteHalf<DuplexStream>) {
    let mut slice = [0; SLICE];
    let mut clock = interval(SLICE_TIME);
    while let Ok(read @ 1..) = from.read(&mut slice).await {
        if to.write_all(&slice[..read]).await.is_err() {
            return;
        }
        clock.tick().await;
    }
}

/// Lets both ends exchange what they have for `time` over one connection.
async fn connect(robot: &RobotSession, cloud: &Arc<CloudSession>, heard: &RobotEnd, time: Duration) {
    let (robot_has, robot_ahead, robot_next) = robot.position();
    let (cloud_has, cloud_ahead, cloud_next) = cloud.position();
    robot.reconnect(cloud_has, &cloud_ahead, cloud_next);
    cloud.reconnect(robot_has, &robot_ahead, robot_next);
    let ((robots, near), (far, clouds)) = (duplex(SLICE), duplex(SLICE));
    let mut at_robot = WebSocket::client(robots, b"", MAX_FRAME, MAX_RECORD, 7);
    let mut at_cloud = WebSocket::new(clouds, b"", MAX_FRAME, MAX_RECORD);
    let ((near_read, near_write), (far_read, far_write)) = (split(near), split(far));
    let end = CloudEnd(Arc::clone(cloud));
    let carried = async {
        tokio::join!(
            robot.run(&mut at_robot, heard),
            cloud.run(&mut at_cloud, &end),
            carry_slowly(near_read, far_write),
            carry_slowly(far_read, near_write),
        )
    };
    let cut = timeout(time, carried).await;
    assert!(cut.is_err(), "the link ended by itself: {cut:?}");
}

#[tokio::test(start_paused = true)]
async fn an_hour_of_a_camera_leaves_no_memory_behind() {
    let options = || SessionOptions::for_silence(Duration::from_secs(10), None);
    let robot = Arc::new(RobotSession::new(options()));
    let cloud = Arc::new(CloudSession::new(options()));
    let [camera, joystick, planner] = std::array::from_fn(|_| Arc::clone(&robot));
    let [node, printer] = std::array::from_fn(|_| Arc::clone(&cloud));
    let sources = [
        tokio::spawn(async move {
            let mut clock = interval(Duration::from_nanos(33_333_333));
            loop {
                clock.tick().await;
                camera.publish(message(PICTURES, PICTURE), DeliveryMode::Newest);
            }
        }),
        tokio::spawn(async move {
            let mut clock = interval(Duration::from_millis(100));
            loop {
                clock.tick().await;
                joystick.publish(message(COMMANDS, COMMAND), DeliveryMode::Each);
                joystick.call(1, Bytes::from_static(COMMAND));
            }
        }),
        tokio::spawn(async move {
            let mut clock = interval(Duration::from_secs(10));
            loop {
                clock.tick().await;
                planner.publish(message(GOALS, COMMAND), DeliveryMode::InOrder);
            }
        }),
        tokio::spawn(async move {
            let mut clock = interval(LINES_EVERY);
            loop {
                clock.tick().await;
                for _ in 0..20 {
                    let line = FromCloud::Line { error: false, text: "a line of a node that prints a lot".to_owned() };
                    (0..LINES / 20).for_each(|_| printer.send_control(&line));
                    sleep(Duration::from_millis(50)).await;
                }
            }
        }),
        tokio::spawn(async move {
            let mut clock = interval(Duration::from_millis(64));
            loop {
                clock.tick().await;
                node.publish(message(ANSWERS, COMMAND), DeliveryMode::Newest);
                node.send_control(&FromCloud::Line { error: false, text: "a line of a node".to_owned() });
            }
        }),
    ];
    let heard = RobotEnd::default();
    let (mut held, before) = (Vec::new(), HELD_BYTES.load(Ordering::Relaxed));
    for minute in 0..60 {
        if minute % 10 == 9 {
            sleep(Duration::from_secs(60)).await;
        } else {
            connect(&robot, &cloud, &heard, Duration::from_secs(57)).await;
            sleep(Duration::from_secs(3)).await;
        }
        held.push(HELD_BYTES.load(Ordering::Relaxed).saturating_sub(before));
    }
    sources.iter().for_each(tokio::task::JoinHandle::abort);
    let most = |minutes: &[usize]| minutes.iter().copied().max().unwrap_or_default();
    let (earlier, later) = (most(&held[10..30]), most(&held[30..]));
    assert!(later <= earlier + FLUCTUATION, "bytes held after each minute: {held:?}");
    assert!(most(&held) <= HOLDS, "bytes held after each minute: {held:?}");
    let counted = [&heard.records, &heard.results, &heard.lines, &heard.left_out];
    let [records, results, lines, left_out] = counted.map(|counter| counter.load(Ordering::Relaxed));
    // Every call was answered, most answers and lines arrived.
    assert!(records > 54 * 57 * 20, "{records} records arrived at the robot");
    // The goals of the last minute are still with the robot.
    assert!((350..=354).contains(&results), "{results} results");
    assert!(lines > 54 * 57 * 10 && left_out > 30 * LINES / 2, "{lines} lines, {left_out} left out");
}
