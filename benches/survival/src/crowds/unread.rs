//! Clients that never read what is published for them.

use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use bench_report::{BenchReport, Process, Target};
use serde_json::json;
use support::daemon::Daemon;
use support::robot::Robot;

use super::join_thread;
use crate::greeters;
use crate::milliseconds::quantile;

/// Number of clients that never read. They do not answer pings either and are disconnected for that, but the messages
/// are published before.
const READERS: usize = 100;
const TIME: Duration = Duration::from_secs(6);
/// Robot to which they belong.
const UNREAD: &str = "unread";
/// Size of a message in bytes, and the pause after each. About ten messages are queued for each reader and count
/// against the memory budget of their client, which is the publisher as well: larger ones would cause its
/// disconnection.
const MESSAGE: usize = 1 << 16;
const PACE: Duration = Duration::from_millis(50);
/// Default memory budget of a client, which all these connections share, in megabytes; see `benches/memory` for the
/// further memory of a process.
const CLIENT: f64 = 268.0;
const OVERHEAD: f64 = 1.5;

/// Measurements made while messages were published.
#[derive(Debug)]
struct PublishingSample {
    messages: u32,
    /// Durations of another robot's calls.
    times: Vec<Duration>,
    /// Peak resident memory of the daemon, in megabytes.
    most: f64,
}

pub(super) fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let path = greeters::robot_path(UNREAD);
    let for_nobody = publish_and_call(daemon)?;
    let mut readers = Vec::new();
    for _ in 0..READERS {
        let mut reader = Robot::connect_with_small_buffer(&daemon.url(&path), &[])?;
        reader.subscribe("/unread")?;
        reader.call("/rosapi/get_time", json!({}))?;
        readers.push(reader);
    }
    let before = Process::from_pid(daemon.pid()).resident()?;
    let for_readers = publish_and_call(daemon)?;
    let PublishingSample { messages, times, most } = for_readers;
    let title = format!("memory of the daemon with {READERS} clients that never read");
    report
        .figure(title, "MB", most)
        .relative_to("before they were there", before)
        .require(Target::AtMost((before + OVERHEAD * CLIENT).round()))
        .note(format!("resident; {messages} messages of {MESSAGE} bytes were published"));
    let title = format!("a call beside {READERS} clients that never read, p99");
    report
        .figure(title, "ms", quantile(&times, 0.99))
        .relative_to("while the same is published for nobody", quantile(&for_nobody.times, 0.99))
        .note(format!("p50 {:.2} ms beside {:.2} ms", quantile(&times, 0.5), quantile(&for_nobody.times, 0.5)));
    Ok(())
}

/// Publishes for a while and makes calls as another robot meanwhile.
fn publish_and_call(daemon: &Daemon) -> Result<PublishingSample> {
    let mut publisher = daemon.robot(&greeters::robot_path(UNREAD))?;
    publisher.send(json!({"op": "advertise", "topic": "/unread", "type": "std_msgs/String"}))?;
    publisher.call("/rosapi/get_time", json!({}))?;
    let message = json!({"op": "publish", "topic": "/unread", "msg": {"data": "x".repeat(MESSAGE)}});
    let mut robot = daemon.robot(&greeters::robot_path("polite"))?;
    greeters::greeting_count(&mut robot)?;
    let (began, mut times, mut most) = (Instant::now(), Vec::new(), 0.0_f64);
    let publish = || -> Result<u32> {
        let mut messages = 0;
        while began.elapsed() < TIME {
            if let Err(error) = publisher.send(message.clone()) {
                bail!("{error:#}: {:?}", publisher.wait_for_close());
            }
            messages += 1;
            std::thread::sleep(PACE);
        }
        // The publisher is still connected, and the daemon has received all its messages.
        publisher.call("/rosapi/get_time", json!({}))?;
        Ok(messages)
    };
    let messages = std::thread::scope(|scope| {
        let publishing = scope.spawn(publish);
        while began.elapsed() < TIME {
            let asked = Instant::now();
            greeters::greeting_count(&mut robot)?;
            times.push(asked.elapsed());
            most = most.max(Process::from_pid(daemon.pid()).resident()?);
        }
        join_thread(publishing)
    })?;
    Ok(PublishingSample { messages, times, most })
}
