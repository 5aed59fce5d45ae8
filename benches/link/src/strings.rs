//! Round trip of a String through a relay in the servant: over the link, and by a client of the portal.

use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Target, is_full_run, quantile_seconds};
use serde_json::json;
use support::daemon::Daemon;
use support::robot::Robot;
use support::site::{Site, string};

/// Messages per turn; the first tenth is not counted.
const TRIPS: usize = 1000;

fn warm_median_micros(times: &[Duration]) -> f64 {
    quantile_seconds(&times[TRIPS / 10..], 0.5) * 1e6
}

/// Reports the best median of the turns of each path.
pub fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let rounds = if is_full_run() { 15 } else { 5 };
    let site = Site::new()?;
    let app = site.node("/app")?;
    let stub = site.start_stub(daemon, ("meter", "rosbridge_fixture", "meter"), "bench-strings", &["__name:=meter"])?;
    let pings = site.advertise_strings(&app, "/meter/ping", false)?;
    site.wait_for_subscribers(&*pings, 1).with_context(|| stub.output())?;
    let mut pongs = site.subscribe(&app, "/meter/pong")?;
    loop {
        pings.publish(string("first"));
        let came = site
            .runtime
            .block_on(async { tokio::time::timeout(Duration::from_millis(200), pongs.messages.recv()).await });
        if came.is_ok() {
            break;
        }
    }
    // Further copies of the first message may be in flight; none of them is lost.
    pings.publish(string("last of the first"));
    while site.next_message(&mut pongs)?.bytes != string("last of the first") {}
    let mut client = Robot::connect(&format!("{}?robot=bench-client", daemon.url("meter")))?;
    client.send(json!({"op": "advertise", "topic": "/meter/ping", "type": "std_msgs/String"}))?;
    client.subscribe("/meter/pong")?;
    client.wait_for_subscriber("/meter/ping")?;
    let (mut link, mut portal) = (f64::INFINITY, f64::INFINITY);
    for round in 1..=rounds {
        eprintln!("strings: round {round} of {rounds}");
        let mut times = Vec::with_capacity(TRIPS);
        // All in the robot's runtime: waking another thread is not part of the link's cost.
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
        link = link.min(warm_median_micros(&times));
        times.clear();
        for number in 0..TRIPS {
            let publication = json!({"op": "publish", "topic": "/meter/ping", "msg": {"data": number.to_string()}});
            let begun = Instant::now();
            client.send(publication)?;
            client.next_message_on("/meter/pong")?;
            times.push(begun.elapsed());
        }
        portal = portal.min(warm_median_micros(&times));
    }
    let figure = report.figure("String there and back over the link: p50", "µs", link);
    figure.relative_to("a client of the portal, JSON", portal);
    let figure = report.figure("that is longer than the portal's by", "µs", link - portal);
    figure.require(Target::AtMost(100.0)).note("the link's way has two more connections: application and stub");
    Ok(())
}
