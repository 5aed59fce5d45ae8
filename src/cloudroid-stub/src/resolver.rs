//! Host names without the C library: a static program has no NSS. `/etc/hosts` first, then multicast DNS for `.local`
//! (RFC 6762, one-shot queries of section 5.1), else the servers of `/etc/resolv.conf` (RFC 1035).

use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use async_trait::async_trait;
use ros::net::{HostSockets, Sockets};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::time::timeout;

const MULTICAST: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::new(224, 0, 0, 251)), 5353);
/// For one server to answer one question.
const ANSWER: Duration = Duration::from_millis(1500);
const ATTEMPTS: usize = 3;
const TYPE_A: u16 = 1;
const CLASS_IN: u16 = 1;

/// The robot's network with this resolver.
#[derive(Debug, Clone, Copy, Default)]
pub struct RobotSockets;

#[async_trait]
impl Sockets for RobotSockets {
    async fn connect(&self, address: SocketAddr) -> io::Result<TcpStream> {
        HostSockets.connect(address).await
    }

    async fn listen(&self, address: SocketAddr) -> io::Result<TcpListener> {
        HostSockets.listen(address).await
    }

    async fn resolve(&self, host: &str, port: u16) -> io::Result<SocketAddr> {
        Ok(SocketAddr::new(resolve(host).await?, port))
    }
}

/// The address of a host.
pub async fn resolve(host: &str) -> io::Result<IpAddr> {
    let bare = host
        .strip_prefix('[')
        .and_then(|rest| rest.strip_suffix(']'))
        .unwrap_or(host);
    if let Ok(literal) = bare.parse() {
        return Ok(literal);
    }
    let name = bare.trim_end_matches('.').to_ascii_lowercase();
    let hosts = std::fs::read_to_string("/etc/hosts").unwrap_or_default();
    if let Some(known) = in_hosts(&hosts, &name) {
        return Ok(known);
    }
    if name == "localhost" || name.ends_with(".localhost") {
        return Ok(Ipv4Addr::LOCALHOST.into());
    }
    if name.ends_with(".local") {
        return ask(&name, &[MULTICAST]).await;
    }
    let configuration = std::fs::read_to_string("/etc/resolv.conf").unwrap_or_default();
    let (servers, search) = in_resolv_conf(&configuration);
    let mut names: Vec<String> = search
        .iter()
        .map(|domain| format!("{name}.{domain}"))
        .collect();
    // A name with dots is first tried as it is.
    let at = if name.contains('.') { 0 } else { names.len() };
    names.insert(at, name.clone());
    let mut failure = None;
    for name in &names {
        match ask(name, &servers).await {
            Ok(address) => return Ok(address),
            Err(error) => failure = Some(error),
        }
    }
    Err(failure.unwrap_or_else(|| unknown(&name)))
}

fn unknown(name: &str) -> io::Error {
    io::Error::new(
        io::ErrorKind::NotFound,
        format!("host {name} has no address"),
    )
}

/// The address in a hosts file, IPv4 before IPv6: ROS 1 nodes listen on IPv4.
fn in_hosts(text: &str, name: &str) -> Option<IpAddr> {
    let found = text.lines().filter_map(|line| {
        let mut words = line
            .split('#')
            .next()
            .unwrap_or_default()
            .split_whitespace();
        let address: IpAddr = words.next()?.parse().ok()?;
        words
            .any(|alias| alias.eq_ignore_ascii_case(name))
            .then_some(address)
    });
    let mut found: Vec<IpAddr> = found.collect();
    found.sort_by_key(|address| !address.is_ipv4());
    found.into_iter().next()
}

/// Servers and search domains.
fn in_resolv_conf(text: &str) -> (Vec<SocketAddr>, Vec<String>) {
    let (mut servers, mut search) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let mut words = line.split_whitespace();
        match words.next() {
            Some("nameserver") => servers.extend(
                words
                    .next()
                    .and_then(|word| word.parse::<IpAddr>().ok())
                    .map(|ip| SocketAddr::new(ip, 53)),
            ),
            Some("search" | "domain") => search = words.map(str::to_owned).collect(),
            _ => {}
        }
    }
    (servers, search)
}

async fn ask(name: &str, servers: &[SocketAddr]) -> io::Result<IpAddr> {
    for attempt in 0..ATTEMPTS {
        for server in servers {
            let id = rand::random::<u16>();
            let query = query(name, id).ok_or_else(|| unknown(name))?;
            let any: SocketAddr = if server.is_ipv4() {
                (Ipv4Addr::UNSPECIFIED, 0).into()
            } else {
                (std::net::Ipv6Addr::UNSPECIFIED, 0).into()
            };
            let socket = UdpSocket::bind(any).await?;
            if socket.send_to(&query, server).await.is_err() {
                continue;
            }
            let multicast = server.ip().is_multicast();
            let answer = timeout(ANSWER, async {
                let mut buffer = [0; 1500];
                loop {
                    let (length, from) = socket.recv_from(&mut buffer).await?;
                    if !multicast && from.ip() != server.ip() {
                        continue;
                    }
                    if let Some(answer) =
                        address_in(&buffer[..length], name, (!multicast).then_some(id))
                    {
                        return Ok::<_, io::Error>(answer);
                    }
                }
            })
            .await;
            match answer {
                Ok(Ok(Some(address))) => return Ok(address),
                // The server knows that there is none.
                Ok(Ok(None)) => return Err(unknown(name)),
                Ok(Err(_)) | Err(_) => tracing::debug!(name, %server, attempt, "no answer"),
            }
        }
    }
    Err(unknown(name))
}

fn query(name: &str, id: u16) -> Option<Vec<u8>> {
    let mut out = Vec::with_capacity(64);
    out.extend(id.to_be_bytes());
    // Recursion desired; one question.
    out.extend([1, 0, 0, 1, 0, 0, 0, 0, 0, 0]);
    for label in name.split('.') {
        let length = u8::try_from(label.len())
            .ok()
            .filter(|length| (1..=63).contains(length))?;
        out.push(length);
        out.extend(label.as_bytes());
    }
    out.push(0);
    out.extend(TYPE_A.to_be_bytes());
    out.extend(CLASS_IN.to_be_bytes());
    Some(out)
}

/// The first IPv4 address in an answer to our question; `Some(None)` if there is none, `None` if it is another's.
fn address_in(message: &[u8], name: &str, id: Option<u16>) -> Option<Option<IpAddr>> {
    let number = |at: usize| {
        Some(u16::from_be_bytes([
            *message.get(at)?,
            *message.get(at + 1)?,
        ]))
    };
    let (flags, questions, answers) = (number(2)?, number(4)?, number(6)?);
    if flags & 0x8000 == 0 || id.is_some_and(|id| number(0) != Some(id)) {
        return None;
    }
    let mut at = 12;
    for _ in 0..questions {
        at = skip_name(message, at)? + 4;
    }
    let mut relevant = id.is_some();
    for _ in 0..answers {
        let owner = name_at(message, at)?;
        at = skip_name(message, at)?;
        let (kind, length) = (number(at)?, usize::from(number(at + 8)?));
        let data = message.get(at + 10..at + 10 + length)?;
        at += 10 + length;
        relevant |= owner.eq_ignore_ascii_case(name);
        // With an id the server has followed aliases for us.
        match *data {
            [a, b, c, d] if kind == TYPE_A && relevant => {
                return Some(Some(Ipv4Addr::new(a, b, c, d).into()));
            }
            _ => {}
        }
    }
    relevant.then_some(None)
}

fn skip_name(message: &[u8], mut at: usize) -> Option<usize> {
    loop {
        let length = usize::from(*message.get(at)?);
        match length {
            0 => return Some(at + 1),
            1..=63 => at += 1 + length,
            _ => return Some(at + 2),
        }
    }
}

fn name_at(message: &[u8], mut at: usize) -> Option<String> {
    let mut labels = Vec::new();
    // Each jump must go backwards, so this ends.
    let mut least = at;
    loop {
        let length = usize::from(*message.get(at)?);
        match length {
            0 => return Some(labels.join(".")),
            1..=63 => {
                labels.push(
                    String::from_utf8_lossy(message.get(at + 1..at + 1 + length)?).into_owned(),
                );
                at += 1 + length;
            }
            _ => {
                let target = (length & 0x3f) << 8 | usize::from(*message.get(at + 1)?);
                if target >= least {
                    return None;
                }
                (at, least) = (target, target);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_and_resolv_conf_are_read() {
        let hosts = "127.0.0.1 localhost\n::1 localhost brain\n# 10.0.0.9 brain\n10.0.0.2 brain.lab Brain # ours\n";
        assert_eq!(in_hosts(hosts, "brain"), Some([10, 0, 0, 2].into()));
        assert_eq!(in_hosts(hosts, "other"), None);
        let (servers, search) =
            in_resolv_conf("search lab example.org\nnameserver 10.0.0.1\nnameserver ::1\n");
        assert_eq!(
            servers,
            ["10.0.0.1:53".parse().unwrap(), "[::1]:53".parse().unwrap()]
        );
        assert_eq!(search, ["lab", "example.org"]);
    }

    #[test]
    fn an_answer_is_read_and_others_are_not() {
        let mut answer = query("brain.lab", 7).unwrap();
        answer[2] = 0x81;
        answer[7] = 2;
        // An alias, and the address of what it stands for.
        answer.extend([0xc0, 12, 0, 5, 0, 1, 0, 0, 0, 9, 0, 4, 1, b'x', 0xc0, 18]);
        answer.extend([1, b'x', 0xc0, 18, 0, 1, 0, 1, 0, 0, 0, 9, 0, 4, 10, 0, 0, 5]);
        assert_eq!(
            address_in(&answer, "brain.lab", Some(7)),
            Some(Some([10, 0, 0, 5].into()))
        );
        assert_eq!(address_in(&answer, "brain.lab", Some(8)), None);
        assert_eq!(address_in(&answer, "other.lab", None), None);
        for length in 0..answer.len() {
            let _ = address_in(&answer[..length], "brain.lab", Some(7));
        }
    }

    #[tokio::test]
    async fn names_of_this_machine_are_known_without_asking() {
        assert_eq!(
            resolve("[::1]").await.unwrap(),
            IpAddr::from(std::net::Ipv6Addr::LOCALHOST)
        );
        assert!(resolve("localhost").await.unwrap().is_loopback());
    }
}
