//! A full disk: robots at work work on, whoever is new is refused and let in once there is room, and what was answered with success is there
//! after a restart.

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use bench_report::{Report, Target};
use nix::mount::{MntFlags, MsFlags, mount, umount2};
use support::daemon::Daemon;
use support::robot::Robot;

use crate::greeters;
use crate::milliseconds::{median, worst};

/// As large as the service and some servants need.
const SIZE: &str = "size=1500M";
/// Robots at work, and calls of each while the disk is full.
const ROBOTS: usize = 5;
const CALLS: usize = 100;
/// Changes that are asked for while it is full, of each kind.
const CHANGES: u32 = 5;

/// A disk of memory, mounted for as long as this is there.
struct Disk(PathBuf);

impl Disk {
    fn mount(place: &Path) -> Result<Self> {
        fs::create_dir_all(place)?;
        mount(
            Some("tmpfs"),
            place,
            Some("tmpfs"),
            MsFlags::empty(),
            Some(SIZE),
        )?;
        Ok(Self(place.to_owned()))
    }

    fn filler(&self) -> PathBuf {
        self.0.join("filler")
    }

    /// Leaves no room on it.
    fn fill(&self) -> Result<()> {
        // Ends when nothing more fits.
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
struct Outcome {
    asked: usize,
    failed: usize,
    refused: u32,
    recovered: u32,
    /// First answers to robots before the disk was ever full, and to new ones after there was room again.
    first: Vec<Duration>,
    again: Vec<Duration>,
    confirmed: usize,
    gone: Vec<String>,
}

/// Fills the disk of a daemon of its own in so many rounds.
pub(crate) fn measure(report: &mut Report, place: &Path, rounds: u32) -> Result<()> {
    let disk = Disk::mount(&place.join("small"))?;
    let home = disk.0.join("home");
    let measured = measure_on(&disk, &home, rounds);
    greeters::end_left(&home)?;
    measured?.tell(report, rounds);
    Ok(())
}

fn measure_on(disk: &Disk, home: &Path, rounds: u32) -> Result<Outcome> {
    let setup = greeters::publish(home)?;
    let mut daemon = setup.start()?;
    let mut outcome = Outcome::default();
    let mut robots = Vec::new();
    for number in 0..ROBOTS {
        let (robot, took) = first_answer(&daemon, &format!("early-{number}"))?;
        robots.push(robot);
        outcome.first.push(took);
    }
    for round in 0..rounds {
        disk.fill()?;
        for robot in &mut robots {
            for _ in 0..CALLS {
                outcome.asked += 1;
                outcome.failed += usize::from(greeters::count(robot).is_err());
            }
        }
        let late = format!("late-{round}");
        outcome.refused += u32::from(first_answer(&daemon, &late).is_err());
        disk.free()?;
        let began = Instant::now();
        match greeters::ask_again(&daemon, &late) {
            Ok(_) => {
                outcome.recovered += 1;
                outcome.again.push(began.elapsed());
            }
            Err(error) => eprintln!("{late}: {error:#}"),
        }
    }
    drop(robots);
    disk.fill()?;
    let confirmed = change(&daemon)?;
    disk.free()?;
    greeters::stop_all(&daemon)?;
    daemon.ends()?;
    daemon = setup.start()?;
    let kept =
        daemon.api("/api/v1/policy")?.to_string() + &daemon.api("/api/v1/tokens")?.to_string();
    outcome.confirmed = confirmed.len();
    outcome.gone = confirmed
        .into_iter()
        .filter(|name| !kept.contains(&format!("\"{name}\"")))
        .collect();
    daemon.ends()?;
    Ok(outcome)
}

fn first_answer(daemon: &Daemon, robot: &str) -> Result<(Robot, Duration)> {
    let began = Instant::now();
    let mut connection = Robot::connect(&daemon.url(&greeters::path(robot)))?;
    greeters::count(&mut connection).context("no answer")?;
    Ok((connection, began.elapsed()))
}

/// Asks for changes, each about a name of its own; returns the names of those that were answered with success.
fn change(daemon: &Daemon) -> Result<Vec<String>> {
    let mut confirmed = Vec::new();
    for number in 0..CHANGES {
        let rule = format!("ruled-{number}");
        let token = format!("shown-{number}");
        for (name, words) in [
            (&rule, ["policy", "allow", &rule, "call:/detect"]),
            (&token, ["token", "create", &token, "--role=viewer"]),
        ] {
            if daemon.deployer().types(&words)?.status == 0 {
                confirmed.push(name.clone());
            }
        }
    }
    Ok(confirmed)
}

impl Outcome {
    fn tell(&self, report: &mut Report, rounds: u32) {
        report
            .figure(
                "calls of robots at work that fail while the disk is full",
                "",
                self.failed as f64,
            )
            .reach(Target::AtMost(0.0))
            .note(format!(
                "of {}, by {ROBOTS} robots in {rounds} rounds",
                self.asked
            ));
        report
            .figure(
                format!("new robots answered once there is room again, of {rounds}"),
                "",
                f64::from(self.recovered),
            )
            .reach(Target::AtLeast(f64::from(rounds)))
            .note(format!("{} of them were refused before", self.refused));
        report
            .figure("until they are", "ms", median(&self.again))
            .beside("a robot's first answer", median(&self.first))
            .note(format!("medians; at worst {:.0} ms", worst(&self.again)));
        report
            .figure(
                "changes that were confirmed on a full disk and are gone after a restart",
                "",
                self.gone.len() as f64,
            )
            .reach(Target::AtMost(0.0))
            .note(format!(
                "of {} that were confirmed, of {} that were asked for; gone: {:?}",
                self.confirmed,
                2 * CHANGES,
                self.gone
            ));
    }
}
