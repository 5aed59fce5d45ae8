//! A robot application that was not written for this evaluation: `rosbag play` and `rosbag record` from Debian's
//! packages, in the robot's own file system. One plays the recording, the other records the answers.

use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, ensure};
use bytes::Bytes;
use nix::sys::signal::Signal;
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
    let record = start_program(site, place.path(), RECORD, &["-O", "/mnt/heard.bag", &plan.answer])?;
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
    let play = start_program(site, place.path(), PLAY, &words)?;
    let patience = Duration::from_secs_f64(plan.patience);
    while !has_ended(&play) {
        ensure!(
            begun.elapsed() < patience && !has_ended(node),
            "{PLAY} is not done after {:.0} s: {}",
            begun.elapsed().as_secs_f64(),
            play.output()
        );
        std::thread::sleep(LOOK);
    }
    expect_success(play)?;
    while site.next_message_within(&mut heard, SILENCE)?.is_some() {}
    // As Ctrl-C does.
    record.signal(Signal::SIGINT)?;
    expect_success(record)?;
    let file = Bytes::from(std::fs::read(shared.join("heard.bag")).context("the recorded answers")?);
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

/// Starts a program in the robots' file system, which is read-only to it; `/mnt` is shared with other programs.
fn start_program(site: &Site, place: &Path, program: &str, words: &[&str]) -> Result<NodeProcess> {
    let root = place.join(program.rsplit('/').next().unwrap_or(program));
    std::fs::create_dir(&root)?;
    let script = format!(
        "mount --bind {base} {root} && mount -o remount,bind,ro {root} && mount --rbind /dev {root}/dev && mount -t \
         proc proc {root}/proc && mount -t tmpfs none {root}/root && mount -t tmpfs none {root}/tmp && mount --bind \
         {shared} {root}/mnt && exec chroot {root} \"$@\"",
        base = machine::base()?.display(),
        root = root.display(),
        shared = place.join("shared").display(),
    );
    site.start_in_image(&script, program, &words.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>())
}

/// Waits for the end of a program, which must succeed.
fn expect_success(mut program: NodeProcess) -> Result<()> {
    let status = program.wait_for_exit()?;
    ensure!(status.success(), "{status}: {}", program.output());
    Ok(())
}
