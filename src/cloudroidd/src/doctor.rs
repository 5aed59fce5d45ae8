//! Checks of what this machine must offer: made before anything is started, by `cloudroidd doctor`, and by
//! `/api/v1/doctor`. The checks change nothing.

mod cgroups;

use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::time::Duration;

use api::{Check, CheckStatus, Doctor, Size};
use portal::MachineChecks;

use crate::config::TelemetryConfig;

/// Oldest supported kernel: overlays of idmapped layers need Linux 5.19.
const OLDEST_KERNEL: (u32, u32) = (5, 19);
/// Free disk space required and recommended: a base image and one package with its dependencies.
const MIN_FREE_SPACE: u64 = 2 << 30;
const RECOMMENDED_FREE_SPACE: u64 = 10 << 30;
/// Time in which a server must accept a connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);

/// Runs all checks. `listening` is the address of a portal that already runs and holds its port; `doubts` are
/// problems of the configuration; `collector` is where traces are sent.
pub fn examine(
    home: &Path,
    listening: Option<SocketAddr>,
    doubts: &[String],
    collector: Option<&TelemetryConfig>,
) -> Doctor {
    let mut checks = vec![root(), kernel(), overlay(), user_namespaces(), idmapped_mounts(home), seccomp(), landlock()];
    checks.push(cgroups::check());
    checks.push(program("mmdebstrap", "mmdebstrap", "makes base images"));
    checks.push(program("apt-get", "apt", "resolves and fetches packages"));
    checks.push(program("dpkg-deb", "dpkg", "unpacks packages"));
    checks.push(optional(program("pip3", "python3-pip", "fetches the Python wheels for some ROS 2 base images")));
    checks.push(apt_lists());
    checks.push(disk_space(home));
    checks.push(init());
    checks.push(port(listening));
    checks.push(configuration(doubts));
    checks.extend(collector.map(telemetry));
    Doctor { checks }
}

/// Returns the state of the machine while the daemon runs, and the failed checks that keep it from starting.
pub fn check_requirements(home: &Path) -> (MachineChecks, Vec<Check>) {
    let checks = [root(), kernel(), overlay(), user_namespaces(), idmapped_mounts(home), seccomp(), init()];
    let missing = checks.into_iter().filter(|check| check.status == CheckStatus::Missing).collect();
    let found = cgroups::detect();
    let mut warnings = Vec::new();
    if !found.missing.is_empty() {
        warnings.push(format!("no limits for servants on {}: {}", found.missing.join(", "), found.why));
    }
    for check in [program("mmdebstrap", "mmdebstrap", ""), apt_lists(), disk_space(home)] {
        if check.status != CheckStatus::Ok {
            warnings.push(format!("{}: {}", check.name, check.found));
        }
    }
    let machine = MachineChecks { cgroup_version: found.version, missing_limits: found.missing, warnings };
    (machine, missing)
}

/// Finds the static init of servants: `CLOUDROID_INIT`, the file beside this program, or where packages install it.
pub fn find_init() -> Option<PathBuf> {
    let named = std::env::var_os("CLOUDROID_INIT").map(PathBuf::from);
    // In the build directory, and installed below any prefix.
    let directory = std::env::current_exe().ok().and_then(|path| Some(path.parent()?.to_owned()));
    let near = ["cloudroid-init", "../lib/cloudroid/cloudroid-init"]
        .iter()
        .filter_map(|name| Some(directory.as_ref()?.join(name)));
    let found = named.into_iter().chain(near).find(|path| path.is_file());
    found.map(|path| path.canonicalize().unwrap_or(path))
}

/// Formats failed checks as a list for the error message of a daemon that cannot start.
pub fn list(checks: &[Check]) -> String {
    let lines = checks.iter().map(|check| match &check.fix {
        Some(fix) => format!("  {}: {}\n    {fix}", check.name, check.found),
        None => format!("  {}: {}", check.name, check.found),
    });
    lines.collect::<Vec<_>>().join("\n")
}

fn ok(name: &str, found: impl Into<String>) -> Check {
    Check { name: name.to_owned(), status: CheckStatus::Ok, found: found.into(), fix: None }
}

fn missing(name: &str, found: impl Into<String>, fix: impl Into<String>) -> Check {
    Check { name: name.to_owned(), status: CheckStatus::Missing, found: found.into(), fix: Some(fix.into()) }
}

fn warning(name: &str, found: impl Into<String>, fix: impl Into<String>) -> Check {
    Check { name: name.to_owned(), status: CheckStatus::Warning, found: found.into(), fix: Some(fix.into()) }
}

fn root() -> Check {
    let uid = nix::unistd::geteuid();
    if uid.is_root() {
        ok("root", "running as root")
    } else {
        missing("root", format!("running as user {uid}; creating containers needs root"), "sudo cloudroidd")
    }
}

fn kernel() -> Check {
    let release = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let release = release.trim();
    match version(release) {
        Some(found) if found >= OLDEST_KERNEL => ok("kernel", format!("Linux {release}")),
        Some(_) => missing(
            "kernel",
            format!("Linux {release} is older than {}.{}", OLDEST_KERNEL.0, OLDEST_KERNEL.1),
            "install a newer kernel, such as Debian 12's or Ubuntu's linux-generic-hwe, and reboot",
        ),
        None => warning("kernel", format!("unknown version {release:?}"), "uname -r"),
    }
}

fn version(release: &str) -> Option<(u32, u32)> {
    let mut numbers = release.split(|c: char| !c.is_ascii_digit()).map(str::parse);
    Some((numbers.next()?.ok()?, numbers.next()?.ok()?))
}

fn overlay() -> Check {
    let known = std::fs::read_to_string("/proc/filesystems").unwrap_or_default();
    if known.lines().any(|line| line.split_whitespace().last() == Some("overlay")) {
        ok("overlay", "overlay file systems are supported")
    } else {
        missing("overlay", "the kernel has no overlay file system", "modprobe overlay")
    }
}

fn user_namespaces() -> Check {
    let limit = std::fs::read_to_string("/proc/sys/user/max_user_namespaces").ok();
    match limit.and_then(|text| text.trim().parse::<u64>().ok()) {
        Some(0) => missing("user namespaces", "none allowed", "sysctl -w user.max_user_namespaces=15000"),
        Some(limit) => ok("user namespaces", format!("{limit} allowed")),
        None => missing(
            "user namespaces",
            "not supported by the kernel",
            "boot a kernel with CONFIG_USER_NS, such as the distribution's own",
        ),
    }
}

fn seccomp() -> Check {
    match std::fs::read_to_string("/proc/sys/kernel/seccomp/actions_avail") {
        Ok(actions) if actions.contains("errno") => ok("seccomp", "system calls can be filtered"),
        _ => missing(
            "seccomp",
            "the kernel cannot filter system calls",
            "boot a kernel with CONFIG_SECCOMP_FILTER, such as the distribution's own",
        ),
    }
}

fn landlock() -> Check {
    if servant::shim::can_restrict_files() {
        return ok("landlock", "the servants' ROS Masters are confined to their own files");
    }
    warning(
        "landlock",
        "the kernel cannot confine the servants' ROS Masters to their own files",
        "boot with landlock among lsm=, such as lsm=landlock,lockdown,yama,integrity,apparmor",
    )
}

/// Returns the directory, or the nearest one above it that exists.
fn find_existing(home: &Path) -> &Path {
    let mut above = home.ancestors();
    above.find(|path| path.is_dir()).unwrap_or(Path::new("/"))
}

fn idmapped_mounts(home: &Path) -> Check {
    const NAME: &str = "idmapped mounts";
    let existing = find_existing(home);
    if !nix::unistd::geteuid().is_root() {
        return warning(NAME, "can only be tested as root", "sudo cloudroidd doctor");
    }
    match servant::idmap::check_idmap_support(existing) {
        Ok(()) => ok(NAME, format!("supported by the file system of {}", existing.display())),
        Err(error) => missing(
            NAME,
            format!("not supported by the file system of {}: {error}", existing.display()),
            "choose a state directory on ext4, xfs or btrfs with --home, or install a newer kernel",
        ),
    }
}

fn program(name: &str, package: &str, what_for: &str) -> Check {
    let path = std::env::var_os("PATH").unwrap_or_default();
    match std::env::split_paths(&path).map(|directory| directory.join(name)).find(|path| path.is_file()) {
        Some(path) => ok(name, path.display().to_string()),
        None => missing(name, format!("not installed; it {what_for}"), format!("apt-get install {package}")),
    }
}

/// Turns a failed check into a warning, for something that most functions work without.
fn optional(check: Check) -> Check {
    let status = match check.status {
        CheckStatus::Missing => CheckStatus::Warning,
        status => status,
    };
    Check { status, ..check }
}

fn apt_lists() -> Check {
    const NAME: &str = "apt lists";
    let directory = "/var/lib/apt/lists";
    let count = std::fs::read_dir(directory).map_or(0, |entries| {
        entries.flatten().filter(|entry| entry.file_name().to_string_lossy().contains("_Packages")).count()
    });
    if count > 0 {
        ok(NAME, format!("{count} package lists in {directory}"))
    } else {
        warning(NAME, format!("no package lists in {directory}"), "apt-get update")
    }
}

fn disk_space(home: &Path) -> Check {
    const NAME: &str = "disk space";
    let existing = find_existing(home);
    let Ok(found) = nix::sys::statvfs::statvfs(existing) else {
        return warning(NAME, format!("unknown for {}", existing.display()), format!("df -h {}", existing.display()));
    };
    let free = found.blocks_available() * found.fragment_size();
    let text = format!("{} free at {}", Size(free), existing.display());
    let fix = "free some space, or choose another state directory with --home; cloudroidctl rm removes services";
    match free {
        _ if free < MIN_FREE_SPACE => {
            missing(NAME, format!("{text}; a first push needs {}", Size(MIN_FREE_SPACE)), fix)
        }
        _ if free < RECOMMENDED_FREE_SPACE => warning(NAME, text, fix),
        _ => ok(NAME, text),
    }
}

fn init() -> Check {
    const NAME: &str = "cloudroid-init";
    match find_init() {
        Some(path) => ok(NAME, path.display().to_string()),
        None => missing(
            NAME,
            "the servants' init is not beside cloudroidd",
            "make build, or name it: CLOUDROID_INIT=PATH cloudroidd",
        ),
    }
}

fn configuration(doubts: &[String]) -> Check {
    match doubts {
        [] => ok("configuration", "fits this machine's resources"),
        doubts => warning("configuration", doubts.join("; "), "change it, and start the daemon again"),
    }
}

/// Checks that the collector of traces accepts connections.
fn telemetry(collector: &TelemetryConfig) -> Check {
    const NAME: &str = "telemetry";
    let fix = "start the OpenTelemetry collector, or correct endpoint of [telemetry] in the configuration";
    let endpoint = &collector.endpoint;
    let server = match collector.traces_url() {
        Ok(url) => outbound::find_server(&url).map_err(anyhow::Error::from),
        Err(error) => Err(error),
    };
    let connected = server.and_then(|(host, port)| {
        let mut failed = anyhow::anyhow!("{host} has no address");
        for address in (host.as_str(), port).to_socket_addrs()? {
            match TcpStream::connect_timeout(&address, CONNECT_TIMEOUT) {
                Ok(_) => return Ok(()),
                Err(error) => failed = error.into(),
            }
        }
        Err(failed)
    });
    match connected {
        Ok(()) => ok(NAME, format!("the collector at {endpoint} accepts connections")),
        Err(error) => warning(NAME, format!("the collector at {endpoint} cannot be reached: {error:#}"), fix),
    }
}

fn port(listening: Option<SocketAddr>) -> Check {
    const NAME: &str = "port";
    if let Some(address) = listening {
        return ok(NAME, format!("this daemon listens on {address}"));
    }
    let address = crate::config::Config::default().listen;
    match TcpListener::bind(address) {
        Ok(_) => ok(NAME, format!("{address} is free")),
        Err(error) => warning(
            NAME,
            format!("{address} is taken: {error}"),
            format!(
                "ss -ltnp 'sport = :{}' shows the program; choose another address with cloudroidd --listen",
                address.port()
            ),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn kernel_versions_are_read() {
        assert_eq!(version("6.1.0-13-amd64"), Some((6, 1)));
        assert_eq!(version("5.15.0-1019-aws"), Some((5, 15)));
        assert_eq!(version("next"), None);
        assert!(version("5.4.0").expect("a version") < OLDEST_KERNEL);
    }

    #[test]
    fn every_need_that_is_not_met_says_how_to_mend_it() {
        let doctor = examine(Path::new("/nonexistent/home"), None, &[], None);
        for check in doctor.checks {
            assert!(check.status == CheckStatus::Ok || check.fix.is_some(), "{check:?}");
        }
    }

    #[test]
    fn a_collector_that_does_not_listen_is_named() {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port");
        let endpoint = format!("http://{}", listener.local_addr().expect("bound"));
        let collector = TelemetryConfig { endpoint: endpoint.clone(), sampling_ratio: 1.0, authorities: None };
        assert_eq!(telemetry(&collector).status, CheckStatus::Ok);
        drop(listener);
        let check = telemetry(&collector);
        assert_eq!(check.status, CheckStatus::Warning);
        assert!(check.found.contains(&endpoint), "{check:?}");
        assert!(check.fix.is_some_and(|fix| fix.contains("[telemetry]")));
    }

    #[test]
    fn a_missing_program_names_its_package() {
        let check = program("no-such-program", "its-package", "does things");
        assert_eq!(check.status, CheckStatus::Missing);
        assert_eq!(check.fix.as_deref(), Some("apt-get install its-package"));
    }
}
