//! The runner of the stories: stories that fail by chance, runs that are killed, and machines that lack something.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, SystemTime};

use anyhow::{Context, ensure};
use support::Verdict;
use support::deployer::{CommandOutcome, path_str, run};
use support::world::{Directory, PREFIX, world};
use support::{claim, evidence, leftovers};

use crate::rehearsal;

/// Returns the command of a rehearsal run with a target directory of its own.
fn rehearse_command(place: &Directory, names: &[&str]) -> anyhow::Result<Command> {
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

/// Runs a shell script in a separate mount namespace; `$@` is a rehearsal run.
fn rehearse_where(place: &Directory, script: &str) -> anyhow::Result<CommandOutcome> {
    let rehearsal = rehearse_command(place, &["rehearsal::passes"])?;
    let script = format!("set -e\n{script}");
    let mut shell = Command::new("unshare");
    shell.args(["--mount", "--propagation", "private", "sh", "-c", &script, "sh"]);
    shell.arg(rehearsal.get_program()).args(rehearsal.get_args());
    shell.current_dir(place.path());
    for (key, value) in rehearsal.get_envs() {
        match value {
            Some(value) => shell.env(key, value),
            None => shell.env_remove(key),
        };
    }
    run(&mut shell)
}

/// Mounts a /dev without loop devices.
const WITHOUT_LOOP: &str = "mount -t tmpfs none /dev\nmknod -m 666 /dev/null c 1 3\nmknod -m 666 /dev/urandom c 1 9\n";

pub fn one_that_fails_once_is_told_again_and_its_world_is_kept() -> Verdict {
    let place = world().directory("telling")?;
    let outcome =
        run(&mut rehearse_command(&place, &["rehearsal::passes", "fails_once", "panics_once"])?)?.expect_success()?;
    for said in [
        "FLAKY rehearsal::fails_once: it fails the first time",
        "FLAKY rehearsal::panics_once: panicked: it panics the first time",
        "\n3 passed, 0 failed",
    ] {
        ensure!(outcome.stdout.contains(said), "{said:?} is not in {}", outcome.output());
    }
    let target = place.path().join("target");
    let flaky = std::fs::read_to_string(target.join("flaky.json"))?;
    ensure!(flaky.lines().count() == 2, "a line for each: {flaky}");
    let kept = target.join("stories/rehearsal/fails_once");
    let read = |name: &str| std::fs::read_to_string(kept.join(name)).with_context(|| name.to_owned());
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

pub fn evidence_is_cut_in_the_middle_and_the_oldest_goes_first() -> Verdict {
    let place = world().directory("evidence")?;
    let (from, to) = (place.path().join("long.log"), place.path().join("cut.log"));
    let lines: String = (0..100_000).map(|number| format!("line {number}\n")).collect();
    std::fs::write(&from, &lines)?;
    evidence::copy_cut(&from, &to, 10_000)?;
    let cut = std::fs::read_to_string(&to)?;
    ensure!(cut.starts_with("line 0\n") && cut.ends_with("\nline 99999\n") && cut.len() < 10_100, "{cut}");
    ensure!(cut.contains(&format!("\n[{} bytes are left out here]\n", lines.len() - 10_000)), "{cut}");
    evidence::copy_cut(&from, &to, lines.len() as u64)?;
    ensure!(std::fs::read_to_string(&to)? == lines, "what is short enough is kept as it is");
    let omitted = place.path().join("omitted");
    std::fs::write(&from, vec![0; 100_000])?;
    ensure!(evidence::copy_cut(&from, &omitted, 10_000)? == 0 && !omitted.exists(), "a part of it is of no use");
    // The size in all.
    let root = place.path().join("stories");
    let keep = |name: &str, age: u64| -> anyhow::Result<PathBuf> {
        let kept = root.join(name);
        std::fs::create_dir_all(kept.join("homes"))?;
        std::fs::write(kept.join("homes/daemon.log"), vec![b'x'; 1000])?;
        let reason = std::fs::File::create(kept.join("reason"))?;
        reason.set_modified(SystemTime::now() - Duration::from_secs(age))?;
        Ok(kept)
    };
    let (oldest, old, newest) = (keep("a/first", 300)?, keep("b/second", 200)?, keep("a/third", 100)?);
    evidence::bound(&root, &newest, 2500);
    ensure!(!oldest.exists() && old.exists() && newest.exists());
    evidence::bound(&root, &newest, 10);
    ensure!(!old.exists() && newest.exists(), "that of the story that failed last stays");
    Ok(())
}

pub fn more_than_two_by_chance_fail_the_run_and_strictly_the_first() -> Verdict {
    let place = world().directory("telling")?;
    let once = ["fails_once", "is_missed_once", "times_out_once"];
    let outcome = run(&mut rehearse_command(&place, &once)?)?;
    outcome.expect_failure(&["more than 2 stories failed and then passed", "3 passed, 0 failed"])?;
    let strictly = run(rehearse_command(&place, &["is_missed_once"])?.env("STRICT", "1"))?;
    ensure!(strictly.status == 1, "{}", strictly.output());
    ensure!(!strictly.output().contains("FLAKY"), "it is not told again: {}", strictly.output());
    let outcome = run(&mut rehearse_command(&place, &["rehearsal::fails", "rehearsal::passes", "--exact"])?)?;
    outcome.expect_failure(&["== failed: rehearsal::fails\nit always fails", "1 passed, 1 failed"])?;
    run(&mut rehearse_command(&place, &["nobody"])?)?.expect_failure(&["no story is called nobody"])?;
    Ok(())
}

pub fn one_without_an_end_is_named_and_ends_the_run() -> Verdict {
    let place = world().directory("telling")?;
    let names = ["rehearsal::passes", "rehearsal::has_no_end"];
    let outcome = run(rehearse_command(&place, &names)?.env(rehearsal::VARIABLE, "2"))?;
    outcome.expect_failure(&["test rehearsal::passes ... ok", "== failed: rehearsal::has_no_end has no end"])?;
    Ok(())
}

pub fn what_the_machine_lacks_is_said_in_a_line() -> Verdict {
    let place = world().directory("telling")?;
    // The program is below root's home, where others can only execute it through a descriptor.
    let by_nobody = "exec 3<\"$1\"; shift; exec setpriv --reuid=65534 --clear-groups /proc/self/fd/3 \"$@\"";
    rehearse_where(&place, by_nobody)?.expect_failure(&["servants are started by root: sudo make stories"])?;
    let without_cgroups = "mount -t tmpfs none /sys/fs/cgroup; \"$@\"";
    rehearse_where(&place, without_cgroups)?.expect_failure(&["no cgroups with limits are mounted"])?;
    let without_loop = format!("{WITHOUT_LOOP}\"$@\"");
    let outcome = rehearse_where(&place, &without_loop)?.expect_success()?;
    ensure!(outcome.stdout.contains("no disk of their own for the stories' homes"), "{}", outcome.output());
    let full = "mkdir full; mount -t tmpfs -o size=64M none full; TMPDIR=$PWD/full XDG_CACHE_HOME=$PWD/full \"$@\"";
    rehearse_where(&place, full)?.expect_failure(&["GB free, and homes take 2 GB: make room there"])?;
    let on_overlay = format!(
        "{WITHOUT_LOOP}mkdir -p lower upper work over; mount -t overlay -o lowerdir=lower,upperdir=upper,workdir=work \
         none over; TMPDIR=$PWD/over \"$@\""
    );
    rehearse_where(&place, &on_overlay)?
        .expect_failure(&["cannot hold the upper directories of overlays", "TMPDIR"])?;
    Ok(())
}

/// A rehearsal run in progress. When it is dropped, what it has started ends with it.
struct RehearsalRun {
    child: Child,
    /// Parent of the run's directory.
    place: PathBuf,
    /// The network namespace that it uses.
    network: PathBuf,
}

impl RehearsalRun {
    fn start_with_servant(place: &Directory) -> anyhow::Result<RehearsalRun> {
        let mut run = RehearsalRun {
            child: rehearse_command(place, &["waits"])?.stdout(Stdio::piped()).spawn()?,
            place: place.path().to_owned(),
            network: PathBuf::new(),
        };
        let lines = BufReader::new(run.child.stdout.take().context("piped")?).lines();
        let mut said = Vec::new();
        for line in lines {
            let line = line?;
            if let Some((_, network)) = line.split_once(rehearsal::AT_WORK) {
                run.network = network.into();
                return Ok(run);
            }
            said.push(line);
        }
        anyhow::bail!("it ended: {said:#?}")
    }

    fn kill(&mut self) -> Verdict {
        self.child.kill()?;
        self.child.wait()?;
        Ok(())
    }
}

impl Drop for RehearsalRun {
    fn drop(&mut self) {
        let _ = self.kill();
        for left in run_directories(&self.place).unwrap_or_default() {
            let _ = claim::end_users(&left);
        }
    }
}

fn run_directories(parent: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(parent)?.flatten().map(|entry| entry.path());
    let is_place = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with(PREFIX));
    Ok(entries.filter(is_place).collect())
}

pub fn what_a_killed_run_left_is_removed_by_the_next_and_a_living_one_is_left_alone() -> Verdict {
    let place = world().directory("telling")?;
    let mut first = RehearsalRun::start_with_servant(&place)?;
    let passes = || run(&mut rehearse_command(&place, &["rehearsal::passes"])?)?.expect_success();
    let outcome = passes()?;
    ensure!(!outcome.stdout.contains("removed"), "the first is at work: {}", outcome.output());
    let [left] = &run_directories(place.path())?[..] else {
        anyhow::bail!("{:?}", run_directories(place.path())?);
    };
    first.kill()?;
    ensure!(
        !leftovers::find_leftovers(left).is_empty() && first.network.exists(),
        "its daemon, its servant and its network are there"
    );
    let outcome = passes()?;
    let removed = format!("removed {}", path_str(left));
    ensure!(outcome.stdout.contains(&removed), "{}", outcome.output());
    let there = leftovers::find_leftovers(left);
    ensure!(there.is_empty() && !left.exists(), "{there:#?}");
    ensure!(!first.network.exists(), "{}", first.network.display());
    Ok(())
}
