//! A robot application that was not written for this evaluation: `rosbag play` and `rosbag record` from Debian's
//! packages, in the robot's own file system. One plays the recording, the other records the answers.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use sha2::{Digest, Sha256};
use support::machine;
use support::site::{NodeProcess, Site};

use crate::recording::{read_header, read_pose};
use crate::robot::{RobotPlan, digest_message, has_ended};
use crate::trace::{RequestSample, Trace};

const PLAY: &str = "/usr/lib/rosbag/play";
const RECORD: &str = "/usr/lib/rosbag/record";
/// Files of the programs that play and record.
const FILES: [&str; 2] = [PLAY, RECORD];
/// Seconds between advertising and playing.
const CONNECT: &str = "4";
/// Time without an answer after which none is expected any more.
const SILENCE: Duration = Duration::from_secs(2);
/// Maximum time for a program to exit after it was asked to.
const END: Duration = Duration::from_secs(30);
const LOOK: Duration = Duration::from_millis(20);

/// Returns the programs' files with their SHA-256. Builds the robots' file system if it does not exist, which needs the
/// network.
pub fn checksums() -> Result<Vec<(String, String)>> {
    let base = machine::base()?;
    let one = |file: &&str| -> Result<(String, String)> {
        let path = base.join(file.trim_start_matches('/'));
        let bytes = std::fs::read(&path).with_context(|| path.display().to_string())?;
        Ok(((*file).to_owned(), format!("{:x}", Sha256::digest(bytes))))
    };
    FILES.iter().map(one).collect()
}

/// Plays `seconds` of the recording to `node`; the trace contains the recorded answers.
pub fn run(site: &Site, plan: &RobotPlan, seconds: f64, node: &NodeProcess) -> Result<Trace> {
    let place = tempfile::tempdir()?;
    let shared = place.path().join("shared");
    std::fs::create_dir(&shared)?;
    std::fs::copy(&plan.recording, shared.join("recording.bag"))?;
    let begun = Instant::now();
    let bystander = site.node("/bystander")?;
    let mut heard = site.subscribe(&bystander, &plan.answer)?;
    let mut record = RosbagProgram::start(site, place.path(), RECORD, &["-O", "/mnt/heard.bag", &plan.answer])?;
    site.wait_for_graph(&bystander, "a node that answers, and a recorder", |graph| {
        let ends = graph.topics.get(&*plan.answer);
        ends.is_some_and(|ends| !ends.publishers.is_empty() && ends.subscribers.len() > 1)
    })?;
    let duration = seconds.to_string();
    // rosbag has its own way to wait until subscribers have connected.
    let mut words = vec!["-q", "--wait-for-subscribers", "--duration", &duration];
    words.extend(["--delay", CONNECT]);
    words.extend(["--bags=/mnt/recording.bag", "--topics", &plan.request]);
    words.extend(plan.besides.iter().map(String::as_str));
    let mut play = RosbagProgram::start(site, place.path(), PLAY, &words)?;
    let patience = Duration::from_secs_f64(plan.patience);
    while !play.has_ended()? {
        ensure!(
            begun.elapsed() < patience && !has_ended(node),
            "{PLAY} is not done after {:.0} s: {}",
            begun.elapsed().as_secs_f64(),
            play.output()
        );
        std::thread::sleep(LOOK);
    }
    while site.next_message_within(&mut heard, SILENCE)?.is_some() {}
    record.stop()?;
    let file = Bytes::from(std::fs::read(shared.join("heard.bag")).with_context(|| record.output())?);
    let messages = ros::bag::read(&file, usize::MAX)?;
    let first = messages.first().map_or(0, |message| message.time);
    let answer = |message: &ros::bag::BagMessage| {
        let (seconds, nanoseconds) = read_header(&message.bytes)?.stamp;
        Some(RequestSample {
            at: (message.time - first) as f64 / 1e9,
            stamp: f64::from(seconds) + f64::from(nanoseconds) / 1e9,
            pose: read_pose(&message.bytes),
            digest: Some(digest_message(&message.bytes)),
            ..RequestSample::default()
        })
    };
    Ok(Trace {
        requests: messages.iter().filter_map(answer).collect(),
        lasted: begun.elapsed().as_secs_f64(),
        ..Trace::default()
    })
}

/// A program in the robots' file system, which is read-only to it; `/mnt` is shared with other programs.
struct RosbagProgram {
    child: Child,
    log: PathBuf,
}

impl RosbagProgram {
    fn start(site: &Site, place: &Path, program: &str, words: &[&str]) -> Result<Self> {
        let name = program.rsplit('/').next().unwrap_or(program);
        let (root, log) = (place.join(name), place.join(format!("{name}.log")));
        std::fs::create_dir(&root)?;
        let script = format!(
            "mount --bind {base} {root} && mount -o remount,bind,ro {root} && mount --rbind /dev {root}/dev && mount \
             -t proc proc {root}/proc \
             && mount -t tmpfs none {root}/root && mount -t tmpfs none {root}/tmp && mount --bind {shared} {root}/mnt \
             && exec chroot {root} \"$@\"",
            base = machine::base()?.display(),
            root = root.display(),
            shared = place.join("shared").display(),
        );
        let said = File::create(&log)?;
        let child = Command::new("unshare")
            .args(["--mount", "sh", "-c", &script, "sh", program])
            .args(words)
            .env("HOME", "/root")
            .env("ROS_IP", "127.0.0.1")
            .env("ROS_MASTER_URI", format!("http://{}", site.master()?))
            .stdin(Stdio::null())
            .stdout(said.try_clone()?)
            .stderr(said)
            .spawn()
            .context("unshare, of util-linux")?;
        Ok(Self { child, log })
    }

    fn output(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap_or_default()
    }

    /// Returns whether it has exited; fails if it exited with an error.
    fn has_ended(&mut self) -> Result<bool> {
        match self.child.try_wait()? {
            Some(status) => {
                ensure!(status.success(), "{status}: {}", self.output());
                Ok(true)
            }
            None => Ok(false),
        }
    }

    /// Sends SIGINT, as Ctrl-C does, and waits for its end.
    fn stop(&mut self) -> Result<()> {
        kill(Pid::from_raw(self.child.id() as i32), Signal::SIGINT)?;
        let begun = Instant::now();
        while !self.has_ended()? {
            ensure!(begun.elapsed() < END, "it does not end: {}", self.output());
            std::thread::sleep(LOOK);
        }
        Ok(())
    }
}

impl Drop for RosbagProgram {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
