//! Clients that never read what is published for them.

use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use bench_report::{Report, Target};
use serde_json::json;
use support::daemon::Daemon;
use support::robot::Robot;

use super::joined;
use crate::greeters;
use crate::milliseconds::part;
use crate::resources::Resources;

/// So many. They answer no pings, either, and are let go for that: what is published for them is, before that.
const READERS: usize = 100;
const TIME: Duration = Duration::from_secs(6);
/// The robot whose they are.
const UNREAD: &str = "unread";
/// A message, in bytes, and the pause after each. Some ten of them wait for each reader and count as its client's, who publishes, too: were
/// they larger, it would be let go for that.
const MESSAGE: usize = 1 << 16;
const PACE: Duration = Duration::from_millis(50);
/// Megabytes of the default budget of a client, which these are together; see `benches/memory` for what a process takes beside it.
const CLIENT: f64 = 268.0;
const OVERHEAD: f64 = 1.5;

/// A hundred that never read.
#[derive(Debug)]
pub(super) struct Unread {
    /// Resident megabytes of the daemon before they were there.
    before: f64,
    for_nobody: Published,
    for_readers: Published,
}

/// What was seen while something was published.
#[derive(Debug)]
struct Published {
    messages: u32,
    /// Times of another robot's calls.
    times: Vec<Duration>,
    /// Resident megabytes of the daemon, at most.
    most: f64,
}

pub(super) fn measure(daemon: &Daemon) -> Result<Unread> {
    let path = greeters::path(UNREAD);
    let for_nobody = publish_beside(daemon)?;
    let mut readers = Vec::new();
    for _ in 0..READERS {
        let mut reader = Robot::on_a_short_line(&daemon.url(&path), &[])?;
        reader.subscribes("/unread")?;
        reader.calls("/rosapi/get_time", json!({}))?;
        readers.push(reader);
    }
    let before = Resources::of(daemon.pid())?.resident;
    let for_readers = publish_beside(daemon)?;
    Ok(Unread {
        before,
        for_nobody,
        for_readers,
    })
}

/// Publishes for a while, and calls as another robot meanwhile.
fn publish_beside(daemon: &Daemon) -> Result<Published> {
    let mut publisher = daemon.robot(&greeters::path(UNREAD))?;
    publisher.says(json!({"op": "advertise", "topic": "/unread", "type": "std_msgs/String"}))?;
    publisher.calls("/rosapi/get_time", json!({}))?;
    let message =
        json!({"op": "publish", "topic": "/unread", "msg": {"data": "x".repeat(MESSAGE)}});
    let mut robot = daemon.robot(&greeters::path("polite"))?;
    greeters::count(&mut robot)?;
    let (began, mut times, mut most) = (Instant::now(), Vec::new(), 0.0_f64);
    let publish = || -> Result<u32> {
        let mut messages = 0;
        while began.elapsed() < TIME {
            if let Err(error) = publisher.says(message.clone()) {
                bail!("{error:#}: {:?}", publisher.hears_close());
            }
            messages += 1;
            std::thread::sleep(PACE);
        }
        // Its connection stands, and the daemon has taken all of it.
        publisher.calls("/rosapi/get_time", json!({}))?;
        Ok(messages)
    };
    let messages = std::thread::scope(|scope| {
        let publishing = scope.spawn(publish);
        while began.elapsed() < TIME {
            let asked = Instant::now();
            greeters::count(&mut robot)?;
            times.push(asked.elapsed());
            most = most.max(Resources::of(daemon.pid())?.resident);
        }
        joined(publishing)
    })?;
    Ok(Published {
        messages,
        times,
        most,
    })
}

impl Unread {
    pub(super) fn tell(&self, report: &mut Report) {
        let Published {
            messages,
            times,
            most,
        } = &self.for_readers;
        report
            .figure(
                format!("memory of the daemon with {READERS} clients that never read"),
                "MB",
                *most,
            )
            .beside("before they were there", self.before)
            .reach(Target::AtMost((self.before + OVERHEAD * CLIENT).round()))
            .note(format!(
                "resident; {messages} messages of {MESSAGE} bytes were published"
            ));
        report
            .figure(
                format!("a call beside {READERS} clients that never read, p99"),
                "ms",
                part(times, 0.99),
            )
            .beside(
                "while the same is published for nobody",
                part(&self.for_nobody.times, 0.99),
            )
            .note(format!(
                "p50 {:.2} ms beside {:.2} ms",
                part(times, 0.5),
                part(&self.for_nobody.times, 0.5)
            ));
    }
}
