//! Images that the servant's node received with a lossy codec: `cloudroidctl record` records them in the servant, and
//! each one is compared with the image that was sent.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use bench_report::Psnr;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};
use support::binaries;
use support::daemon::Daemon;

use super::{CLASS, PACKAGE, StreamSources, StreamSpec, robot_plan};
use crate::deadline;
use crate::place::RobotSandbox;
use crate::recording::{Recording, read_header};
use crate::robot::{FIRST, WARM_UP};

/// Interval between attempts to record a servant that does not exist yet.
const AGAIN: Duration = Duration::from_millis(200);
/// Maximum time for a recording to end after it was asked to.
const END: Duration = Duration::from_secs(60);
/// Bytes of an image.
const PIXELS: usize = 640 * 480 * 3;

/// Quality of the received images.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct ReceivedPictures {
    /// Peak signal-to-noise ratio of each image that has changed, in dB.
    pub(super) psnr: Vec<f64>,
    /// Number of images that arrived unchanged.
    pub(super) exact: usize,
}

/// Sends such a stream and records it in the servant.
pub(super) fn measure(sources: &StreamSources, what: &StreamSpec) -> Result<ReceivedPictures> {
    let workshop = sources.workshop;
    let directory = workshop.directory()?;
    let plan = robot_plan(sources, what, directory.path())?;
    let file = directory.path().join("received.mcap");
    let place = RobotSandbox::new(&workshop.daemon.address, CLASS, what.network)?;
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let recorder = scope.spawn(|| start_recording(workshop.daemon, &file, &over));
        let ran = place.run(&plan, directory.path());
        over.store(true, Ordering::Relaxed);
        let recorder = recorder.join().expect("the thread does not panic");
        let ended = recorder.and_then(stop_recording);
        ran?;
        ended
    })?;
    let recording = Recording::read(&plan.recording)?;
    let steps = recording.steps(&plan.request);
    let mut reader = ::recording::RecordingReader::open(&file)?;
    let mut received = ReceivedPictures::default();
    while let Some(played) = reader.next_message()? {
        let number = read_header(&played.message).and_then(|header| header.stamp.0.checked_sub(FIRST));
        let Some(number) = number.map(|number| number as usize) else {
            continue;
        };
        if number >= what.length.settle && played.topic == plan.request {
            let step = steps.get(WARM_UP + number);
            let sent = step.context("a picture that was never sent")?;
            received.add(&sent.request.bytes, &played.message)?;
        }
    }
    ensure!(received.exact + received.psnr.len() > 0, "no picture was recorded in the servant");
    Ok(received)
}

impl ReceivedPictures {
    fn add(&mut self, sent: &[u8], came: &[u8]) -> Result<()> {
        let pixels = |message: &[u8]| {
            let begin = message.len().checked_sub(PIXELS);
            begin.map(|begin| message[begin..].to_vec())
        };
        let both = pixels(sent).zip(pixels(came));
        let (sent, came) = both.context("a picture of another size")?;
        if sent == came {
            self.exact += 1;
            return Ok(());
        }
        let mut noise = Psnr::default();
        noise.add(&came, &sent);
        self.psnr.push(noise.decibels());
        Ok(())
    }
}

/// Starts the recording as soon as there is a servant.
fn start_recording(daemon: &Daemon, file: &Path, over: &AtomicBool) -> Result<Child> {
    loop {
        let mut child = Command::new(binaries::path("cloudroidctl"))
            .args(["record", PACKAGE, "--topic", "/image", "-o"])
            .arg(file)
            .env("CLOUDROID_HOME", &daemon.deployer().home)
            .env_remove("CLOUDROID_SERVER")
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()?;
        let mut said = BufReader::new(child.stderr.take().context("piped")?);
        let mut line = String::new();
        said.read_line(&mut line)?;
        if line.contains("stop with Ctrl-C") {
            // The remaining output is discarded, because a full pipe would block the program.
            std::thread::spawn(move || std::io::copy(&mut said, &mut std::io::sink()));
            return Ok(child);
        }
        // With any other output, it does not record.
        let _ = child.kill();
        child.wait()?;
        ensure!(!over.load(Ordering::Relaxed), "the servant could not be recorded: {}", line.trim());
        std::thread::sleep(AGAIN);
    }
}

/// Ends the recording with SIGINT, as Ctrl-C does.
fn stop_recording(mut child: Child) -> Result<()> {
    kill(Pid::from_raw(i32::try_from(child.id())?), Signal::SIGINT)?;
    let status = deadline::wait_for_exit(&mut child, "cloudroidctl record", END)?;
    ensure!(status.success(), "cloudroidctl record ended with {status}");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_pictures_have_no_noise() {
        let picture = |shade: u8| [vec![7; 60], vec![shade; PIXELS]].concat();
        let mut received = ReceivedPictures::default();
        received.add(&picture(9), &picture(9)).expect("pictures");
        received.add(&picture(9), &picture(10)).expect("pictures");
        assert_eq!(received.exact, 1);
        // For a mean squared error of 1: 20 lg 255.
        assert!((received.psnr[0] - 48.1308).abs() < 1e-3, "{received:?}");
        assert!(received.add(&picture(9), &[0; 3]).is_err());
    }
}
