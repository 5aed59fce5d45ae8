//! How stories are told: what happens when one fails by chance, when a run is killed, and where the machine lacks something.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};

use anyhow::{Context, ensure};
use support::Verdict;
use support::deployer::{Outcome, path_str, run};
use support::leftovers;
use support::world::{Directory, PREFIX, world};

use crate::rehearsal;

/// A run of rehearsals that keeps what it finds in a directory of its own.
fn rehearse(place: &Directory, names: &[&str]) -> anyhow::Result<Command> {
    let mut command = Command::new(std::env::current_exe()?);
    command
        .args(names)
        .env(rehearsal::VARIABLE, "1200")
        .env("CLOUDROID_TARGET", place.path().join("target"))
        .env("TMPDIR", place.path())
        .env_remove("STRICT");
    std::fs::create_dir_all(place.path().join("target"))?;
    Ok(command)
}

/// Runs a shell script in a mount namespace of its own; `$@` is a run of rehearsals.
fn rehearse_where(place: &Directory, script: &str) -> anyhow::Result<Outcome> {
    let rehearsal = rehearse(place, &["rehearsal::passes"])?;
    let script = format!("set -e\n{script}");
    let mut shell = Command::new("unshare");
    shell.args([
        "--mount",
        "--propagation",
        "private",
        "sh",
        "-c",
        &script,
        "sh",
    ]);
    shell
        .arg(rehearsal.get_program())
        .args(rehearsal.get_args());
    shell.current_dir(place.path());
    for (key, value) in rehearsal.get_envs() {
        match value {
            Some(value) => shell.env(key, value),
            None => shell.env_remove(key),
        };
    }
    run(&mut shell)
}

/// A directory for devices in which there are no loop devices.
const WITHOUT_LOOP: &str =
    "mount -t tmpfs none /dev\nmknod -m 666 /dev/null c 1 3\nmknod -m 666 /dev/urandom c 1 9\n";

pub fn one_that_fails_once_is_told_again_and_its_world_is_kept() -> Verdict {
    let place = world().directory("telling")?;
    let outcome = run(&mut rehearse(
        &place,
        &["rehearsal::passes", "fails_once", "panics_once"],
    )?)?
    .succeeded()?;
    for said in [
        "FLAKY rehearsal::fails_once: it fails the first time",
        "FLAKY rehearsal::panics_once: panicked: it panics the first time",
        "\n3 passed, 0 failed",
    ] {
        ensure!(
            outcome.stdout.contains(said),
            "{said:?} is not in {}",
            outcome.said()
        );
    }
    let target = place.path().join("target");
    let flaky = std::fs::read_to_string(target.join("flaky.json"))?;
    ensure!(flaky.lines().count() == 2, "a line for each: {flaky}");
    let kept = target.join("stories/rehearsal/fails_once");
    let read =
        |name: &str| std::fs::read_to_string(kept.join(name)).with_context(|| name.to_owned());
    for (name, word) in [
        ("reason", "it fails the first time"),
        ("reason", "seed: "),
        ("machine", "/proc/loadavg"),
        ("ps", "PID"),
        ("homes/rehearsal/daemon.log", "listen"),
        ("homes/rehearsal/events.jsonl", "greeter_cpp"),
    ] {
        ensure!(read(name)?.contains(word), "{name}: {}", read(name)?);
    }
    let directories = std::fs::read_dir(kept.join("directories"))?.flatten();
    let notes = directories.filter(|directory| directory.path().join("note").exists());
    ensure!(notes.count() == 1, "its directory is kept");
    Ok(())
}

pub fn more_than_two_by_chance_fail_the_run_and_strictly_the_first() -> Verdict {
    let place = world().directory("telling")?;
    let once = ["fails_once", "is_missed_once", "times_out_once"];
    let outcome = run(&mut rehearse(&place, &once)?)?;
    outcome.failed_saying(&[
        "more than 2 stories failed and then passed",
        "3 passed, 0 failed",
    ])?;
    let strictly = run(rehearse(&place, &["is_missed_once"])?.env("STRICT", "1"))?;
    ensure!(strictly.status == 1, "{}", strictly.said());
    ensure!(
        !strictly.said().contains("FLAKY"),
        "it is not told again: {}",
        strictly.said()
    );
    let outcome = run(&mut rehearse(
        &place,
        &["rehearsal::fails", "rehearsal::passes", "--exact"],
    )?)?;
    outcome.failed_saying(&[
        "== failed: rehearsal::fails\nit always fails",
        "1 passed, 1 failed",
    ])?;
    run(&mut rehearse(&place, &["nobody"])?)?.failed_saying(&["no story is called nobody"])?;
    Ok(())
}

pub fn one_without_an_end_is_named_and_ends_the_run() -> Verdict {
    let place = world().directory("telling")?;
    let names = ["rehearsal::passes", "rehearsal::has_no_end"];
    let outcome = run(rehearse(&place, &names)?.env(rehearsal::VARIABLE, "2"))?;
    outcome.failed_saying(&[
        "test rehearsal::passes ... ok",
        "== failed: rehearsal::has_no_end has no end",
    ])?;
    Ok(())
}

pub fn what_the_machine_lacks_is_said_in_a_line() -> Verdict {
    let place = world().directory("telling")?;
    // The program is below root's home, where others reach it by a descriptor alone.
    let by_nobody =
        "exec 3<\"$1\"; shift; exec setpriv --reuid=65534 --clear-groups /proc/self/fd/3 \"$@\"";
    rehearse_where(&place, by_nobody)?
        .failed_saying(&["servants are started by root: sudo make stories"])?;
    let without_cgroups = "mount -t tmpfs none /sys/fs/cgroup; \"$@\"";
    rehearse_where(&place, without_cgroups)?
        .failed_saying(&["no cgroups with limits are mounted"])?;
    let without_loop = format!("{WITHOUT_LOOP}\"$@\"");
    let outcome = rehearse_where(&place, &without_loop)?.succeeded()?;
    ensure!(
        outcome
            .stdout
            .contains("no disk of their own for the stories' homes"),
        "{}",
        outcome.said()
    );
    let full = "mkdir full; mount -t tmpfs -o size=64M none full; TMPDIR=$PWD/full XDG_CACHE_HOME=$PWD/full \"$@\"";
    rehearse_where(&place, full)?
        .failed_saying(&["GB free, and homes take 12 GB: make room there"])?;
    let on_overlay = format!(
        "{WITHOUT_LOOP}mkdir -p lower upper work over; mount -t overlay -o lowerdir=lower,upperdir=upper,workdir=work none over; TMPDIR=$PWD/over \"$@\""
    );
    rehearse_where(&place, &on_overlay)?
        .failed_saying(&["cannot hold the upper directories of overlays", "TMPDIR"])?;
    Ok(())
}

/// A run of rehearsals that is at work.
struct Run(Child);

impl Run {
    fn with_a_servant(place: &Directory) -> anyhow::Result<Run> {
        let mut run = Run(rehearse(place, &["waits"])?
            .stdout(Stdio::piped())
            .spawn()?);
        let lines = BufReader::new(run.0.stdout.take().context("piped")?).lines();
        let mut said = Vec::new();
        for line in lines {
            let line = line?;
            if line.contains("a servant is at work") {
                return Ok(run);
            }
            said.push(line);
        }
        anyhow::bail!("it ended: {said:#?}")
    }

    fn is_killed(&mut self) -> Verdict {
        self.0.kill()?;
        self.0.wait()?;
        Ok(())
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        let _ = self.is_killed();
    }
}

fn places(parent: &Path) -> anyhow::Result<Vec<std::path::PathBuf>> {
    let entries = std::fs::read_dir(parent)?
        .flatten()
        .map(|entry| entry.path());
    let is_place = |path: &std::path::PathBuf| {
        path.file_name()
            .is_some_and(|name| name.to_string_lossy().starts_with(PREFIX))
    };
    Ok(entries.filter(is_place).collect())
}

pub fn what_a_killed_run_left_is_removed_by_the_next_and_a_living_one_is_left_alone() -> Verdict {
    let place = world().directory("telling")?;
    let mut first = Run::with_a_servant(&place)?;
    let passes = || run(&mut rehearse(&place, &["rehearsal::passes"])?)?.succeeded();
    let outcome = passes()?;
    ensure!(
        !outcome.stdout.contains("removed"),
        "the first is at work: {}",
        outcome.said()
    );
    let [left] = &places(place.path())?[..] else {
        anyhow::bail!("{:?}", places(place.path())?);
    };
    first.is_killed()?;
    ensure!(
        !leftovers::of(left).is_empty(),
        "its daemon and its servant are there"
    );
    let outcome = passes()?;
    let removed = format!("removed {}", path_str(left));
    ensure!(outcome.stdout.contains(&removed), "{}", outcome.said());
    let there = leftovers::of(left);
    ensure!(there.is_empty() && !left.exists(), "{there:#?}");
    Ok(())
}
