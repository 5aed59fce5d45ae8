//! A small message's way there and back while pictures go the same way, over a network that carries two or three of
//! them a second: what the link's pieces are for.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::Report;
use bytes::Bytes;
use ros::bus::{Bus, Publisher, Qos, Subscription, WireType};
use ros::ros1::Ros1Bus;
use support::cable::{Badness, Cable};
use support::daemon::Daemon;
use support::site::{Site, string};

/// What the network is like.
const NETWORK: Badness = Badness {
    rate: 20_000,
    delay: 5,
    jitter: 0,
    loss: 0.0,
    limit: 1000,
};
/// Nothing in it can be made smaller.
const PICTURE: usize = 900_000;
/// Between two pictures, and two small messages.
const PICTURES: Duration = Duration::from_millis(100);
const PAUSE: Duration = Duration::from_millis(20);

/// Quantiles of the trips, ms.
struct Trips {
    p50: f64,
    p99: f64,
}

fn quantiles(times: &[Duration]) -> Trips {
    let milliseconds = |share| {
        let time = bench_report::quantile(times, share);
        time.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3)
    };
    Trips {
        p50: milliseconds(0.5),
        p99: milliseconds(0.99),
    }
}

/// A sensor_msgs/Image of noise.
fn picture(number: u32) -> Bytes {
    let mut out = Vec::with_capacity(PICTURE + 64);
    for word in [number, 0, 0, 0, 480, 640, 4] {
        out.extend(u32::to_le_bytes(word));
    }
    out.extend(b"rgb8\0");
    out.extend(u32::to_le_bytes(640 * 3));
    out.extend(u32::try_from(PICTURE).unwrap_or(0).to_le_bytes());
    let mut noise = number.wrapping_mul(2_654_435_761) | 1;
    out.extend((0..PICTURE).map(|_| {
        noise ^= noise << 13;
        noise ^= noise >> 17;
        noise ^= noise << 5;
        (noise >> 24) as u8
    }));
    out.into()
}

fn advertises(site: &Site, app: &Ros1Bus) -> Result<Box<dyn Publisher>> {
    Ok(site.runtime.block_on(app.advertise(
        "/meter/image_in",
        WireType::new(
            "sensor_msgs/Image",
            "060021388200f6f0f447d0fcd9c64743",
            crate::people::IMAGE,
        ),
        Qos::keep_last(1),
    ))?)
}

/// One small message after the other through the stub.
fn through_the_link(
    site: &Site,
    pings: &dyn Publisher,
    pongs: &mut Subscription,
    trips: usize,
) -> Result<Trips> {
    let mut times = Vec::with_capacity(trips);
    for number in 0..trips {
        let text = string(&number.to_string());
        let begun = Instant::now();
        pings.publish(text.clone());
        while site.next(pongs)?.bytes != text {}
        times.push(begun.elapsed());
        std::thread::sleep(PAUSE);
    }
    Ok(quantiles(&times))
}

/// Trips over the shaped network, alone and beside pictures.
pub fn measure(report: &mut Report, daemon: &Daemon) -> Result<()> {
    let trips = if crate::full() { 1000 } else { 200 };
    eprintln!("a small message beside pictures: {trips} trips each");
    let cable = Cable::new(&daemon.address)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"meter\"\nrobot = \"bench-beside\"\nlocal = \"none\"\n",
        cable.server
    );
    let stub = site.stub_with(&toml, "rosbridge_fixture", "meter", &["__name:=meter"])?;
    let pings = site.says(&app, "/meter/ping", false)?;
    site.connected(&*pings, 1).with_context(|| stub.said())?;
    let mut pongs = site.hears(&app, "/meter/pong")?;
    site.runtime.block_on(async {
        let mut connected = pongs.matched.clone();
        connected
            .wait_for(|now| now.connected() == 1)
            .await
            .map(drop)
    })?;
    let pictures: Arc<dyn Publisher> = advertises(&site, &app)?.into();
    site.connected(&*pictures, 1).with_context(|| stub.said())?;
    cable.degrade(NETWORK)?;
    let alone = through_the_link(&site, &*pings, &mut pongs, trips)?;
    let over = Arc::new(AtomicBool::new(false));
    let camera = {
        let (over, pictures) = (Arc::clone(&over), Arc::clone(&pictures));
        std::thread::spawn(move || {
            let frames: Vec<Bytes> = (0..4).map(picture).collect();
            for frame in frames.iter().cycle() {
                if over.load(Ordering::Relaxed) {
                    return;
                }
                pictures.publish(frame.clone());
                std::thread::sleep(PICTURES);
            }
        })
    };
    let beside = through_the_link(&site, &*pings, &mut pongs, trips);
    over.store(true, Ordering::Relaxed);
    let _ = camera.join();
    let beside = beside.with_context(|| stub.said())?;
    drop((pictures, pings, pongs, stub));
    cable.restore()?;
    // What a message waits for that comes behind a whole one.
    let picture = PICTURE as f64 * 8.0 / f64::from(NETWORK.rate);
    for (what, beside, alone) in [
        ("p50", beside.p50, alone.p50),
        ("p99", beside.p99, alone.p99),
    ] {
        report
            .figure(
                format!("String there and back beside 900 kB pictures, 20 Mbit/s: {what}"),
                "ms",
                beside,
            )
            .beside("the same without pictures", alone)
            .note(format!(
                "a picture takes {picture:.0} ms; {}",
                cable.means()
            ));
    }
    Ok(())
}
