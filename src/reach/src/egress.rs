//! Egress rules: the hosts to which a servant may connect, and at which addresses. The owner of a name decides what it
//! resolves to, which may be this machine's loopback, another machine of the lab, or a cloud metadata service.
//! Therefore each resolved address is checked before a connection is made ([`Route::permits`]). Public addresses are
//! allowed; others require a line in the configuration (docs/adr/032). Allowed connections are forwarded from inside by
//! [`Relays`].

use std::fmt;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr};
use std::str::FromStr;

mod relay;

pub use relay::Relays;

/// Syntax of a destination in a push.
const DESTINATION_SYNTAX: &str = "a HOST:PORT to connect to";
/// Syntax of a rule in the configuration.
const RULE_SYNTAX: &str = "HOST:PORT, *:PORT, ADDRESS:PORT or ADDRESS/PREFIX:PORT (an IPv6 address in brackets)";

/// Reason why a route is refused.
#[derive(Debug, thiserror::Error)]
pub enum EgressError {
    /// No rule of the configuration allows it.
    #[error("egress {name} is not allowed here; the operator can add it to egress in [allow] of the configuration")]
    NotAllowed {
        /// Destination as written.
        name: String,
    },
    /// Invalid syntax.
    #[error("{name:?} is not {form}")]
    Malformed {
        /// Destination as written.
        name: String,
        /// Expected syntax.
        form: &'static str,
    },
    /// An internal address, which only a rule naming it would allow.
    #[error(
        "egress {name} leads to {reach}, which *:{port} does not allow; the operator can allow the address in [allow] \
            of the configuration: egress = [\"{address}:{port}\"]"
    )]
    Inward {
        /// Destination as requested.
        name: String,
        /// Address of the destination.
        address: IpAddr,
        /// Port of the destination.
        port: u16,
        /// Kind of the address.
        reach: Destination,
    },
}

/// One host and port that a servant may reach.
#[derive(Debug, Clone, PartialEq)]
pub struct Route {
    /// Host as named by the push.
    pub host: String,
    /// Loopback address that stands for the host inside the servant.
    pub inside: Ipv4Addr,
    /// Port, inside and outside.
    pub port: u16,
    /// A rule names this host explicitly.
    by_name: bool,
    /// Networks that rules name for this port.
    networks: Vec<EgressNetwork>,
}

/// One rule of `egress` in `[allow]`.
#[derive(Debug, Clone, PartialEq)]
struct EgressRule {
    hosts: HostPattern,
    port: u16,
}

#[derive(Debug, Clone, PartialEq)]
enum HostPattern {
    /// Any host, `*`.
    Any,
    Name(String),
    Network(EgressNetwork),
}

/// An IP network in CIDR notation.
#[derive(Debug, Clone, Copy, PartialEq)]
struct EgressNetwork {
    address: IpAddr,
    prefix: u8,
}

/// Kind of an address.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Destination {
    /// An address of the public internet.
    Public,
    /// An address of a private network (10.0.0.0/8, 192.168.0.0/16, fd00::/8, …).
    Private,
    /// Loopback of this machine.
    Loopback,
    /// Another address of this machine.
    ThisMachine,
    /// A link-local address (169.254.0.0/16, fe80::/10).
    LinkLocal,
    /// A cloud metadata service (169.254.169.254 and others).
    Metadata,
    /// 0.0.0.0 or ::.
    Unspecified,
    /// A multicast address.
    Multicast,
    /// An IPv4-mapped IPv6 address.
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
            Destination::Metadata => "a cloud metadata address",
            Destination::Unspecified => "the unspecified address",
            Destination::Multicast => "a multicast address",
            Destination::Mapped => "an IPv4-mapped address",
            Destination::Reserved => "a reserved address",
        })
    }
}

impl EgressNetwork {
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

impl FromStr for EgressNetwork {
    type Err = ();

    fn from_str(text: &str) -> Result<EgressNetwork, ()> {
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
        (prefix <= longest).then_some(EgressNetwork { address, prefix }).ok_or(())
    }
}

impl FromStr for EgressRule {
    type Err = EgressError;

    fn from_str(text: &str) -> Result<EgressRule, EgressError> {
        let malformed = || EgressError::Malformed { name: text.to_owned(), form: RULE_SYNTAX };
        let (host, port) = split_host_port(text).ok_or_else(malformed)?;
        let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
        let hosts = match bare.unwrap_or(host) {
            "*" => HostPattern::Any,
            host => match host.parse() {
                Ok(network) => HostPattern::Network(network),
                Err(()) if bare.is_none() && is_name(host) => HostPattern::Name(host.to_owned()),
                Err(()) => return Err(malformed()),
            },
        };
        Ok(EgressRule { hosts, port })
    }
}

fn split_host_port(text: &str) -> Option<(&str, u16)> {
    let (host, port) = text.rsplit_once(':')?;
    let port = port.parse().ok().filter(|port| *port != 0)?;
    Some((host, port))
}

fn is_name(host: &str) -> bool {
    let plain = |c: char| c.is_ascii_alphanumeric() || c == '.' || c == '-';
    !host.is_empty() && host.chars().all(plain)
}

/// Validates the rules of `egress` in `[allow]`.
pub fn validate(allowed: &[String]) -> Result<(), EgressError> {
    allowed.iter().try_for_each(|text| text.parse::<EgressRule>().map(drop))
}

/// Returns the routes to the hosts `asked` for, if they are `allowed`. Each host gets one address inside, so that
/// several can be reached on the same port.
pub fn routes(asked: &[String], allowed: &[String]) -> Result<Vec<Route>, EgressError> {
    let rules: Vec<EgressRule> = allowed.iter().map(|text| text.parse()).collect::<Result<_, _>>()?;
    let mut hosts: Vec<&str> = Vec::new();
    let mut routes = Vec::new();
    for name in asked {
        let malformed = || EgressError::Malformed { name: name.clone(), form: DESTINATION_SYNTAX };
        let (host, port) = split_host_port(name).ok_or_else(malformed)?;
        if !is_name(host) {
            return Err(malformed());
        }
        let index = hosts.iter().position(|known| *known == host).unwrap_or_else(|| {
            hosts.push(host);
            hosts.len() - 1
        });
        // 127.0.1.1 and up: 127.0.0.1 is the servant's own.
        let number = u8::try_from(index + 1).map_err(|_| malformed())?;
        routes.push(route(name, host, port, Ipv4Addr::new(127, 0, 1, number), &rules)?);
    }
    Ok(routes)
}

/// Returns the names of the hosts `asked` for, if they are `allowed`, each with its address inside.
pub fn hosts(asked: &[String], allowed: &[String]) -> Result<Vec<(IpAddr, String)>, EgressError> {
    let routes = routes(asked, allowed)?.into_iter();
    // IP addresses have no name.
    let named = routes.filter(|route| route.host.parse::<IpAddr>().is_err());
    Ok(named.map(|route| (IpAddr::V4(route.inside), route.host)).collect())
}

fn route(name: &str, host: &str, port: u16, inside: Ipv4Addr, rules: &[EgressRule]) -> Result<Route, EgressError> {
    let literal: Option<IpAddr> = host.parse().ok();
    let of_port = || rules.iter().filter(|rule| rule.port == port);
    let networks: Vec<EgressNetwork> = of_port()
        .filter_map(|rule| match rule.hosts {
            HostPattern::Network(network) => Some(network),
            _ => None,
        })
        .collect();
    let by_name =
        of_port().any(|rule| matches!(&rule.hosts, HostPattern::Name(known) if known.eq_ignore_ascii_case(host)));
    let any = of_port().any(|rule| rule.hosts == HostPattern::Any);
    let in_network = literal.is_some_and(|address| networks.iter().any(|network| network.contains(address)));
    if !(any || by_name || in_network) {
        return Err(EgressError::NotAllowed { name: name.to_owned() });
    }
    let route = Route { host: host.to_owned(), inside, port, by_name, networks };
    // A literal address is checked immediately, not at its first connection.
    match literal.map(|address| (address, route.permits(address))) {
        Some((address, Err(reach))) => Err(EgressError::Inward { name: name.to_owned(), address, port, reach }),
        _ => Ok(route),
    }
}

impl Route {
    /// Returns whether a connection may be made to this address, to which the host was resolved; otherwise the kind of
    /// the address.
    pub fn permits(&self, address: IpAddr) -> Result<(), Destination> {
        if self.networks.iter().any(|network| network.contains(address)) {
            return Ok(());
        }
        match classify_address(address) {
            Destination::Public => Ok(()),
            // An operator who names a host of their own network means that.
            Destination::Private | Destination::ThisMachine if self.by_name => Ok(()),
            Destination::Loopback if self.by_name && self.host.eq_ignore_ascii_case("localhost") => Ok(()),
            reach => Err(reach),
        }
    }
}

/// Classifies an address as seen from this machine.
fn classify_address(address: IpAddr) -> Destination {
    let reach = match address {
        IpAddr::V4(address) => classify_v4(address),
        IpAddr::V6(address) => classify_v6(address),
    };
    let may_be_ours = matches!(reach, Destination::Public | Destination::Private);
    if may_be_ours && is_local_address(address) { Destination::ThisMachine } else { reach }
}

/// Returns whether an address belongs to this machine: the kernel binds only its own addresses.
fn is_local_address(address: IpAddr) -> bool {
    std::net::UdpSocket::bind((address, 0)).is_ok()
}

/// Classifies an address by the special-purpose address registry (IANA, RFC 6890).
fn classify_v4(address: Ipv4Addr) -> Destination {
    match address.octets() {
        // Alibaba's, in the shared space of RFC 6598; Oracle's; Azure's, which looks public.
        [100, 100, 100, 200] | [192, 0, 0, 192] | [168, 63, 129, 16] => Destination::Metadata,
        [169, 254, 169, 253 | 254] | [169, 254, 170, 2 | 23] => Destination::Metadata,
        [169, 254, ..] => Destination::LinkLocal,
        [0, 0, 0, 0] => Destination::Unspecified,
        [0, ..] | [240..=255, ..] => Destination::Reserved,
        [127, ..] => Destination::Loopback,
        [10, ..] | [172, 16..=31, ..] | [192, 168, ..] | [100, 64..=127, ..] => Destination::Private,
        [198, 18 | 19, ..] => Destination::Private,
        [192, 0, 0 | 2, _] | [198, 51, 100, _] | [203, 0, 113, _] => Destination::Reserved,
        [224..=239, ..] => Destination::Multicast,
        _ => Destination::Public,
    }
}

/// Classifies an address by the special-purpose address registry (IANA, RFC 6890).
fn classify_v6(address: Ipv6Addr) -> Destination {
    let segments = address.segments();
    let [.., above, below] = segments;
    let embedded = |above: u16, below: u16| classify_v4(Ipv4Addr::from_bits(u32::from(above) << 16 | u32::from(below)));
    match segments {
        [0, 0, 0, 0, 0, 0, 0, 0] => Destination::Unspecified,
        [0, 0, 0, 0, 0, 0, 0, 1] => Destination::Loopback,
        [0, 0, 0, 0, 0, 0xffff, ..] => Destination::Mapped,
        // Amazon's.
        [0xfd00, 0xec2, 0, 0, 0, 0, 0, 0x254] => Destination::Metadata,
        // NAT64 (RFC 6052) and 6to4 (RFC 3056).
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

    fn to_strings(written: &[&str]) -> Vec<String> {
        written.iter().map(|text| (*text).to_owned()).collect()
    }

    fn resolve_routes(allowed: &[&str], asked: &[&str]) -> Result<Vec<Route>, EgressError> {
        routes(&to_strings(asked), &to_strings(allowed))
    }

    /// Returns whether a host that the rules allow may be dialled at an address.
    fn can_dial(allowed: &[&str], asked: &str, address: &str) -> bool {
        let routes = resolve_routes(allowed, &[asked]).expect("allowed");
        routes[0].permits(address.parse().expect("an address")).is_ok()
    }

    #[test]
    fn each_host_has_an_address_inside() {
        let routes = resolve_routes(
            &["models.example.org:443", "*:80"],
            &["models.example.org:443", "a.example:80", "models.example.org:80"],
        )
        .expect("allowed");
        let addresses: Vec<String> = routes.iter().map(|route| format!("{}:{}", route.inside, route.port)).collect();
        assert_eq!(addresses, ["127.0.1.1:443", "127.0.1.2:80", "127.0.1.1:80"]);
    }

    #[test]
    fn refusals_name_the_destination_and_the_remedy() {
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
            ("169.254.169.254:80", "leads to a cloud metadata address"),
        ] {
            let refused = resolve_routes(&allowed, &[asked]).expect_err(asked).to_string();
            assert!(refused.contains(words), "{refused}");
        }
        resolve_routes(&allowed, &["10.1.2.3:5000"]).expect("in the network");
    }

    #[test]
    fn names_that_resolve_to_internal_addresses_are_refused() {
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
            assert!(!can_dial(&["*:80"], "a.example:80", address), "{address}");
        }
        for address in ["8.8.8.8", "172.32.0.1", "2606:4700::1111", "64:ff9b::808:808"] {
            assert!(can_dial(&["*:80"], "a.example:80", address), "{address}");
        }
    }

    #[test]
    fn a_named_host_may_be_of_the_labs_own_network() {
        let named = ["a.lab:80"];
        for address in ["10.0.0.1", "192.168.7.7", "fd12:3456::1", "8.8.8.8"] {
            assert!(can_dial(&named, "a.lab:80", address), "{address}");
        }
        for address in ["127.0.0.1", "::1", "169.254.169.254", "fd00:ec2::254", "fe80::1"] {
            assert!(!can_dial(&named, "a.lab:80", address), "{address}");
        }
        assert!(can_dial(&["localhost:80"], "localhost:80", "127.0.0.1"));
        assert!(!can_dial(&["localhost:80"], "localhost:80", "169.254.1.1"));
    }

    #[test]
    fn addresses_that_are_named_may_be_reached() {
        let named = ["*:80", "127.0.0.1:80", "[fe80::/10]:80", "10.1.0.0/16:80"];
        for address in ["127.0.0.1", "fe80::7", "10.1.255.255"] {
            assert!(can_dial(&named, "a.example:80", address), "{address}");
        }
        for address in ["127.0.0.2", "10.2.0.0", "::1", "::ffff:127.0.0.1"] {
            assert!(!can_dial(&named, "a.example:80", address), "{address}");
        }
        assert!(!can_dial(&["*:80", "10.1.0.0/16:81"], "a.example:80", "10.1.0.1"));
        assert!(can_dial(&["*:80", "0.0.0.0/0:80"], "a.example:80", "127.0.0.1"));
    }

    #[test]
    fn an_address_of_this_machine_is_not_the_internet() {
        // Addresses that can be bound are distinguished from those that cannot.
        assert!(is_local_address("127.0.0.1".parse().expect("an address")));
        assert!(!is_local_address("192.0.2.1".parse().expect("an address")));
    }

    #[test]
    fn a_rule_that_cannot_be_understood_is_named() {
        for text in ["a.example", "a.example:x", "[a.example]:80", "10.0.0.0/33:80", "a/8:80", ":80", "::1:80:"] {
            let refused = validate(&to_strings(&["*:80", text])).expect_err(text).to_string();
            assert!(refused.contains(text) && refused.contains("HOST:PORT"), "{refused}");
        }
        validate(&to_strings(&["*:80", "a-b.example:443", "[::1]:80", "[fd00::/8]:1", "10.0.0.0/8:1"]))
            .expect("understood");
    }
}
