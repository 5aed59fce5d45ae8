//! What the servant's node received of pictures whose codec loses something: `cloudroidctl record` hears it in the servant, and each picture
//! is compared with the one that was sent.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, Result, ensure};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde::{Deserialize, Serialize};
use support::binaries;
use support::daemon::Daemon;

use super::{CLASS, PACKAGE, Sources, What, plan};
use crate::deadline;
use crate::place::Place;
use crate::recording::{Recording, header};
use crate::robot::{FIRST, WARM_UP};
use crate::statistics::psnr;

/// Between two tries to record a servant that is not there yet.
const AGAIN: Duration = Duration::from_millis(200);
/// For a recording to end that was asked to.
const END: Duration = Duration::from_secs(60);
/// Bytes of a picture.
const PIXELS: usize = 640 * 480 * 3;

/// Pictures as they came.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Received {
    /// Of each picture that has changed, dB.
    pub(super) psnr: Vec<f64>,
    /// Pictures that came as they were sent.
    pub(super) exact: usize,
}

/// Sends such a stream, and hears it in the servant.
pub(super) fn measure(sources: &Sources, what: &What) -> Result<Received> {
    let workshop = sources.workshop;
    let directory = workshop.directory()?;
    let plan = plan(sources, what, directory.path())?;
    let file = directory.path().join("received.mcap");
    let place = Place::new(&workshop.daemon.address, CLASS, what.network)?;
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        let recorder = scope.spawn(|| records(workshop.daemon, &file, &over));
        let ran = place.runs(&plan, directory.path());
        over.store(true, Ordering::Relaxed);
        let recorder = recorder.join().expect("the thread does not panic");
        let ended = recorder.and_then(ends);
        ran?;
        ended
    })?;
    let recording = Recording::read(&plan.recording)?;
    let steps = recording.steps(&plan.request);
    let mut reader = ::recording::Reader::open(&file)?;
    let mut received = Received::default();
    while let Some(played) = reader.next_message()? {
        let number = header(&played.message).and_then(|header| header.stamp.0.checked_sub(FIRST));
        let Some(number) = number.map(|number| number as usize) else {
            continue;
        };
        if number >= what.length.settle && played.topic == plan.request {
            let step = steps.get(WARM_UP + number);
            let sent = step.context("a picture that was never sent")?;
            received.adds(&sent.request.bytes, &played.message)?;
        }
    }
    ensure!(
        received.exact + received.psnr.len() > 0,
        "no picture was recorded in the servant"
    );
    Ok(received)
}

impl Received {
    fn adds(&mut self, sent: &[u8], came: &[u8]) -> Result<()> {
        let pixels = |message: &[u8]| {
            let begin = message.len().checked_sub(PIXELS);
            begin.map(|begin| message[begin..].to_vec())
        };
        let both = pixels(sent).zip(pixels(came));
        let (sent, came) = both.context("a picture of another size")?;
        match psnr(&sent, &came) {
            exact if exact.is_infinite() => self.exact += 1,
            lossy => self.psnr.push(lossy),
        }
        Ok(())
    }
}

/// Starts to record, once there is a servant.
fn records(daemon: &Daemon, file: &Path, over: &AtomicBool) -> Result<Child> {
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
        if line.contains("Ctrl-C ends it") {
            // Nobody waits for the rest, and a full pipe would stop it.
            std::thread::spawn(move || std::io::copy(&mut said, &mut std::io::sink()));
            return Ok(child);
        }
        // Whatever else it said, it does not record.
        let _ = child.kill();
        child.wait()?;
        ensure!(
            !over.load(Ordering::Relaxed),
            "the servant could not be recorded: {}",
            line.trim()
        );
        std::thread::sleep(AGAIN);
    }
}

/// Ends the recording as Ctrl-C does.
fn ends(mut child: Child) -> Result<()> {
    kill(Pid::from_raw(i32::try_from(child.id())?), Signal::SIGINT)?;
    let status = deadline::ends(&mut child, "cloudroidctl record", END)?;
    ensure!(status.success(), "cloudroidctl record ended with {status}");
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exact_pictures_have_no_noise() {
        let picture = |shade: u8| [vec![7; 60], vec![shade; PIXELS]].concat();
        let mut received = Received::default();
        received.adds(&picture(9), &picture(9)).expect("pictures");
        received.adds(&picture(9), &picture(10)).expect("pictures");
        assert_eq!(received.exact, 1);
        // A mean squared error of 1: 20 lg 255.
        assert!((received.psnr[0] - 48.1308).abs() < 1e-3, "{received:?}");
        assert!(received.adds(&picture(9), &[0; 3]).is_err());
    }
}
