//! A network between a robot and a server that can be degraded: one of them is in a network namespace, which is
//! connected to this machine's own network, where the other one is.
//!
//! ```text
//!  robot ── its end ══ degraded, both ways ══ the server's end ── forwarded ──▶ portal
//! ```
//! On kernels with netem the kernel degrades it (a veth pair, `tc qdisc … netem`). Without netem both ends are TUN
//! devices, and [`shaper`](crate::shaper) applies the same rules to the packets between them.

use std::fs::File;
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, ensure};
use nix::sched::CloneFlags;

use crate::claim;
use crate::patience::scale;
use crate::shaper::Shaper;

/// Number of the next cable of this process, for its name and addresses.
static NEXT: AtomicU32 = AtomicU32::new(0);

/// Begin of the namespaces' names; the pid and start time of the owning process follow.
const PREFIX: &str = "cloudroid-cable-";

/// Returns the names of the network namespaces of runs that were killed.
pub fn find_abandoned() -> Vec<String> {
    let entries = std::fs::read_dir("/run/netns").into_iter().flatten();
    let names = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into_owned());
    names.filter(|name| parse_owner(name).is_some_and(|owner| !claim::is_alive(&owner))).collect()
}

/// Parses the note of the owning process (see [`claim::own_note`]) from the name of a namespace.
fn parse_owner(name: &str) -> Option<String> {
    let mut words = name.strip_prefix(PREFIX)?.split('-');
    Some(format!("{} {}", words.next()?, words.next()?))
}

/// Removes a network namespace with its devices.
pub fn remove_namespace(name: &str) -> anyhow::Result<()> {
    ip(&["netns", "del", name])
}

/// Impairment of a network, in each direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NetworkImpairment {
    /// Rate in kbit/s.
    pub rate: u32,
    /// Delay of a packet in milliseconds.
    pub delay: u32,
    /// Maximum deviation of the delay in milliseconds, evenly distributed; the order of packets is preserved.
    pub jitter: u32,
    /// Fraction of packets that are lost.
    pub loss: f64,
    /// Maximum number of queued packets; further ones are dropped.
    pub limit: u32,
}

impl NetworkImpairment {
    /// A slow network without other impairments: 20 Mbit/s.
    pub const SLOW: Self = Self { rate: 20_000, delay: 5, jitter: 0, loss: 0.0, limit: 10_000 };

    /// Returns the arguments of netem.
    fn netem_arguments(self) -> Vec<String> {
        [
            "netem".to_owned(),
            "limit".to_owned(),
            self.limit.to_string(),
            "rate".to_owned(),
            format!("{}kbit", self.rate),
            "delay".to_owned(),
            format!("{}ms", self.delay),
            format!("{}ms", self.jitter),
            "loss".to_owned(),
            format!("{}%", self.loss * 100.0),
        ]
        .into()
    }
}

/// The network; removed on drop, which ends its connections.
pub struct Cable {
    /// Address of the portal for the robot.
    pub server: SocketAddr,
    name: String,
    /// Names of the devices in this machine's own network and in the namespace.
    ends: [String; 2],
    /// True if the robot is in the namespace, rather than the server.
    robot_inside: bool,
    /// `None` if the kernel has netem.
    shaper: Option<Shaper>,
    over: Arc<AtomicBool>,
}

impl Cable {
    /// Creates a network with the server in the namespace, and forwards connections to `portal`.
    pub fn new(portal: &str) -> anyhow::Result<Self> {
        Self::create(portal, false)
    }

    /// Creates a network with the robot in the namespace ([`Cable::namespace`]), which has no other device but the
    /// loopback.
    pub fn with_robot_inside(portal: &str) -> anyhow::Result<Self> {
        Self::create(portal, true)
    }

    fn create(portal: &str, robot_inside: bool) -> anyhow::Result<Self> {
        let id = std::process::id();
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let owner = claim::own_note().replace(' ', "-");
        let name = format!("{PREFIX}{owner}-{number}");
        let ends = [format!("cr{id}-{number}"), format!("cs{id}-{number}")];
        // From the range for benchmarks of networks (RFC 2544), four addresses each.
        let subnet = (id.wrapping_mul(8).wrapping_add(number) % (1 << 15)) * 4;
        let address = |host: u32| {
            let low = subnet + host;
            format!("198.{}.{}.{}", 18 + (low >> 16), (low >> 8) & 255, low & 255)
        };
        ip(&["netns", "add", &name])?;
        let mut cable =
            Self { server: ([0, 0, 0, 0], 0).into(), name, ends, robot_inside, shaper: None, over: Arc::default() };
        cable.create_devices()?;
        let [ours, theirs] = &cable.ends;
        ip(&["addr", "add", &format!("{}/30", address(1)), "dev", ours])?;
        ip(&["link", "set", ours, "up"])?;
        let theirs_address = format!("{}/30", address(2));
        cable.run_ip_at_server(&["addr", "add", &theirs_address, "dev", theirs])?;
        cable.run_ip_at_server(&["link", "set", theirs, "up"])?;
        let listener = if robot_inside {
            cable.run_ip_at_server(&["link", "set", "lo", "up"])?;
            TcpListener::bind((address(1), 0))?
        } else {
            cable.listen(&address(2))?
        };
        cable.server = listener.local_addr()?;
        let (portal, over) = (portal.to_owned(), cable.over.clone());
        std::thread::spawn(move || forward_connections(&listener, &portal, &over));
        Ok(cable)
    }

    /// Creates a veth pair if the kernel can degrade it, otherwise TUN devices.
    fn create_devices(&mut self) -> anyhow::Result<()> {
        let [ours, theirs] = &self.ends;
        ip(&["link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", &self.name])?;
        ip(&["link", "set", ours, "up"])?;
        let tried = tc(&["qdisc", "add", "dev", ours, "root", "netem", "delay", "1ms"]);
        if tried.is_ok() {
            return tc(&["qdisc", "del", "dev", ours, "root"]);
        }
        ip(&["link", "del", ours])?;
        self.shaper = Some(Shaper::join_devices(ours, theirs)?);
        ip(&["link", "set", theirs, "netns", &self.name])
    }

    /// Returns the mechanism that degrades it, for reports.
    pub fn mechanism(&self) -> &'static str {
        match self.shaper {
            None => "netem of this kernel",
            Some(_) => "netem's rules applied between two TUN devices (this kernel has no netem)",
        }
    }

    /// Returns the bytes sent to the server so far, and those received from it.
    pub fn transferred_bytes(&self) -> anyhow::Result<(u64, u64)> {
        let count = |what: &str| -> anyhow::Result<u64> {
            let path = format!("/sys/class/net/{}/statistics/{what}_bytes", self.ends[0]);
            let text = std::fs::read_to_string(&path).context(path)?;
            Ok(text.trim().parse()?)
        };
        let (out, back) = (count("tx")?, count("rx")?);
        Ok(if self.robot_inside { (back, out) } else { (out, back) })
    }

    /// Returns the path of the namespace.
    pub fn namespace(&self) -> PathBuf {
        PathBuf::from("/run/netns").join(&self.name)
    }

    /// Degrades the network in both directions.
    pub fn degrade(&self, badness: NetworkImpairment) -> anyhow::Result<()> {
        match &self.shaper {
            Some(shaper) => shaper.set_impairment(Some(badness)),
            None => self.run_netem("replace", &badness.netem_arguments())?,
        }
        Ok(())
    }

    /// Removes the impairment.
    pub fn restore(&self) -> anyhow::Result<()> {
        match &self.shaper {
            Some(shaper) => shaper.set_impairment(None),
            None => self.run_netem("del", &[])?,
        }
        Ok(())
    }

    fn run_netem(&self, what: &str, rules: &[String]) -> anyhow::Result<()> {
        let [ours, theirs] = &self.ends;
        let rules: Vec<&str> = rules.iter().map(String::as_str).collect();
        tc(&[&["qdisc", what, "dev", ours, "root"], &rules[..]].concat())?;
        let there = ["netns", "exec", &self.name, "tc", "qdisc", what, "dev", theirs, "root"];
        ip(&[&there[..], &rules[..]].concat())
    }

    /// Runs `ip` in the namespace.
    fn run_ip_at_server(&self, arguments: &[&str]) -> anyhow::Result<()> {
        ip(&[&["-n", &self.name], arguments].concat())
    }

    /// Opens a listening socket in the namespace.
    fn listen(&self, address: &str) -> anyhow::Result<TcpListener> {
        let address = format!("{address}:0");
        Ok(run_in_namespace(&self.namespace(), || TcpListener::bind(address))??)
    }
}

/// Runs `act` in a network namespace, on a new thread. Processes that it starts stay in the namespace.
pub fn run_in_namespace<T: Send>(namespace: &Path, act: impl FnOnce() -> T + Send) -> anyhow::Result<T> {
    let place = File::open(namespace).with_context(|| namespace.display().to_string())?;
    std::thread::scope(|scope| {
        let acting = scope.spawn(move || {
            nix::sched::setns(&place, CloneFlags::CLONE_NEWNET)?;
            Ok(act())
        });
        acting.join().expect("the thread does not panic")
    })
}

impl Drop for Cable {
    fn drop(&mut self) {
        self.over.store(true, Ordering::Relaxed);
        // Wakes the accepting thread.
        let _ = self.restore();
        let _ = TcpStream::connect_timeout(&self.server, scale(Duration::from_secs(5)));
        let _ = ip(&["link", "del", &self.ends[0]]);
        let _ = remove_namespace(&self.name);
    }
}

fn forward_connections(listener: &TcpListener, portal: &str, over: &AtomicBool) {
    for robot in listener.incoming().flatten() {
        if over.load(Ordering::Relaxed) {
            return;
        }
        let Ok(server) = TcpStream::connect(portal) else {
            continue;
        };
        let both = robot.try_clone().and_then(|robot| Ok((robot, server.try_clone()?)));
        let Ok((robot_too, server_too)) = both else {
            continue;
        };
        let (from, to) = (robot.local_addr(), portal.to_owned());
        std::thread::spawn(move || {
            let host = from.map(|from| from.to_string()).unwrap_or_default();
            let _ = forward_request_head(&robot, &server, &host, &to);
            copy(robot, server);
        });
        std::thread::spawn(move || copy(server_too, robot_too));
    }
}

/// Forwards the head of the first request, with the portal's own host name, as a reverse proxy does.
fn forward_request_head(
    mut robot: &TcpStream,
    mut server: &TcpStream,
    host: &str,
    portal: &str,
) -> std::io::Result<()> {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") && robot.read(&mut byte)? > 0 {
        head.push(byte[0]);
    }
    let head = String::from_utf8_lossy(&head).replace(host, portal);
    server.write_all(head.as_bytes())
}

fn copy(mut from: TcpStream, mut to: TcpStream) {
    let _ = (from.set_nodelay(true), to.set_nodelay(true));
    let mut buffer = vec![0; 1 << 16];
    while let Ok(count) = from.read(&mut buffer) {
        if count == 0 || to.write_all(&buffer[..count]).is_err() {
            break;
        }
    }
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}

fn tc(arguments: &[&str]) -> anyhow::Result<()> {
    run("tc", arguments)
}

/// Runs `ip`.
pub fn ip(arguments: &[&str]) -> anyhow::Result<()> {
    run("ip", arguments)
}

fn run(program: &str, arguments: &[&str]) -> anyhow::Result<()> {
    let output = Command::new(program).args(arguments).output().with_context(|| program.to_owned())?;
    ensure!(
        output.status.success(),
        "{program} {}: {}",
        arguments.join(" "),
        String::from_utf8_lossy(&output.stderr).trim()
    );
    Ok(())
}
