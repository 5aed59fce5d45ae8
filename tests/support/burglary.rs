//! Ways out of a servant and into its neighbours: each is tried with the real system call, and each must fail. Told on
//! the host and in the virtual machine, of whichever daemon has `burglar_cpp` and `greeter_cpp` published.

use std::net::{TcpListener, UdpSocket};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixListener};
use std::process::Command;

use anyhow::{Context, ensure};

use crate::burglar::{breaks_out, tries};
use crate::daemon::Daemon;
use crate::deployer::run;
use crate::robot::Robot;
use crate::{Verdict, leftovers};

/// Tries something that must fail.
fn fails(robot: &mut Robot, what: &str, argument: &str) -> Verdict {
    let attempt = tries(robot, what, argument)?;
    ensure!(!attempt.succeeded, "{what} {argument}: {}", attempt.report);
    Ok(())
}

/// See its name.
pub fn no_attempt_to_break_out_succeeds(daemon: &Daemon) -> Verdict {
    let mut robot = daemon.robot("burglar_cpp?robot=breaker")?;
    let before = std::fs::read_to_string("/proc/sys/kernel/core_pattern")?;
    let broken = breaks_out(&mut robot)?;
    ensure!(broken.is_empty(), "{broken:#?}");
    ensure!(std::fs::read_to_string("/proc/sys/kernel/core_pattern")? == before);
    Ok(())
}

/// See its name.
pub fn nothing_of_the_host_is_reached(daemon: &Daemon) -> Verdict {
    let mut robot = daemon.robot("burglar_cpp?robot=reacher")?;
    // Each of these is there, and would be reached from the host.
    let tcp = TcpListener::bind("0.0.0.0:0")?;
    let udp = UdpSocket::bind("0.0.0.0:0")?;
    let name = format!("cloudroid-story-{}", std::process::id());
    let _abstract = UnixListener::bind_addr(&SocketAddr::from_abstract_name(&name)?)?;
    let made = run(Command::new("ipcmk").args(["-M", "4096", "-p", "0666"]))?.succeeded()?;
    let segment = made
        .stdout
        .rsplit(' ')
        .next()
        .context("an id")?
        .trim()
        .to_owned();
    let told = (|| {
        let port = tcp.local_addr()?.port();
        let mut addresses = vec![format!("127.0.0.1:{port}"), daemon.address.clone()];
        let own = run(Command::new("hostname").arg("-I"))?.stdout;
        addresses.extend(
            own.split_whitespace()
                .filter(|ip| ip.contains('.'))
                .map(|ip| format!("{ip}:{port}")),
        );
        addresses.extend(["192.0.2.1:80".to_owned(), "169.254.169.254:80".to_owned()]);
        for address in &addresses {
            fails(&mut robot, "connect", address)?;
        }
        udp.set_nonblocking(true)?;
        // To itself a datagram may be sent; what counts is that nothing arrives here.
        let _ = tries(
            &mut robot,
            "datagram",
            &format!("127.0.0.1:{}", udp.local_addr()?.port()),
        )?;
        ensure!(udp.recv(&mut [0; 8]).is_err(), "a datagram arrived");
        fails(&mut robot, "datagram", "192.0.2.1:53")?;
        fails(&mut robot, "abstract-socket", &name)?;
        fails(&mut robot, "other-interfaces", "")?;
        let its_own = daemon.deployer().asks(&["status"])?["pid"].to_string();
        for pid in [std::process::id().to_string(), its_own] {
            fails(&mut robot, "foreign-process", &pid)?;
        }
        let key = run(Command::new("ipcs").arg("-m"))?.stdout;
        let key = key
            .lines()
            .find(|line| line.split_whitespace().nth(1) == Some(&segment))
            .and_then(|line| line.split_whitespace().next())
            .context("the segment's key")?;
        let key = u32::from_str_radix(key.trim_start_matches("0x"), 16)? as i32;
        fails(&mut robot, "host-shared-memory", &key.to_string())?;
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
            fails(&mut robot, "host-path", path)?;
        }
        fails(&mut robot, "host-path", &daemon.home.to_string_lossy())
    })();
    run(Command::new("ipcrm").args(["-m", &segment]))?.succeeded()?;
    told
}

/// See its name.
pub fn neighbours_are_not_reached(daemon: &Daemon) -> Verdict {
    let (mut first, mut second) = (
        daemon.robot("burglar_cpp?robot=first")?,
        daemon.robot("burglar_cpp?robot=second")?,
    );
    let _third = daemon.robot("greeter_cpp?robot=third")?;
    // What one leaves in its scratch the other does not see; itself it does.
    let marker = "/tmp/marked";
    tries(&mut first, "write", &format!("{marker} of the first"))?;
    ensure!(
        tries(
            &mut first,
            "text-in-file",
            &format!("{marker} of the first")
        )?
        .succeeded
    );
    fails(
        &mut second,
        "text-in-file",
        &format!("{marker} of the first"),
    )?;
    // Its own Master answers on its own port, which is the same for all; nobody else's nodes do.
    ensure!(tries(&mut first, "connect", "127.0.0.1:11311")?.succeeded);
    for (service, robot) in [("burglar_cpp", "second"), ("greeter_cpp", "third")] {
        for pid in daemon.servant_of(service, robot)?["pids"]
            .as_array()
            .context("pids")?
        {
            fails(&mut first, "foreign-process", &pid.to_string())?;
            for port in listening(pid.as_i64().context("a pid")?)? {
                let own = listening(
                    daemon.servant_of("burglar_cpp", "first")?["pids"][0]
                        .as_i64()
                        .context("a pid")?,
                )?;
                if !own.contains(&port) {
                    fails(&mut first, "connect", &format!("127.0.0.1:{port}"))?;
                }
            }
        }
    }
    ensure!(leftovers::cgroups(&["burgled".to_owned()]).is_empty());
    Ok(())
}

/// Ports that something listens on in the network namespace of a process.
fn listening(pid: i64) -> anyhow::Result<Vec<u16>> {
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
