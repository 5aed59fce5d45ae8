//! The virtual machine of the stories, from inside.

use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, ExitCode};

use anyhow::Context;
use support::daemon::Daemon;
use support::deployer::run;

/// State directory of the package.
pub const HOME: &str = "/var/lib/cloudroid";
/// Parent cgroup of servants.
pub const SERVANTS: &str = "/sys/fs/cgroup/system.slice/cloudroid-servants.service";
/// File with the names of failed stories, one per line, kept across power cuts.
const FAILURES: &str = "/var/vm-failures";

/// Returns how often the machine has booted; `None` on any other machine.
pub fn boot_number() -> Option<usize> {
    std::env::var("VM_BOOT").ok()?.parse().ok()
}

/// Attaches to the installed daemon, once it answers.
pub fn daemon() -> anyhow::Result<Daemon> {
    Daemon::attach(Path::new(HOME), None)
}

/// Returns its main pid according to systemd.
pub fn main_pid() -> anyhow::Result<i32> {
    property("cloudroid.service", "MainPID")?.parse().context("a pid")
}

/// Returns a property of a systemd unit.
pub fn property(unit: &str, name: &str) -> anyhow::Result<String> {
    let outcome = run_program("systemctl", &["show", "--value", "-p", name, unit])?;
    Ok(outcome.trim().to_owned())
}

/// Runs a program that must succeed; returns its output.
pub fn run_program(program: &str, arguments: &[&str]) -> anyhow::Result<String> {
    let outcome = run(Command::new(program).args(arguments).env("DEBIAN_FRONTEND", "noninteractive"))?;
    Ok(outcome.expect_success()?.stdout)
}

/// Reads a cgroup control file of a servant.
pub fn read_control_file(id: &str, name: &str) -> anyhow::Result<String> {
    let path = Path::new(SERVANTS).join(id).join(name);
    let text = fs::read_to_string(&path).with_context(|| path.display().to_string())?;
    Ok(text.trim().to_owned())
}

/// Returns the last log lines of the daemon and systemd.
pub fn log_tail() -> String {
    let journal = Command::new("journalctl").args(["-b", "--no-pager", "-o", "cat", "-n", "15"]).output();
    journal.map_or_else(|error| error.to_string(), |journal| String::from_utf8_lossy(&journal.stdout).into_owned())
}

/// Records a failure.
pub fn record_failure(name: &str) {
    let mut file = fs::File::options().create(true).append(true).open(FAILURES).expect("the disk can be written");
    writeln!(file, "{name}").expect("the disk can be written");
    file.sync_all().expect("the disk can be written");
}

/// Resets the machine without flushing anything to disk, like pulling the plug.
pub fn cut_power() -> ! {
    let _ = std::io::stdout().flush();
    // The output is in the buffer of the serial line, which is not part of the story.
    let _ = nix::sys::termios::tcdrain(std::io::stdout());
    let _ = fs::write("/proc/sysrq-trigger", "b");
    loop {
        std::thread::park();
    }
}

/// Returns the result of all boots.
pub fn verdict() -> ExitCode {
    match fs::read_to_string(FAILURES) {
        Ok(names) => {
            println!("failed: {}", names.lines().collect::<Vec<_>>().join(", "));
            ExitCode::FAILURE
        }
        Err(_) => ExitCode::SUCCESS,
    }
}
