//! Which hosts a servant may connect to, and at which of their addresses. A name's owner decides what it resolves to: this
//! machine's loopback, another machine of the lab, or a cloud's metadata service. So each resolved address is checked before
//! it is connected to ([`Route::permits`]). Public addresses are allowed; others need a line in the configuration
//! (docs/adr/032). What is allowed is passed on from inside by [`Relays`].

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::str::FromStr;

mod relay;

pub use relay::Relays;

/// What a push has to write.
const ASKED: &str = "a HOST:PORT to connect to";
/// What the configuration has to write.
const WRITTEN: &str =
    "HOST:PORT, *:PORT, ADDRESS:PORT or ADDRESS/PREFIX:PORT (an IPv6 address in brackets)";

/// Why a way out is not given.
#[derive(Debug, thiserror::Error)]
pub enum Refused {
    /// The configuration does not allow it.
    #[error(
        "egress {name} is not allowed here; its operator may add it to egress of [allow] in the configuration"
    )]
    NotAllowed {
        /// The destination, as written.
        name: String,
    },
    /// It cannot be understood.
    #[error("{name:?} is not {form}")]
    Malformed {
        /// The destination, as written.
        name: String,
        /// What it should be.
        form: &'static str,
    },
    /// An address that only its own name allows.
    #[error(
        "egress {name} leads to {reach}, which *:{port} does not allow; its operator may name the address in [allow] of the \
         configuration: egress = [\"{address}:{port}\"]"
    )]
    Inward {
        /// As asked for.
        name: String,
        /// Its address.
        address: IpAddr,
        /// Its port.
        port: u16,
        /// What the address leads to.
        reach: Destination,
    },
}

/// One host and port that a servant may reach.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    /// The host, as its push named it.
    pub host: String,
    /// The loopback address that the host's name has inside the servant.
    pub inside: Ipv4Addr,
    /// The port, inside and outside.
    pub port: u16,
    /// The configuration names this very host.
    by_name: bool,
    /// Networks that the configuration names for this port.
    networks: Vec<Network>,
}

/// One line of `egress` in `[allow]`.
#[derive(Debug, Clone, PartialEq)]
struct Rule {
    hosts: Hosts,
    port: u16,
}

#[derive(Debug, Clone, PartialEq)]
enum Hosts {
    /// `*`.
    Any,
    Name(String),
    Network(Network),
}

/// Addresses that begin with the same bits.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Network {
    address: IpAddr,
    prefix: u8,
}

/// The kind of an address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Destination {
    /// An address of the public internet.
    Public,
    /// An address of a private network (10.0.0.0/8, 192.168.0.0/16, fd00::/8, …).
    Private,
    /// This machine's loopback.
    Loopback,
    /// Another address of this machine.
    ThisMachine,
    /// A link-local address (169.254.0.0/16, fe80::/10).
    LinkLocal,
    /// A metadata service of a cloud (169.254.169.254 and others).
    Metadata,
    /// 0.0.0.0 or ::.
    Unspecified,
    /// A multicast address.
    Multicast,
    /// An IPv4 address written as an IPv6 one.
    Mapped,
    /// Any other reserved address.
    Reserved,
}

impl fmt::Display for Destination {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str(match self {
            Destination::Public => "a public address",
            Destination::Private => "a private address",
            Destination::Loopback => "a loopback address",
            Destination::ThisMachine => "an address of this machine",
            Destination::LinkLocal => "a link-local address",
            Destination::Metadata => "an address where clouds serve metadata",
            Destination::Unspecified => "the unspecified address",
            Destination::Multicast => "a multicast address",
            Destination::Mapped => "an IPv4-mapped address",
            Destination::Reserved => "a reserved address",
        })
    }
}

impl Network {
    fn contains(&self, address: IpAddr) -> bool {
        match (self.address, address) {
            (IpAddr::V4(network), IpAddr::V4(address)) => {
                let mask = u32::MAX.checked_shl(32 - u32::from(self.prefix));
                let mask = mask.unwrap_or(0);
                network.to_bits() & mask == address.to_bits() & mask
            }
            (IpAddr::V6(network), IpAddr::V6(address)) => {
                let mask = u128::MAX.checked_shl(128 - u32::from(self.prefix));
                let mask = mask.unwrap_or(0);
                network.to_bits() & mask == address.to_bits() & mask
            }
            _ => false,
        }
    }
}

impl FromStr for Network {
    type Err = ();

    fn from_str(text: &str) -> Result<Network, ()> {
        let (address, prefix) = match text.split_once('/') {
            Some((address, prefix)) => (address, Some(prefix)),
            None => (text, None),
        };
        let address: IpAddr = address.parse().map_err(drop)?;
        let longest = if address.is_ipv4() { 32 } else { 128 };
        let prefix = match prefix {
            Some(prefix) => prefix.parse().map_err(drop)?,
            None => longest,
        };
        (prefix <= longest)
            .then_some(Network { address, prefix })
            .ok_or(())
    }
}

impl FromStr for Rule {
    type Err = Refused;

    fn from_str(text: &str) -> Result<Rule, Refused> {
        let malformed = || Refused::Malformed {
            name: text.to_owned(),
            form: WRITTEN,
        };
        let (host, port) = split(text).ok_or_else(malformed)?;
        let bare = host
            .strip_prefix('[')
            .and_then(|host| host.strip_suffix(']'));
        let hosts = match bare.unwrap_or(host) {
            "*" => Hosts::Any,
            host => match host.parse() {
                Ok(network) => Hosts::Network(network),
                Err(()) if bare.is_none() && is_name(host) => Hosts::Name(host.to_owned()),
                Err(()) => return Err(malformed()),
            },
        };
        Ok(Rule { hosts, port })
    }
}

fn split(text: &str) -> Option<(&str, u16)> {
    let (host, port) = text.rsplit_once(':')?;
    let port = port.parse().ok().filter(|port| *port != 0)?;
    Some((host, port))
}

fn is_name(host: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '-';
    !host.is_empty() && host.chars().all(plain)
}

/// Refuses a configuration (`egress` in `[allow]`) in which something cannot be understood.
pub fn check(allowed: &[String]) -> Result<(), Refused> {
    allowed
        .iter()
        .try_for_each(|text| text.parse::<Rule>().map(drop))
}

/// Each host `asked` for, if it is `allowed`. One address inside for each host, so that several can be reached on the same port.
pub fn routes(asked: &[String], allowed: &[String]) -> Result<Vec<Route>, Refused> {
    let rules: Vec<Rule> = allowed
        .iter()
        .map(|text| text.parse())
        .collect::<Result<_, _>>()?;
    let mut hosts: Vec<&str> = Vec::new();
    let mut routes = Vec::new();
    for name in asked {
        let malformed = || Refused::Malformed {
            name: name.clone(),
            form: ASKED,
        };
        let (host, port) = split(name).ok_or_else(malformed)?;
        if !is_name(host) {
            return Err(malformed());
        }
        let index = hosts
            .iter()
            .position(|known| *known == host)
            .unwrap_or_else(|| {
                hosts.push(host);
                hosts.len() - 1
            });
        // 127.0.1.1 and on: 127.0.0.1 is the servant's own.
        let number = u8::try_from(index + 1).map_err(|_| malformed())?;
        routes.push(route(
            name,
            host,
            port,
            Ipv4Addr::new(127, 0, 1, number),
            &rules,
        )?);
    }
    Ok(routes)
}

/// Names of the hosts `asked` for, if they are `allowed`, each with the address inside that stands for it.
pub fn hosts(asked: &[String], allowed: &[String]) -> Result<Vec<(IpAddr, String)>, Refused> {
    let routes = routes(asked, allowed)?.into_iter();
    // What is an address already has no name.
    let named = routes.filter(|route| route.host.parse::<IpAddr>().is_err());
    Ok(named
        .map(|route| (IpAddr::V4(route.inside), route.host))
        .collect())
}

fn route(
    name: &str,
    host: &str,
    port: u16,
    inside: Ipv4Addr,
    rules: &[Rule],
) -> Result<Route, Refused> {
    let literal: Option<IpAddr> = host.parse().ok();
    let of_port = || rules.iter().filter(|rule| rule.port == port);
    let networks: Vec<Network> = of_port()
        .filter_map(|rule| match rule.hosts {
            Hosts::Network(network) => Some(network),
            _ => None,
        })
        .collect();
    let by_name = of_port()
        .any(|rule| matches!(&rule.hosts, Hosts::Name(known) if known.eq_ignore_ascii_case(host)));
    let any = of_port().any(|rule| rule.hosts == Hosts::Any);
    let in_network =
        literal.is_some_and(|address| networks.iter().any(|network| network.contains(address)));
    if !(any || by_name || in_network) {
        return Err(Refused::NotAllowed {
            name: name.to_owned(),
        });
    }
    let route = Route {
        host: host.to_owned(),
        inside,
        port,
        by_name,
        networks,
    };
    // What is an address already need not wait for its first connection.
    match literal.map(|address| (address, route.permits(address))) {
        Some((address, Err(reach))) => Err(Refused::Inward {
            name: name.to_owned(),
            address,
            port,
            reach,
        }),
        _ => Ok(route),
    }
}

impl Route {
    /// Whether this address, to which the host was resolved, may be dialled; else what it leads to.
    pub fn permits(&self, address: IpAddr) -> Result<(), Destination> {
        if self
            .networks
            .iter()
            .any(|network| network.contains(address))
        {
            return Ok(());
        }
        match reach(address) {
            Destination::Public => Ok(()),
            // Whoever names a host of their own network means that.
            Destination::Private | Destination::ThisMachine if self.by_name => Ok(()),
            Destination::Loopback
                if self.by_name && self.host.eq_ignore_ascii_case("localhost") =>
            {
                Ok(())
            }
            reach => Err(reach),
        }
    }
}

/// What an address leads to, seen from this machine.
fn reach(address: IpAddr) -> Destination {
    let reach = match address {
        IpAddr::V4(address) => of_v4(address),
        IpAddr::V6(address) => of_v6(address),
    };
    let may_be_ours = matches!(reach, Destination::Public | Destination::Private);
    if may_be_ours && is_of_this_machine(address) {
        Destination::ThisMachine
    } else {
        reach
    }
}

/// Whether an address is this machine's: the kernel binds only its own addresses.
fn is_of_this_machine(address: IpAddr) -> bool {
    std::net::UdpSocket::bind((address, 0)).is_ok()
}

/// By the registry of special-purpose addresses (IANA, RFC 6890).
fn of_v4(address: Ipv4Addr) -> Destination {
    match address.octets() {
        // Alibaba's, in the space that RFC 6598 shares out; Oracle's; Azure's, which looks public.
        [100, 100, 100, 200] | [192, 0, 0, 192] | [168, 63, 129, 16] => Destination::Metadata,
        [169, 254, 169, 253 | 254] | [169, 254, 170, 2 | 23] => Destination::Metadata,
        [169, 254, ..] => Destination::LinkLocal,
        [0, 0, 0, 0] => Destination::Unspecified,
        [0, ..] | [240..=255, ..] => Destination::Reserved,
        [127, ..] => Destination::Loopback,
        [10, ..] | [172, 16..=31, ..] | [192, 168, ..] | [100, 64..=127, ..] => {
            Destination::Private
        }
        [198, 18 | 19, ..] => Destination::Private,
        [192, 0, 0 | 2, _] | [198, 51, 100, _] | [203, 0, 113, _] => Destination::Reserved,
        [224..=239, ..] => Destination::Multicast,
        _ => Destination::Public,
    }
}

/// By the registry of special-purpose addresses (IANA, RFC 6890).
fn of_v6(address: Ipv6Addr) -> Destination {
    let segments = address.segments();
    let [.., above, below] = segments;
    let embedded = |above: u16, below: u16| {
        of_v4(Ipv4Addr::from_bits(
            u32::from(above) << 16 | u32::from(below),
        ))
    };
    match segments {
        [0, 0, 0, 0, 0, 0, 0, 0] => Destination::Unspecified,
        [0, 0, 0, 0, 0, 0, 0, 1] => Destination::Loopback,
        [0, 0, 0, 0, 0, 0xffff, ..] => Destination::Mapped,
        // Amazon's.
        [0xfd00, 0xec2, 0, 0, 0, 0, 0, 0x254] => Destination::Metadata,
        // Through a translator to IPv4 (RFC 6052), by a relay to IPv4 (RFC 3056).
        [0x64, 0xff9b, 0, 0, 0, 0, ..] => embedded(above, below),
        [0x2002, above, below, ..] => embedded(above, below),
        [0xfe80..=0xfebf, ..] => Destination::LinkLocal,
        [0xfc00..=0xfdff, ..] | [0xfec0..=0xfeff, ..] => Destination::Private,
        [0xff00..=0xffff, ..] => Destination::Multicast,
        [0x2001, 0..=0x1ff | 0xdb8, ..] => Destination::Reserved,
        [0x2000..=0x3fff, ..] => Destination::Public,
        _ => Destination::Reserved,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(written: &[&str]) -> Vec<String> {
        written.iter().map(|text| (*text).to_owned()).collect()
    }

    fn out(allowed: &[&str], asked: &[&str]) -> Result<Vec<Route>, Refused> {
        routes(&list(asked), &list(allowed))
    }

    /// Whether a host that the rules allow may be dialled at an address.
    fn dials(allowed: &[&str], asked: &str, address: &str) -> bool {
        let routes = out(allowed, &[asked]).expect("allowed");
        routes[0]
            .permits(address.parse().expect("an address"))
            .is_ok()
    }

    #[test]
    fn each_host_has_an_address_inside() {
        let routes = out(
            &["models.example.org:443", "*:80"],
            &[
                "models.example.org:443",
                "a.example:80",
                "models.example.org:80",
            ],
        )
        .expect("allowed");
        let addresses: Vec<String> = routes
            .iter()
            .map(|route| format!("{}:{}", route.inside, route.port))
            .collect();
        assert_eq!(addresses, ["127.0.1.1:443", "127.0.1.2:80", "127.0.1.1:80"]);
    }

    #[test]
    fn what_is_not_allowed_is_named_with_the_way_out() {
        let allowed = ["models.example.org:443", "*:80", "10.1.0.0/16:5000"];
        for (asked, words) in [
            ("a.example:443", "egress a.example:443 is not allowed"),
            ("10.2.0.1:5000", "egress 10.2.0.1:5000 is not allowed"),
            ("a.example", "HOST:PORT"),
            ("a.example:0", "HOST:PORT"),
            ("a b:80", "HOST:PORT"),
            ("*:80", "HOST:PORT"),
            ("127.0.0.1:80", "leads to a loopback address"),
            ("127.0.0.1:80", r#"egress = ["127.0.0.1:80"]"#),
            ("169.254.169.254:80", "where clouds serve metadata"),
        ] {
            let refused = out(&allowed, &[asked]).expect_err(asked).to_string();
            assert!(refused.contains(words), "{refused}");
        }
        out(&allowed, &["10.1.2.3:5000"]).expect("in the network");
    }

    #[test]
    fn whatever_a_name_leads_to_inward_is_refused() {
        for address in [
            "127.0.0.1",
            "127.8.8.8",
            "0.0.0.0",
            "0.1.2.3",
            "10.0.0.1",
            "172.16.0.1",
            "172.31.255.255",
            "192.168.1.1",
            "100.64.0.1",
            "100.100.100.200",
            "169.254.0.7",
            "169.254.169.254",
            "192.0.0.192",
            "168.63.129.16",
            "224.0.0.1",
            "239.255.255.250",
            "255.255.255.255",
            "::",
            "::1",
            "::ffff:127.0.0.1",
            "::ffff:8.8.8.8",
            "::7f00:1",
            "64:ff9b::7f00:1",
            "64:ff9b::a9fe:a9fe",
            "2002:7f00:1::",
            "2002:c0a8:101::1",
            "fe80::1",
            "fec0::1",
            "fc00::1",
            "fd00:ec2::254",
            "fd12:3456::1",
            "ff02::1",
        ] {
            assert!(!dials(&["*:80"], "a.example:80", address), "{address}");
        }
        for address in [
            "8.8.8.8",
            "172.32.0.1",
            "2606:4700::1111",
            "64:ff9b::808:808",
        ] {
            assert!(dials(&["*:80"], "a.example:80", address), "{address}");
        }
    }

    #[test]
    fn a_named_host_may_be_of_the_labs_own_network() {
        let named = ["a.lab:80"];
        for address in ["10.0.0.1", "192.168.7.7", "fd12:3456::1", "8.8.8.8"] {
            assert!(dials(&named, "a.lab:80", address), "{address}");
        }
        for address in [
            "127.0.0.1",
            "::1",
            "169.254.169.254",
            "fd00:ec2::254",
            "fe80::1",
        ] {
            assert!(!dials(&named, "a.lab:80", address), "{address}");
        }
        assert!(dials(&["localhost:80"], "localhost:80", "127.0.0.1"));
        assert!(!dials(&["localhost:80"], "localhost:80", "169.254.1.1"));
    }

    #[test]
    fn addresses_that_are_named_may_be_reached() {
        let named = ["*:80", "127.0.0.1:80", "[fe80::/10]:80", "10.1.0.0/16:80"];
        for address in ["127.0.0.1", "fe80::7", "10.1.255.255"] {
            assert!(dials(&named, "a.example:80", address), "{address}");
        }
        for address in ["127.0.0.2", "10.2.0.0", "::1", "::ffff:127.0.0.1"] {
            assert!(!dials(&named, "a.example:80", address), "{address}");
        }
        assert!(!dials(
            &["*:80", "10.1.0.0/16:81"],
            "a.example:80",
            "10.1.0.1"
        ));
        assert!(dials(
            &["*:80", "0.0.0.0/0:80"],
            "a.example:80",
            "127.0.0.1"
        ));
    }

    #[test]
    fn an_address_of_this_machine_is_not_the_internet() {
        // Whatever is bound on loopback is told apart from what is not.
        assert!(is_of_this_machine("127.0.0.1".parse().expect("an address")));
        assert!(!is_of_this_machine(
            "192.0.2.1".parse().expect("an address")
        ));
    }

    #[test]
    fn a_rule_that_cannot_be_understood_is_named() {
        for text in [
            "a.example",
            "a.example:x",
            "[a.example]:80",
            "10.0.0.0/33:80",
            "a/8:80",
            ":80",
            "::1:80:",
        ] {
            let refused = check(&list(&["*:80", text])).expect_err(text).to_string();
            assert!(
                refused.contains(text) && refused.contains("HOST:PORT"),
                "{refused}"
            );
        }
        check(&list(&[
            "*:80",
            "a-b.example:443",
            "[::1]:80",
            "[fd00::/8]:1",
            "10.0.0.0/8:1",
        ]))
        .expect("understood");
    }
}
