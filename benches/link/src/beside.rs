//! Round-trip time of a small message while pictures are sent over the same link, on a network that can carry two or
//! three pictures per second: the case for which the link splits messages into pieces.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, is_full_run, quantile_seconds};
use bytes::Bytes;
use ros::bus::{Bus, Publisher, QosProfile, Subscription};
use ros::ros1::Ros1Bus;
use support::cable::{Cable, NetworkImpairment};
use support::daemon::Daemon;
use support::people;
use support::site::{Site, string};

use crate::people::next_noise;

/// Properties of the network.
const NETWORK: NetworkImpairment = NetworkImpairment { rate: 20_000, delay: 5, jitter: 0, loss: 0.0, limit: 1000 };
/// Size of a picture of 900 kB; its content cannot be compressed.
const SIZE: (u32, u32) = (600, 500);
/// Intervals between two pictures and between two small messages.
const PICTURES: Duration = Duration::from_millis(100);
const PAUSE: Duration = Duration::from_millis(20);

/// Serializes a sensor_msgs/Image of noise.
fn noise_image(number: u32) -> Bytes {
    let mut noise = number.wrapping_mul(2_654_435_761) | 1;
    let pixels = (0..SIZE.0 * SIZE.1 * 3).map(|_| (next_noise(&mut noise) >> 24) as u8);
    people::picture(number, SIZE, &pixels.collect::<Vec<u8>>())
}

fn advertise_images(site: &Site, app: &Ros1Bus) -> Result<Box<dyn Publisher>> {
    let quality = QosProfile::keep_last(1);
    let advertised = app.advertise("/meter/image_in", people::image_type(), quality);
    Ok(site.runtime.block_on(advertised)?)
}

/// Measures small messages through the stub, one after the other.
fn time_link_trips(
    site: &Site,
    pings: &dyn Publisher,
    pongs: &mut Subscription,
    trips: usize,
) -> Result<Vec<Duration>> {
    let mut times = Vec::with_capacity(trips);
    for number in 0..trips {
        let text = string(&number.to_string());
        let begun = Instant::now();
        pings.publish(text.clone());
        while site.next_message(pongs)?.bytes != text {}
        times.push(begun.elapsed());
        std::thread::sleep(PAUSE);
    }
    Ok(times)
}

/// Measures round trips over the shaped network, without and with pictures.
pub fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let trips = if is_full_run() { 1000 } else { 200 };
    eprintln!("a small message beside pictures: {trips} trips each");
    let cable = Cable::new(&daemon.address)?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"meter\"\nrobot = \"bench-beside\"\nlocal = \"none\"\n",
        cable.server
    );
    let stub = site.start_stub_with_config(&toml, "rosbridge_fixture", "meter", &["__name:=meter"])?;
    let pings = site.advertise_strings(&app, "/meter/ping", false)?;
    site.wait_for_subscribers(&*pings, 1).with_context(|| stub.output())?;
    let mut pongs = site.subscribe(&app, "/meter/pong")?;
    site.runtime.block_on(async {
        let mut connected = pongs.matched.clone();
        connected.wait_for(|now| now.connected_count() == 1).await.map(drop)
    })?;
    let pictures: Arc<dyn Publisher> = advertise_images(&site, &app)?.into();
    site.wait_for_subscribers(&*pictures, 1).with_context(|| stub.output())?;
    cable.degrade(NETWORK)?;
    let alone = time_link_trips(&site, &*pings, &mut pongs, trips)?;
    let over = Arc::new(AtomicBool::new(false));
    let camera = {
        let (over, pictures) = (Arc::clone(&over), Arc::clone(&pictures));
        std::thread::spawn(move || {
            let frames: Vec<Bytes> = (0..4).map(noise_image).collect();
            for frame in frames.iter().cycle() {
                if over.load(Ordering::Relaxed) {
                    return;
                }
                pictures.publish(frame.clone());
                std::thread::sleep(PICTURES);
            }
        })
    };
    let beside = time_link_trips(&site, &*pings, &mut pongs, trips);
    over.store(true, Ordering::Relaxed);
    let _ = camera.join();
    let beside = beside.with_context(|| stub.output())?;
    drop((pictures, pings, pongs, stub));
    cable.restore()?;
    // Time for which a message waits that is queued behind a whole picture.
    let picture = f64::from(SIZE.0 * SIZE.1 * 3) * 8.0 / f64::from(NETWORK.rate);
    for (what, share) in [("p50", 0.5), ("p99", 0.99)] {
        let [beside, alone] = [&beside, &alone].map(|times| quantile_seconds(times, share) * 1e3);
        let title = format!("String there and back beside 900 kB pictures, 20 Mbit/s: {what}");
        report
            .figure(title, "ms", beside)
            .relative_to("the same without pictures", alone)
            .note(format!("a picture takes {picture:.0} ms; {}", cable.mechanism()));
    }
    Ok(())
}
