//! The machine that the stories are told in, from inside.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::Context;
use support::daemon::Daemon;
use support::deployer::run;

/// The package's state directory.
pub const HOME: &str = "/var/lib/cloudroid";
/// The cgroup in which servants live.
pub const SERVANTS: &str = "/sys/fs/cgroup/system.slice/cloudroid-servants.service";
/// Names of stories that failed, a line each, kept over cuts of the power.
const FAILURES: &str = "/var/vm-failures";

/// How often the machine has booted; none on any other machine.
pub fn boot() -> Option<usize> {
    std::env::var("VM_BOOT").ok()?.parse().ok()
}

/// The installed daemon, once it answers.
pub fn daemon() -> anyhow::Result<Daemon> {
    Daemon::of_another(Path::new(HOME), None)
}

/// Its main process, as systemd knows it.
pub fn main_pid() -> anyhow::Result<i32> {
    property("cloudroid.service", "MainPID")?
        .parse()
        .context("a pid")
}

/// What systemd says of a unit.
pub fn property(unit: &str, name: &str) -> anyhow::Result<String> {
    let outcome = types("systemctl", &["show", "--value", "-p", name, unit])?;
    Ok(outcome.trim().to_owned())
}

/// Runs a program that must go well, and gives what it printed.
pub fn types(program: &str, arguments: &[&str]) -> anyhow::Result<String> {
    let outcome = run(Command::new(program)
        .args(arguments)
        .env("DEBIAN_FRONTEND", "noninteractive"))?;
    Ok(outcome.succeeded()?.stdout)
}

/// A control file of a servant.
pub fn control(id: &str, name: &str) -> anyhow::Result<String> {
    let path = Path::new(SERVANTS).join(id).join(name);
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    Ok(text.trim().to_owned())
}

/// What the daemon and systemd said last.
pub fn last_words() -> String {
    let journal = Command::new("journalctl")
        .args(["-b", "--no-pager", "-o", "cat", "-n", "15"])
        .output();
    journal.map_or_else(
        |error| error.to_string(),
        |journal| String::from_utf8_lossy(&journal.stdout).into_owned(),
    )
}

/// Remembers a failure.
pub fn failed(name: &str) {
    let mut file = fs::File::options()
        .create(true)
        .append(true)
        .open(FAILURES)
        .expect("the disk can be written");
    writeln!(file, "{name}").expect("the disk can be written");
    file.sync_all().expect("the disk can be written");
}

/// As when a plug is pulled: nothing is written any more.
pub fn cut_power() -> ! {
    let _ = std::io::stdout().flush();
    // What was printed is in the serial line's buffer, which is no part of the story.
    let _ = nix::sys::termios::tcdrain(std::io::stdout());
    let _ = fs::write("/proc/sysrq-trigger", "b");
    loop {
        std::thread::park();
    }
}

/// How all of it went.
pub fn verdict() -> ExitCode {
    match fs::read_to_string(FAILURES) {
        Ok(names) => {
            println!("failed: {}", names.lines().collect::<Vec<_>>().join(", "));
            ExitCode::FAILURE
        }
        Err(_) => ExitCode::SUCCESS,
    }
}
