//! A full disk: working robots continue, new ones are refused and admitted once there is space again, and every change
//! that was confirmed is still there after a restart.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{BenchReport, Target};
use nix::mount::{MntFlags, MsFlags, mount, umount2};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::greeters;
use crate::milliseconds::{median, worst};

/// Enough for the service and some servants.
const SIZE: &str = "size=1500M";
/// Working robots, and calls of each while the disk is full.
const ROBOTS: usize = 5;
const CALLS: usize = 100;
/// Changes of each kind that are requested while the disk is full.
const CHANGES: u32 = 5;

/// A file system in memory, mounted until drop.
struct Disk(PathBuf);

impl Disk {
    fn mount(place: &Path) -> Result<Self> {
        fs::create_dir_all(place)?;
        mount(Some("tmpfs"), place, Some("tmpfs"), MsFlags::empty(), Some(SIZE))?;
        Ok(Self(place.to_owned()))
    }

    fn filler(&self) -> PathBuf {
        self.0.join("filler")
    }

    /// Fills it completely.
    fn fill(&self) -> Result<()> {
        // Ends with an error when the disk is full.
        let _ = std::io::copy(&mut std::io::repeat(1), &mut File::create(self.filler())?);
        Ok(())
    }

    fn free(&self) -> Result<()> {
        Ok(fs::remove_file(self.filler())?)
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = umount2(&self.0, MntFlags::MNT_DETACH);
    }
}

#[derive(Debug, Default)]
struct FullDiskResult {
    asked: usize,
    failed: usize,
    refused: u32,
    recovered: u32,
    /// First answers to robots before the disk was ever full, and to new robots after space was freed.
    first: Vec<Duration>,
    again: Vec<Duration>,
    confirmed: usize,
    gone: Vec<String>,
}

/// Fills the disk of a separate daemon `rounds` times.
pub(crate) fn measure(report: &mut BenchReport, place: &Path, rounds: u32) -> Result<()> {
    let disk = Disk::mount(&place.join("small"))?;
    let home = disk.0.join("home");
    let measured = run_rounds(&disk, &home, rounds);
    greeters::end_leftovers(&home)?;
    measured?.add_figures(report, rounds);
    Ok(())
}

fn run_rounds(disk: &Disk, home: &Path, rounds: u32) -> Result<FullDiskResult> {
    let setup = greeters::publish(home)?;
    let mut daemon = setup.start()?;
    let mut outcome = FullDiskResult::default();
    let mut robots = Vec::new();
    for number in 0..ROBOTS {
        let (robot, took) = time_first_answer(&daemon, &format!("early-{number}"))?;
        robots.push(robot);
        outcome.first.push(took);
    }
    for round in 0..rounds {
        disk.fill()?;
        for robot in &mut robots {
            for _ in 0..CALLS {
                outcome.asked += 1;
                outcome.failed += usize::from(greeters::greeting_count(robot).is_err());
            }
        }
        let late = format!("late-{round}");
        outcome.refused += u32::from(time_first_answer(&daemon, &late).is_err());
        disk.free()?;
        let began = Instant::now();
        match greeters::ask_until_answered(&daemon, &late) {
            Ok(_) => {
                outcome.recovered += 1;
                outcome.again.push(began.elapsed());
            }
            Err(error) => eprintln!("{late}: {error:#}"),
        }
    }
    drop(robots);
    disk.fill()?;
    let confirmed = apply_changes(&daemon)?;
    disk.free()?;
    greeters::stop_all(&daemon)?;
    daemon.stop()?;
    daemon = setup.start()?;
    let kept = daemon.api("/api/v1/policy")?.to_string() + &daemon.api("/api/v1/tokens")?.to_string();
    outcome.confirmed = confirmed.len();
    outcome.gone = confirmed.into_iter().filter(|name| !kept.contains(&format!("\"{name}\""))).collect();
    daemon.stop()?;
    Ok(outcome)
}

fn time_first_answer(daemon: &Daemon, robot: &str) -> Result<(Robot, Duration)> {
    let began = Instant::now();
    let mut connection = Robot::connect(&daemon.url(&greeters::robot_path(robot)))?;
    greeters::greeting_count(&mut connection).context("no answer")?;
    Ok((connection, began.elapsed()))
}

/// Requests changes, each with a different name; returns the names of those that were confirmed.
fn apply_changes(daemon: &Daemon) -> Result<Vec<String>> {
    let mut confirmed = Vec::new();
    for number in 0..CHANGES {
        let rule = format!("ruled-{number}");
        let token = format!("shown-{number}");
        for (name, words) in [
            (&rule, ["policy", "allow", &rule, "call:/detect"]),
            (&token, ["token", "create", &token, "--role=viewer"]),
        ] {
            if daemon.deployer().run(&words)?.status == 0 {
                confirmed.push(name.clone());
            }
        }
    }
    Ok(confirmed)
}

impl FullDiskResult {
    fn add_figures(&self, report: &mut BenchReport, rounds: u32) {
        let title = "calls of robots at work that fail while the disk is full";
        report
            .figure(title, "", self.failed as f64)
            .require(Target::AtMost(0.0))
            .note(format!("of {}, by {ROBOTS} robots in {rounds} rounds", self.asked));
        let title = format!("new robots answered once there is room again, of {rounds}");
        report
            .figure(title, "", f64::from(self.recovered))
            .require(Target::AtLeast(f64::from(rounds)))
            .note(format!("{} of them were refused before", self.refused));
        report
            .figure("until they are", "ms", median(&self.again))
            .relative_to("a robot's first answer", median(&self.first))
            .note(format!("medians; at worst {:.0} ms", worst(&self.again)));
        let title = "changes that were confirmed on a full disk and are gone after a restart";
        report.figure(title, "", self.gone.len() as f64).require(Target::AtMost(0.0)).note(format!(
            "of {} that were confirmed, of {} that were asked for; gone: {:?}",
            self.confirmed,
            2 * CHANGES,
            self.gone
        ));
    }
}
