//! A String through a relay in the servant and back: over the link, and by a client of the portal.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{Report, Target};
use serde_json::json;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::{Site, string};

/// Per turn; the first tenth does not count.
const TRIPS: usize = 1000;

fn counted(times: &mut [Duration]) -> f64 {
    crate::median(&times[TRIPS / 10..]) * 1e6
}

/// The best median of each one's turns.
pub fn measure(report: &mut Report, daemon: &Daemon) -> Result<()> {
    let rounds = if crate::full() { 15 } else { 5 };
    let site = Site::new()?;
    let app = site.node("/app")?;
    let stub = site.stub(
        daemon,
        ("meter", "rosbridge_fixture", "meter"),
        "bench-strings",
        &["__name:=meter"],
    )?;
    let pings = site.says(&app, "/meter/ping", false)?;
    site.connected(&*pings, 1).with_context(|| stub.said())?;
    let mut pongs = site.hears(&app, "/meter/pong")?;
    loop {
        pings.publish(string("first"));
        let came = site.runtime.block_on(async {
            tokio::time::timeout(Duration::from_millis(200), pongs.messages.recv()).await
        });
        if came.is_ok() {
            break;
        }
    }
    // Others of the first may be on their way: none is lost.
    pings.publish(string("last of the first"));
    while site.next(&mut pongs)?.bytes != string("last of the first") {}
    let mut client = Robot::connect(&format!("{}?robot=bench-client", daemon.url("meter")))?;
    client.says(json!({"op": "advertise", "topic": "/meter/ping", "type": "std_msgs/String"}))?;
    client.subscribes("/meter/pong")?;
    client.awaits_subscriber("/meter/ping")?;
    let (mut link, mut portal) = (f64::INFINITY, f64::INFINITY);
    for round in 1..=rounds {
        eprintln!("strings: round {round} of {rounds}");
        let mut times = Vec::with_capacity(TRIPS);
        // All on the robot's runtime: waking another thread is not the link's.
        site.runtime.block_on(async {
            for number in 0..TRIPS {
                let text = string(&number.to_string());
                let begun = Instant::now();
                pings.publish(text.clone());
                let pong = pongs.messages.recv().await.context("a pong")?;
                times.push(begun.elapsed());
                ensure!(pong.bytes == text, "another pong: {pong:?}");
            }
            anyhow::Ok(())
        })?;
        link = link.min(counted(&mut times));
        times.clear();
        for number in 0..TRIPS {
            let publication = json!({"op": "publish", "topic": "/meter/ping", "msg": {"data": number.to_string()}});
            let begun = Instant::now();
            client.says(publication)?;
            client.hears_on("/meter/pong")?;
            times.push(begun.elapsed());
        }
        portal = portal.min(counted(&mut times));
    }
    report
        .figure("String there and back over the link: p50", "µs", link)
        .beside("a client of the portal, JSON", portal);
    report
        .figure("that is longer than the portal's by", "µs", link - portal)
        .reach(Target::AtMost(100.0))
        .note("the link's way has two more connections: application and stub");
    Ok(())
}
