//! Ways out of a servant and into its neighbours: each is attempted with the real system call, and each must fail. Runs
//! on the host and in the virtual machine, against any daemon that has `burglar_cpp` and `greeter_cpp` published.

use std::net::{TcpListener, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::process::Command;

use anyhow::{Context, ensure};

use crate::burglar::{try_all, try_attempt};
use crate::daemon::Daemon;
use crate::deployer::run;
use crate::robot::Robot;
use crate::{Verdict, leftovers};

/// Makes an attempt that must fail.
fn expect_failure(robot: &mut Robot, what: &str, argument: &str) -> Verdict {
    let attempt = try_attempt(robot, what, argument)?;
    ensure!(!attempt.succeeded, "{what} {argument}: {}", attempt.report);
    Ok(())
}

/// See the story of this name.
pub fn no_attempt_to_break_out_succeeds(daemon: &Daemon) -> Verdict {
    let mut robot = daemon.robot("burglar_cpp?robot=breaker")?;
    let before = std::fs::read_to_string("/proc/sys/kernel/core_pattern")?;
    let broken = try_all(&mut robot)?;
    ensure!(broken.is_empty(), "{broken:#?}");
    ensure!(std::fs::read_to_string("/proc/sys/kernel/core_pattern")? == before);
    Ok(())
}

/// See the story of this name.
pub fn nothing_of_the_host_is_reached(daemon: &Daemon) -> Verdict {
    let mut robot = daemon.robot("burglar_cpp?robot=reacher")?;
    // Each of these exists, and can be reached from the host.
    let tcp = TcpListener::bind("0.0.0.0:0")?;
    let udp = UdpSocket::bind("0.0.0.0:0")?;
    let name = format!("cloudroid-story-{}", std::process::id());
    let _abstract = UnixListener::bind_addr(&SocketAddr::from_abstract_name(&name)?)?;
    let made = run(Command::new("ipcmk").args(["-M", "4096", "-p", "0666"]))?.expect_success()?;
    let segment = made.stdout.rsplit(' ').next().context("an id")?.trim().to_owned();
    let told = (|| {
        let port = tcp.local_addr()?.port();
        let mut addresses = vec![format!("127.0.0.1:{port}"), daemon.address.clone()];
        let own = run(Command::new("hostname").arg("-I"))?.stdout;
        addresses.extend(own.split_whitespace().filter(|ip| ip.contains('.')).map(|ip| format!("{ip}:{port}")));
        addresses.extend(["192.0.2.1:80".to_owned(), "169.254.169.254:80".to_owned()]);
        for address in &addresses {
            expect_failure(&mut robot, "connect", address)?;
        }
        udp.set_nonblocking(true)?;
        // A datagram to the servant itself may be sent; it must not arrive here.
        let _ = try_attempt(&mut robot, "datagram", &format!("127.0.0.1:{}", udp.local_addr()?.port()))?;
        ensure!(udp.recv(&mut [0; 8]).is_err(), "a datagram arrived");
        expect_failure(&mut robot, "datagram", "192.0.2.1:53")?;
        expect_failure(&mut robot, "abstract-socket", &name)?;
        expect_failure(&mut robot, "other-interfaces", "")?;
        let its_own = daemon.deployer().run_json(&["status"])?["pid"].to_string();
        for pid in [std::process::id().to_string(), its_own] {
            expect_failure(&mut robot, "foreign-process", &pid)?;
        }
        let key = run(Command::new("ipcs").arg("-m"))?.stdout;
        let key = key
            .lines()
            .find(|line| line.split_whitespace().nth(1) == Some(&segment))
            .and_then(|line| line.split_whitespace().next())
            .context("the segment's key")?;
        let key = u32::from_str_radix(key.trim_start_matches("0x"), 16)? as i32;
        expect_failure(&mut robot, "host-shared-memory", &key.to_string())?;
        for path in [
            "/home/root",
            "/sys/kernel",
            "/sys/fs/cgroup/memory",
            "/dev/sda",
            "/dev/vda",
            "/dev/kvm",
            "/run/init",
            "/run/docker.sock",
        ] {
            expect_failure(&mut robot, "host-path", path)?;
        }
        expect_failure(&mut robot, "host-path", &daemon.home.to_string_lossy())
    })();
    run(Command::new("ipcrm").args(["-m", &segment]))?.expect_success()?;
    told
}

/// See the story of this name.
pub fn neighbours_are_not_reached(daemon: &Daemon) -> Verdict {
    let (mut first, mut second) = (daemon.robot("burglar_cpp?robot=first")?, daemon.robot("burglar_cpp?robot=second")?);
    let _third = daemon.robot("greeter_cpp?robot=third")?;
    // Files in the scratch space are visible to their own servant only.
    let marker = "/tmp/marked";
    try_attempt(&mut first, "write", &format!("{marker} of the first"))?;
    ensure!(try_attempt(&mut first, "text-in-file", &format!("{marker} of the first"))?.succeeded);
    expect_failure(&mut second, "text-in-file", &format!("{marker} of the first"))?;
    // Its own Master answers on its own port, which is the same in all servants; other servants' nodes do not.
    ensure!(try_attempt(&mut first, "connect", "127.0.0.1:11311")?.succeeded);
    for (service, robot) in [("burglar_cpp", "second"), ("greeter_cpp", "third")] {
        for pid in daemon.servant_of(service, robot)?["pids"].as_array().context("pids")? {
            expect_failure(&mut first, "foreign-process", &pid.to_string())?;
            for port in listening_ports(pid.as_i64().context("a pid")?)? {
                let own =
                    listening_ports(daemon.servant_of("burglar_cpp", "first")?["pids"][0].as_i64().context("a pid")?)?;
                if !own.contains(&port) {
                    expect_failure(&mut first, "connect", &format!("127.0.0.1:{port}"))?;
                }
            }
        }
    }
    ensure!(leftovers::cgroups(&["burgled".to_owned()]).is_empty());
    Ok(())
}

/// Returns the listening TCP ports in the network namespace of a process.
fn listening_ports(pid: i64) -> anyhow::Result<Vec<u16>> {
    let table = std::fs::read_to_string(format!("/proc/{pid}/net/tcp"))?;
    Ok(table
        .lines()
        .skip(1)
        .filter_map(|line| {
            let mut fields = line.split_whitespace();
            let local = fields.nth(1)?;
            let state = fields.nth(1)?;
            (state == "0A").then(|| u16::from_str_radix(local.rsplit(':').next()?, 16).ok())?
        })
        .collect())
}
