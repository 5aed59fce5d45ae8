//! Another user of the server, neither root nor in the group of the daemon's admins: files, processes, sockets. To the
//! kernel credentials belong to threads, so attempts are made by a thread that has dropped its own.

use std::collections::BTreeSet;
use std::fs::{self, File, OpenOptions, Permissions};
use std::io::{Error as IoError, Read, Write};
use std::net::TcpListener;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::os::unix::net::{SocketAddr, UnixDatagram, UnixStream};
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use nix::libc;
use serde_json::json;
use support::Verdict;
use support::daemon::{Daemon, DaemonSetup};

use super::scene::server_state;
use crate::access::{create_token, push_adder};

/// An unused user id.
const ACCOUNT: u32 = 61_010;
/// Files of a process that are readable by its own user (proc(5)).
const PROC: [&str; 22] = [
    "mem",
    "environ",
    "root",
    "cwd",
    "exe",
    "fd",
    "fd/0",
    "fd/1",
    "fdinfo",
    "map_files",
    "maps",
    "smaps",
    "pagemap",
    "auxv",
    "stack",
    "syscall",
    "io",
    "personality",
    "ns/net",
    "ns/mnt",
    "ns/user",
    "clear_refs",
];
/// Files among them that can be written to change the process.
const WRITTEN: [&str; 8] =
    ["mem", "clear_refs", "oom_score_adj", "comm", "coredump_filter", "timerslack_ns", "attr/current", "setgroups"];

/// Number of attempts, and those that succeeded.
#[derive(Default)]
struct LocalAttempts {
    count: usize,
    succeeded: Vec<String>,
}

impl LocalAttempts {
    /// Records an attempt that must be refused.
    fn expect_refused<T, E>(&mut self, what: impl FnOnce() -> String, came: Result<T, E>) {
        self.count += 1;
        if came.is_ok() {
            self.succeeded.push(what());
        }
    }

    /// Records a system call, which returns -1 if it is refused.
    fn expect_call_refused(&mut self, what: impl FnOnce() -> String, came: libc::c_long) {
        self.expect_refused(what, if came < 0 { Err(()) } else { Ok(()) });
    }
}

/// Runs `does` as the other user.
fn run_as_account<T: Send>(does: impl FnOnce() -> T + Send) -> anyhow::Result<T> {
    let done = std::thread::scope(|scope| {
        let thread = scope.spawn(|| {
            // SAFETY: these calls affect only this thread, which ends afterwards.
            let changed = unsafe {
                libc::syscall(libc::SYS_setgroups, 0, std::ptr::null::<u32>()) == 0
                    && libc::syscall(libc::SYS_setresgid, ACCOUNT, ACCOUNT, ACCOUNT) == 0
                    && libc::syscall(libc::SYS_setresuid, ACCOUNT, ACCOUNT, ACCOUNT) == 0
            };
            changed.then(does).ok_or_else(IoError::last_os_error)
        });
        thread.join()
    });
    let done = done.map_err(|_| anyhow::anyhow!("the thread ended badly"))?;
    Ok(done?)
}

/// Lists everything below a directory except the content of images.
fn list_below(directory: &Path, found: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(directory).into_iter().flatten().flatten() {
        let path = entry.path();
        found.push(path.clone());
        let is_directory = entry.file_type().is_ok_and(|kind| kind.is_dir());
        let is_of_images = path.parent().is_some_and(|above| above.ends_with("layers"));
        if is_directory && !is_of_images {
            list_below(&path, found);
        }
    }
}

/// Adds all descendants of a process.
fn add_descendants(pid: i32, found: &mut BTreeSet<i32>) {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten();
    for task in tasks {
        let children = fs::read_to_string(task.path().join("children")).unwrap_or_default();
        for child in children.split_whitespace().filter_map(|word| word.parse().ok()) {
            if found.insert(child) {
                add_descendants(child, found);
            }
        }
    }
}

/// Attempts to read, list, write, replace and remove the daemon's files.
fn try_files(tried: &mut LocalAttempts, paths: &[PathBuf]) {
    for path in paths {
        let shown = || path.display().to_string();
        let mut bytes = [0; 64];
        let read = File::open(path).and_then(|mut file| file.read(&mut bytes));
        tried.expect_refused(|| format!("read {}", shown()), read);
        tried.expect_refused(|| format!("list {}", shown()), fs::read_dir(path));
        let written = OpenOptions::new().append(true).custom_flags(libc::O_NONBLOCK).open(path);
        tried.expect_refused(|| format!("write {}", shown()), written);
        tried.expect_refused(|| format!("remove {}", shown()), fs::remove_file(path));
        let moved = fs::rename(path, path.with_extension("moved"));
        tried.expect_refused(|| format!("move {}", shown()), moved);
        let opened = fs::set_permissions(path, Permissions::from_mode(0o777));
        tried.expect_refused(|| format!("open up {}", shown()), opened);
        tried.expect_refused(|| format!("link to {}", shown()), fs::hard_link(path, "/tmp/of-another"));
        let made = File::create_new(path.join("planted"));
        tried.expect_refused(|| format!("plant a file in {}", shown()), made);
    }
}

/// Attempts to inspect and change processes.
fn try_processes(tried: &mut LocalAttempts, pids: &BTreeSet<i32>) {
    for pid in pids {
        for file in PROC {
            let path = format!("/proc/{pid}/{file}");
            let mut bytes = [0; 16];
            let came = match file {
                "fd" | "fdinfo" | "map_files" => fs::read_dir(&path).map(|_| ()),
                "root" | "cwd" => fs::read_dir(&path).map(|_| ()),
                "exe" | "ns/net" | "ns/mnt" | "ns/user" => fs::read_link(&path).map(|_| ()),
                _ => File::open(&path)
                    .and_then(|mut file| file.read(&mut bytes))
                    // Some files are empty for readers without permission.
                    .and_then(|length| match length {
                        0 => Err(IoError::from_raw_os_error(libc::EACCES)),
                        _ => Ok(()),
                    }),
            };
            tried.expect_refused(|| format!("read {path}"), came);
        }
        for file in WRITTEN {
            let path = format!("/proc/{pid}/{file}");
            let written = OpenOptions::new().write(true).open(&path).and_then(|mut file| file.write(b"1"));
            tried.expect_refused(|| format!("write {path}"), written);
        }
        let mut word = [0_u8; 8];
        let here = libc::iovec { iov_base: word.as_mut_ptr().cast(), iov_len: word.len() };
        let there = libc::iovec { iov_base: 0x1000 as *mut libc::c_void, iov_len: word.len() };
        let limit = libc::rlimit { rlim_cur: 1, rlim_max: 1 };
        // SAFETY: every pointer refers to a local variable, or is null where the call accepts that; the calls would
        // affect another process, and are refused.
        unsafe {
            tried.expect_call_refused(|| format!("attach to {pid}"), libc::ptrace(libc::PTRACE_ATTACH, *pid, 0, 0));
            tried.expect_call_refused(|| format!("seize {pid}"), libc::ptrace(libc::PTRACE_SEIZE, *pid, 0, 0));
            for signal in [0, libc::SIGSTOP, libc::SIGHUP, libc::SIGTERM, libc::SIGKILL] {
                tried.expect_call_refused(|| format!("signal {signal} to {pid}"), libc::kill(*pid, signal).into());
            }
            tried.expect_call_refused(
                || format!("read memory of {pid}"),
                libc::process_vm_readv(*pid, &raw const here, 1, &raw const there, 1, 0) as libc::c_long,
            );
            tried.expect_call_refused(
                || format!("write memory of {pid}"),
                libc::process_vm_writev(*pid, &raw const here, 1, &raw const there, 1, 0) as libc::c_long,
            );
            let handle = libc::syscall(libc::SYS_pidfd_open, *pid, 0);
            tried.expect_call_refused(
                || format!("take a descriptor of {pid}"),
                libc::syscall(libc::SYS_pidfd_getfd, handle, 0, 0),
            );
            tried.expect_call_refused(
                || format!("enter the namespaces of {pid}"),
                libc::syscall(libc::SYS_setns, handle, libc::CLONE_NEWNS | libc::CLONE_NEWNET),
            );
            libc::syscall(libc::SYS_close, handle);
            tried.expect_call_refused(
                || format!("limit {pid}"),
                libc::prlimit(*pid, libc::RLIMIT_NOFILE, &raw const limit, std::ptr::null_mut()).into(),
            );
            tried.expect_call_refused(
                || format!("slow {pid} down"),
                libc::setpriority(libc::PRIO_PROCESS, *pid as libc::id_t, 19).into(),
            );
            let mut cores: libc::cpu_set_t = std::mem::zeroed();
            libc::CPU_SET(0, &mut cores);
            tried.expect_call_refused(
                || format!("bind {pid} to a core"),
                libc::sched_setaffinity(*pid, size_of_val(&cores), &raw const cores).into(),
            );
            tried.expect_call_refused(
                || format!("compare files of {pid}"),
                libc::syscall(libc::SYS_kcmp, *pid, libc::getpid(), 2, 0, 0),
            );
        }
    }
}

/// Returns the files of the cgroups of these processes.
fn cgroup_directories(pids: &BTreeSet<i32>) -> anyhow::Result<BTreeSet<PathBuf>> {
    let mut found = BTreeSet::new();
    for pid in pids {
        // A process may have ended meanwhile.
        let Ok(text) = fs::read_to_string(format!("/proc/{pid}/cgroup")) else {
            continue;
        };
        for line in text.lines() {
            let (_, rest) = line.split_once(':').context("a cgroup")?;
            let (controllers, path) = rest.split_once(':').context("its path")?;
            if !path.contains("cloudroid") {
                continue;
            }
            let below = match controllers {
                "" => String::new(),
                controllers => controllers.replace("name=", ""),
            };
            let directory = Path::new("/sys/fs/cgroup").join(below).join(path.trim_start_matches('/'));
            for file in fs::read_dir(directory).into_iter().flatten().flatten() {
                found.insert(file.path());
            }
        }
    }
    Ok(found)
}

fn try_cgroup_files(tried: &mut LocalAttempts, files: &BTreeSet<PathBuf>) {
    for path in files.iter().filter(|path| path.is_file()) {
        let written = OpenOptions::new().write(true).open(path).and_then(|mut file| file.write(b"0"));
        tried.expect_refused(|| format!("write {}", path.display()), written);
    }
    let directories: BTreeSet<&Path> = files.iter().filter_map(|path| path.parent()).collect();
    for directory in directories {
        let made = fs::create_dir(directory.join("planted"));
        tried.expect_refused(|| format!("make a cgroup in {}", directory.display()), made);
    }
}

/// Attempts to connect to sockets of the daemon and its servants, from the kernel's list: those with a path below
/// `home`, and those without a path.
fn try_sockets(tried: &mut LocalAttempts, home: &Path) -> anyhow::Result<()> {
    let list = fs::read_to_string("/proc/net/unix")?;
    let home = home.display().to_string();
    for name in list.lines().filter_map(|line| line.split_whitespace().nth(7)) {
        let abstract_name = name
            .strip_prefix('@')
            .filter(|name| name.contains("cloudroid"))
            // Robots of other stories reserve their ROS 2 domains with these.
            .filter(|name| !name.starts_with("cloudroid-domain-"));
        let address = match abstract_name {
            Some(name) => SocketAddr::from_abstract_name(name)?,
            None if name.starts_with(&home) => SocketAddr::from_pathname(name)?,
            None => continue,
        };
        tried.expect_refused(|| format!("connect to {name}"), UnixStream::connect_addr(&address));
        let sent = UnixDatagram::unbound().and_then(|socket| socket.send_to_addr(b"x", &address));
        tried.expect_refused(|| format!("send to {name}"), sent);
    }
    Ok(())
}

pub fn another_account_of_this_machine_reaches_nothing() -> Verdict {
    // A directory that other users can enter, so that only the daemon's own protection matters.
    let place = tempfile::Builder::new().prefix("cloudroid-account-").tempdir()?;
    fs::set_permissions(place.path(), Permissions::from_mode(0o755))?;
    let home = place.path().join("home");
    let daemon = DaemonSetup::new(&home).config("tokens = [\"open sesame\"]\n").start()?;
    let alice = create_token(&daemon, &["alice", "--role", "deployer", "--service", "*"])?;
    push_adder(&daemon, &alice, &[])?.expect_success()?;
    let mut robot = daemon.robot(&format!("adder_py?robot=r1&token={alice}"))?;
    ensure!(robot.call("/add_two", json!({"a": 1, "b": 2}))?["values"]["sum"] == 3);
    let before = server_state(&daemon)?;
    let tried = try_everything(&daemon, &home, &alice)?;
    ensure!(tried.succeeded.is_empty(), "{:#?}", tried.succeeded);
    ensure!(server_state(&daemon)? == before, "{before:#}");
    ensure!(robot.call("/add_two", json!({"a": 2, "b": 2}))?["values"]["sum"] == 4);
    println!("{} attempts", tried.count);
    ensure!(tried.count > 600, "{}", tried.count);
    Ok(())
}

fn try_everything(daemon: &Daemon, home: &Path, secret: &str) -> anyhow::Result<LocalAttempts> {
    // Listed by root; the other user could guess the paths.
    let mut paths = vec![home.to_owned()];
    list_below(home, &mut paths);
    // These files belong to the story.
    paths.retain(|path| !path.ends_with("daemon.log") && !path.ends_with("test-config.toml"));
    for needed in ["cloudroid.db", "run/daemon.sock", "layers", "images"] {
        ensure!(paths.contains(&home.join(needed)), "{needed} is not in {paths:#?}");
    }
    let mut pids = BTreeSet::from([daemon.pid()]);
    add_descendants(daemon.pid(), &mut pids);
    for servant in daemon.servants_of("adder_py")? {
        let inside = servant["pids"].as_array().context("pids")?;
        pids.extend(inside.iter().filter_map(|pid| i32::try_from(pid.as_i64()?).ok()));
    }
    ensure!(pids.len() > 2, "{pids:?}");
    let groups = cgroup_directories(&pids)?;
    let lines = ["cmdline", "status", "comm", "cgroup", "mountinfo", "stat"];
    run_as_account(|| {
        let mut tried = LocalAttempts::default();
        try_files(&mut tried, &paths);
        try_processes(&mut tried, &pids);
        try_cgroup_files(&mut tried, &groups);
        // The world-readable information about a process contains no secret.
        for (pid, line) in pids.iter().flat_map(|pid| lines.map(|line| (pid, line))) {
            let text = fs::read_to_string(format!("/proc/{pid}/{line}")).unwrap_or_default();
            let holds = text.contains(secret) || text.contains("open sesame");
            tried.expect_refused(|| format!("find a token in {line} of {pid}"), if holds { Ok(()) } else { Err(()) });
        }
        try_sockets(&mut tried, home)?;
        // Over loopback the user has no special rights.
        for (method, path) in [
            ("GET", "/api/v1/status"),
            ("GET", "/api/v1/services"),
            ("GET", "/api/v1/tokens"),
            ("POST", "/api/v1/tokens"),
            ("DELETE", "/api/v1/servants"),
            ("POST", "/api/v1/push"),
            ("GET", "/metrics"),
            ("GET", "/stubs/adder_py.tar.gz"),
        ] {
            let (status, _) = daemon.request(method, path, &[])?;
            tried.expect_refused(|| format!("{method} {path}: {status}"), if status == 401 { Err(()) } else { Ok(()) });
        }
        // It cannot take the daemon's place either.
        for again in [&*daemon.address, &daemon.address.replace("127.0.0.1", "0.0.0.0")] {
            tried.expect_refused(|| format!("listen at {again}"), TcpListener::bind(again));
        }
        Ok(tried)
    })?
}
