//! people_detect: an image in, `found` out.

use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, Process, Target, is_full_run, quantile_seconds};
use bytes::Bytes;
use ros::bus::{Bus, Publisher, QosProfile, Subscription};
use ros::ros1::Ros1Bus;
use support::daemon::Daemon;
use support::people;
use support::site::{NodeProcess, Site};

const SIZE: (u32, u32) = (640, 480);

/// One path on which the same messages are sent.
struct MessagePath {
    pictures: Box<dyn Publisher>,
    found: Subscription,
    times: Vec<Duration>,
    asked: u32,
}

impl MessagePath {
    fn new(site: &Site, app: &Ros1Bus, node: &str) -> Result<Self> {
        let found = site.subscribe(app, &format!("/{node}/found"))?;
        let topic = format!("/{node}_camera");
        let pictures = site.runtime.block_on(app.advertise(&topic, people::image_type(), QosProfile::keep_last(10)))?;
        site.wait_for_subscribers(&*pictures, 1)?;
        Ok(Self { pictures, found, times: Vec::new(), asked: 0 })
    }

    /// Publishes one image and returns the time until its answer.
    fn time_request(&mut self, site: &Site) -> Result<Duration> {
        self.asked += 1;
        let stamp = self.asked;
        let picture = camera_image(stamp);
        let begun = Instant::now();
        self.pictures.publish(picture);
        loop {
            let found = site.next_message(&mut self.found).context("found")?;
            if found.bytes.get(4..8) == Some(&stamp.to_le_bytes()) {
                return Ok(begun.elapsed());
            }
        }
    }
}

/// An image like a camera's: shapes with noise.
fn camera_image(stamp: u32) -> Bytes {
    let mut noise = stamp.wrapping_mul(2_654_435_761) | 1;
    let pixels = (0..SIZE.0 * SIZE.1 * 3).map(|at| {
        let shape = ((at / 3 % SIZE.0) / 40 + at / (SIZE.0 * 3) / 60) % 2 * 90;
        (shape + (next_noise(&mut noise) & 15) + 60) as u8
    });
    people::picture(stamp, SIZE, &pixels.collect::<Vec<u8>>())
}

/// Returns the next word of a xorshift generator.
fn next_noise(state: &mut u32) -> u32 {
    *state ^= *state << 13;
    *state ^= *state >> 17;
    *state ^= *state << 5;
    *state
}

/// Measures response times in turns, and the resources of the stub.
pub fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let rounds = if is_full_run() { 300 } else { 60 };
    let site = Site::new()?;
    let app = site.node("/app")?;
    let native = site.start_original(
        daemon,
        "opencv_apps",
        "/usr/lib/opencv_apps/people_detect",
        &["__name:=native", "_debug_view:=false", "image:=/native_camera"],
    )?;
    let stub = site.start_stub(
        daemon,
        ("opencv_apps", "opencv_apps", "people_detect"),
        "bench-link",
        &["__name:=linked", "_debug_view:=false", "image:=/linked_camera"],
    )?;
    let mut ways = [MessagePath::new(&site, &app, "native")?, MessagePath::new(&site, &app, "linked")?];
    for way in &mut ways {
        // The first image may be lost while connections are being established.
        way.pictures.publish(camera_image(0));
        site.next_message(&mut way.found)?;
        for _ in 0..5 {
            way.time_request(&site)?;
        }
    }
    for round in 0..rounds {
        let first = round % 2;
        for index in [first, 1 - first] {
            let took = ways[index].time_request(&site)?;
            ways[index].times.push(took);
        }
    }
    let [alone, linked] = ways.each_ref().map(|way| quantile_seconds(&way.times, 0.5) * 1e3);
    let figure = report.figure("people_detect, picture in, found out: median", "ms", linked);
    figure.relative_to("the same on the robot", alone).require(Target::RatioAtMost(1.05));
    figure.note(format!("640x480, {rounds} pictures each, in turns"));
    let memory = Process::from_pid(stub.pid()).proportional()?;
    report.figure("memory of its stub, after that", "MB", memory).require(Target::AtMost(15.0)).note("PSS");
    drop((ways, native));
    measure_idle(report, &stub)
}

/// Measures a connected stub without any requests.
fn measure_idle(report: &mut BenchReport, stub: &NodeProcess) -> Result<()> {
    let time = Duration::from_secs(if is_full_run() { 60 } else { 15 });
    // Work that ends with the last subscriber has finished after this.
    std::thread::sleep(Duration::from_secs(2));
    let process = Process::from_pid(stub.pid());
    let before = process.live_thread_time("")?;
    std::thread::sleep(time);
    let spent = process.live_thread_time("")? - before;
    let share = spent.as_secs_f64() / time.as_secs_f64() * 100.0;
    let figure = report.figure("processor, linked and idle", "% of a core", share);
    figure.require(Target::AtMost(0.1)).note(format!("over {} s", time.as_secs()));
    Ok(())
}
