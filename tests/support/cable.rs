//! A network between a robot and a server that can be made bad: a network namespace for one of them, joined to this
//! machine's own, where the other is.
//!
//! ```text
//!  robot ── its end ══ degraded, both ways ══ the server's end ── passed on ──▶ portal
//! ```
//! Kernels with netem degrade it by themselves (a veth pair, `tc qdisc … netem`). Where netem was left out, both ends
//! are TUN devices, and [`shaper`](crate::shaper) treats packets by the same rules between them.

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

use crate::patience::scale;
use crate::shaper::Shaper;

/// Names and addresses of this process's cables.
static NEXT: AtomicU32 = AtomicU32::new(0);

/// How bad a network is, in each direction.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Badness {
    /// What it carries, kbit/s.
    pub rate: u32,
    /// How long a packet is on the way, milliseconds.
    pub delay: u32,
    /// By how much that differs from packet to packet at most, milliseconds, evenly distributed; their order is kept.
    pub jitter: u32,
    /// Share of packets that are lost.
    pub loss: f64,
    /// Packets that wait before others are dropped.
    pub limit: u32,
}

impl Badness {
    /// A link that is slow, and nothing else: 20 Mbit/s.
    pub const SLOW: Self = Self {
        rate: 20_000,
        delay: 5,
        jitter: 0,
        loss: 0.0,
        limit: 10_000,
    };

    /// As netem is told.
    fn netem(self) -> Vec<String> {
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

/// It is taken down when dropped; connections over it end then.
pub struct Cable {
    /// Where the robot reaches the portal.
    pub server: SocketAddr,
    name: String,
    /// In this machine's own network, and in the namespace.
    ends: [String; 2],
    /// The robot is in the namespace; else the server.
    robot_inside: bool,
    /// None where the kernel has netem.
    shaper: Option<Shaper>,
    over: Arc<AtomicBool>,
}

impl Cable {
    /// Joins both, the server in the namespace, and passes connections on to `portal`.
    pub fn new(portal: &str) -> anyhow::Result<Self> {
        Self::between(portal, false)
    }

    /// The same with the robot in the namespace ([`Cable::namespace`]), where there is nothing else but a loopback.
    pub fn with_robot_inside(portal: &str) -> anyhow::Result<Self> {
        Self::between(portal, true)
    }

    fn between(portal: &str, robot_inside: bool) -> anyhow::Result<Self> {
        let id = std::process::id();
        let number = NEXT.fetch_add(1, Ordering::Relaxed);
        let name = format!("cloudroid-cable-{id}-{number}");
        let ends = [format!("cr{id}-{number}"), format!("cs{id}-{number}")];
        // Of the range for tests between networks (RFC 2544), four addresses each.
        let subnet = (id.wrapping_mul(8).wrapping_add(number) % (1 << 15)) * 4;
        let address = |host: u32| {
            let low = subnet + host;
            format!(
                "198.{}.{}.{}",
                18 + (low >> 16),
                (low >> 8) & 255,
                low & 255
            )
        };
        ip(&["netns", "add", &name])?;
        let mut cable = Self {
            server: ([0, 0, 0, 0], 0).into(),
            name,
            ends,
            robot_inside,
            shaper: None,
            over: Arc::default(),
        };
        cable.lay()?;
        let [ours, theirs] = &cable.ends;
        ip(&["addr", "add", &format!("{}/30", address(1)), "dev", ours])?;
        ip(&["link", "set", ours, "up"])?;
        let theirs_address = format!("{}/30", address(2));
        cable.there(&["addr", "add", &theirs_address, "dev", theirs])?;
        cable.there(&["link", "set", theirs, "up"])?;
        let listener = if robot_inside {
            cable.there(&["link", "set", "lo", "up"])?;
            TcpListener::bind((address(1), 0))?
        } else {
            cable.listen(&address(2))?
        };
        cable.server = listener.local_addr()?;
        let (portal, over) = (portal.to_owned(), cable.over.clone());
        std::thread::spawn(move || pass_on(&listener, &portal, &over));
        Ok(cable)
    }

    /// A veth pair if the kernel can degrade it, else TUN devices.
    fn lay(&mut self) -> anyhow::Result<()> {
        let [ours, theirs] = &self.ends;
        ip(&[
            "link", "add", ours, "type", "veth", "peer", "name", theirs, "netns", &self.name,
        ])?;
        ip(&["link", "set", ours, "up"])?;
        let tried = tc(&["qdisc", "add", "dev", ours, "root", "netem", "delay", "1ms"]);
        if tried.is_ok() {
            return tc(&["qdisc", "del", "dev", ours, "root"]);
        }
        ip(&["link", "del", ours])?;
        self.shaper = Some(Shaper::between(ours, theirs)?);
        ip(&["link", "set", theirs, "netns", &self.name])
    }

    /// What degrades it, for reports.
    pub fn means(&self) -> &'static str {
        match self.shaper {
            None => "netem of this kernel",
            Some(_) => "netem's rules applied between two TUN devices (this kernel has no netem)",
        }
    }

    /// Bytes that have left for the server so far, and that came from there.
    pub fn carried(&self) -> anyhow::Result<(u64, u64)> {
        let count = |what: &str| -> anyhow::Result<u64> {
            let path = format!("/sys/class/net/{}/statistics/{what}_bytes", self.ends[0]);
            let text = std::fs::read_to_string(&path).context(path)?;
            Ok(text.trim().parse()?)
        };
        let (out, back) = (count("tx")?, count("rx")?);
        Ok(if self.robot_inside {
            (back, out)
        } else {
            (out, back)
        })
    }

    /// Of the end that is not this machine's own.
    pub fn namespace(&self) -> PathBuf {
        PathBuf::from("/run/netns").join(&self.name)
    }

    /// Makes it bad, both ways.
    pub fn degrade(&self, badness: Badness) -> anyhow::Result<()> {
        match &self.shaper {
            Some(shaper) => shaper.set(Some(badness)),
            None => self.netem("replace", &badness.netem())?,
        }
        Ok(())
    }

    /// Makes it good again.
    pub fn restore(&self) -> anyhow::Result<()> {
        match &self.shaper {
            Some(shaper) => shaper.set(None),
            None => self.netem("del", &[])?,
        }
        Ok(())
    }

    fn netem(&self, what: &str, rules: &[String]) -> anyhow::Result<()> {
        let [ours, theirs] = &self.ends;
        let rules: Vec<&str> = rules.iter().map(String::as_str).collect();
        tc(&[&["qdisc", what, "dev", ours, "root"], &rules[..]].concat())?;
        let there = [
            "netns", "exec", &self.name, "tc", "qdisc", what, "dev", theirs, "root",
        ];
        ip(&[&there[..], &rules[..]].concat())
    }

    /// Runs `ip` at the server's end.
    fn there(&self, arguments: &[&str]) -> anyhow::Result<()> {
        ip(&[&["-n", &self.name], arguments].concat())
    }

    /// A socket of the server's end.
    fn listen(&self, address: &str) -> anyhow::Result<TcpListener> {
        let address = format!("{address}:0");
        Ok(within(&self.namespace(), || TcpListener::bind(address))??)
    }
}

/// Does something in a network namespace: a thread enters it and ends there. What it starts stays there.
pub fn within<T: Send>(namespace: &Path, act: impl FnOnce() -> T + Send) -> anyhow::Result<T> {
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
        // Wakes whoever accepts.
        let _ = self.restore();
        let _ = TcpStream::connect_timeout(&self.server, scale(Duration::from_secs(5)));
        let _ = ip(&["link", "del", &self.ends[0]]);
        let _ = ip(&["netns", "del", &self.name]);
    }
}

fn pass_on(listener: &TcpListener, portal: &str, over: &AtomicBool) {
    for robot in listener.incoming().flatten() {
        if over.load(Ordering::Relaxed) {
            return;
        }
        let Ok(server) = TcpStream::connect(portal) else {
            continue;
        };
        let both = robot
            .try_clone()
            .and_then(|robot| Ok((robot, server.try_clone()?)));
        let Ok((robot_too, server_too)) = both else {
            continue;
        };
        let (from, to) = (robot.local_addr(), portal.to_owned());
        std::thread::spawn(move || {
            let host = from.map(|from| from.to_string()).unwrap_or_default();
            let _ = announce(&robot, &server, &host, &to);
            copy(robot, server);
        });
        std::thread::spawn(move || copy(server_too, robot_too));
    }
}

/// Passes the head of the first request on, with the portal's own name for the host, as a reverse proxy does.
fn announce(
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
    let output = Command::new(program)
        .args(arguments)
        .output()
        .with_context(|| program.to_owned())?;
    ensure!(
        output.status.success(),
        "{program} {}: {}",
        arguments.join(" "),
        String::from_utf8_lossy(&output.stderr).trim()
    );
    Ok(())
}
