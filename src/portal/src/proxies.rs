//! Proxies that the operator names: from them alone it is believed for whom they ask. Of the addresses that they tell, the
//! right-most that is no such proxy's is the client's: what stands left of it, the client may have written itself.
//!
//! `Forwarded` (RFC 7239) and `X-Forwarded-For` are read, with `X-Forwarded-Proto`. A proxy writes one of the first two and
//! may pass on the other as the client sent it; so where both are there, they must name the same client.

use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::str::FromStr;
use std::sync::Arc;

use axum::http::HeaderMap;

use crate::errors::Error;
use crate::guard::{Connection, Peer};

const FORWARDED: &str = "forwarded";
const FORWARDED_FOR: &str = "x-forwarded-for";
const FORWARDED_PROTO: &str = "x-forwarded-proto";

/// Addresses that share their first bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Network {
    address: IpAddr,
    prefix: u32,
}

/// A text that is no network.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{written:?} is no address and no network: {why}; write one such as 192.0.2.7 or 10.0.0.0/8"
)]
pub struct NoNetwork {
    written: String,
    why: String,
}

fn bits(address: IpAddr) -> (u128, u32) {
    match address.to_canonical() {
        IpAddr::V4(address) => (u128::from(address.to_bits()) << 96, 32),
        IpAddr::V6(address) => (address.to_bits(), 128),
    }
}

/// The first bits of an address; the others are 0.
fn first(address: u128, prefix: u32) -> u128 {
    match prefix {
        0 => 0,
        prefix => address & (u128::MAX << (128 - prefix)),
    }
}

impl Network {
    /// Whether an address is of it.
    pub fn has(&self, address: IpAddr) -> bool {
        let ((own, width), (other, other_width)) = (bits(self.address), bits(address));
        width == other_width && first(own, self.prefix) == first(other, self.prefix)
    }
}

impl FromStr for Network {
    type Err = NoNetwork;

    fn from_str(written: &str) -> Result<Network, NoNetwork> {
        let no = |why: &str| NoNetwork {
            written: written.to_owned(),
            why: why.to_owned(),
        };
        let (address, prefix) = match written.split_once('/') {
            Some((address, prefix)) => (address, Some(prefix)),
            None => (written, None),
        };
        let address: IpAddr = address
            .parse()
            .map_err(|_| no("names of hosts are not looked up"))?;
        let (value, width) = bits(address);
        let prefix = match prefix {
            None => width,
            Some(prefix) => prefix
                .parse()
                .ok()
                .filter(|bits| *bits <= width)
                .ok_or_else(|| no(&format!("its prefix is not between 0 and {width}")))?,
        };
        if first(value, prefix) != value {
            return Err(no("it has bits beyond its prefix"));
        }
        Ok(Network { address, prefix })
    }
}

impl fmt::Display for Network {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}/{}", self.address.to_canonical(), self.prefix)
    }
}

/// For whom a proxy asks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Client {
    /// None: what the proxy wrote is no address; it does not know, or does not tell.
    address: Option<SocketAddr>,
    /// Through TLS, where the proxy says so.
    secure: Option<bool>,
}

/// The proxies that are named.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Proxies(pub Vec<Network>);

impl Proxies {
    pub(crate) fn has(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.has(address))
    }

    /// A connection as its request's client has it: of that for which a proxy asks.
    pub(crate) fn seen(
        &self,
        connection: &Connection,
        headers: &HeaderMap,
    ) -> Result<Connection, Error> {
        let Peer::Tcp(proxy) = connection.peer else {
            return Ok(connection.clone());
        };
        if !self.has(proxy.ip()) {
            return Ok(connection.clone());
        }
        let written = quoted(headers).map_err(|why| {
            let proxy = proxy.ip();
            Error::BadRequest(format!(
                "the header Forwarded, as the proxy {proxy} passed it on, {why}; have it remove what its clients send"
            ))
        })?;
        let (listed, protocols) = (
            values(headers, FORWARDED_FOR),
            values(headers, FORWARDED_PROTO),
        );
        let by_standard = (!written.is_empty()).then(|| self.client(written.iter().map(element)));
        let by_list = (!listed.is_empty()).then(|| {
            // One value is of the client's own connection; of several, each is of the address beside it.
            let beside = |at: usize| match protocols.len() {
                1 => protocols.first(),
                count if count == listed.len() => protocols.get(at),
                _ => None,
            };
            let clients = listed.iter().enumerate().map(|(at, listed)| Client {
                address: address(listed),
                secure: beside(at).map(|protocol| is_secure(protocol)),
            });
            self.client(clients)
        });
        let client = match (by_standard, by_list) {
            (Some(one), Some(other))
                if one.address.map(|at| at.ip()) != other.address.map(|at| at.ip()) =>
            {
                return Err(Error::BadRequest(format!(
                    "the proxy {} names two clients, in Forwarded and in X-Forwarded-For; have it set one and remove the other",
                    proxy.ip()
                )));
            }
            (Some(one), other) => Client {
                secure: one.secure.or(other.and_then(|other| other.secure)),
                ..one
            },
            (None, Some(other)) => other,
            (None, None) if !protocols.is_empty() => Client {
                address: None,
                secure: protocols.last().map(|protocol| is_secure(protocol)),
            },
            // It asks for itself: to see whether this portal is well, say.
            (None, None) => return Ok(connection.clone()),
        };
        Ok(Connection {
            peer: client.address.map_or(connection.peer, Peer::Tcp),
            secure: client.secure.unwrap_or(false),
            forwarded: true,
            // What the proxy shows is the proxy's.
            certificates: Arc::default(),
            stranger: connection.stranger.clone(),
        })
    }

    /// The right-most of those that are no proxies that are named, or the left-most.
    fn client(&self, clients: impl DoubleEndedIterator<Item = Client>) -> Client {
        let mut nearest = Client {
            address: None,
            secure: None,
        };
        for client in clients.rev() {
            let Some(address) = client.address else {
                // The last proxy whose address is known stands for whoever is behind it.
                return Client {
                    secure: client.secure,
                    ..nearest
                };
            };
            nearest = client;
            if !self.has(address.ip()) {
                break;
            }
        }
        nearest
    }
}

/// All values of a header that is a list, in their order. None of those that proxies write has a comma or a quote in it.
fn values<'a>(headers: &'a HeaderMap, name: &str) -> Vec<&'a str> {
    let lines = headers.get_all(name).into_iter();
    // What is no text is no address either.
    let lines = lines.map(|line| line.to_str().unwrap_or("?"));
    lines
        .flat_map(|line| line.split(',').map(str::trim))
        .collect()
}

/// All elements of `Forwarded`, in their order; commas within quotes do not count. A client that could leave a quote open
/// would take what the proxy writes behind it for its own value.
fn quoted(headers: &HeaderMap) -> Result<Vec<&str>, &'static str> {
    let mut elements = Vec::new();
    for line in headers.get_all(FORWARDED) {
        let line = line.to_str().map_err(|_| "is no text")?;
        if line.matches('"').count() % 2 == 1 {
            return Err("has a quote that is not closed");
        }
        if line.contains('\\') {
            return Err("has a backslash, which no address needs");
        }
        elements.extend(unquoted(line, ',').map(str::trim));
    }
    Ok(elements)
}

/// Splits a text where a character stands outside of quotes.
fn unquoted(text: &str, at: char) -> impl Iterator<Item = &str> {
    let mut quoted = false;
    text.split(move |c| {
        quoted ^= c == '"';
        c == at && !quoted
    })
}

/// One element of `Forwarded`.
fn element(written: &&str) -> Client {
    let mut client = Client {
        address: None,
        secure: None,
    };
    for pair in unquoted(written, ';') {
        let Some((name, value)) = pair.split_once('=') else {
            continue;
        };
        let value = value.trim().trim_matches('"');
        match name.trim().to_ascii_lowercase().as_str() {
            "for" => client.address = address(value),
            "proto" => client.secure = Some(is_secure(value)),
            _ => {}
        }
    }
    client
}

fn is_secure(protocol: &str) -> bool {
    ["https", "wss"]
        .iter()
        .any(|secure| protocol.eq_ignore_ascii_case(secure))
}

/// An address with or without a port; port 0 where none is told.
fn address(text: &str) -> Option<SocketAddr> {
    let bare = || {
        let inside = text
            .strip_prefix('[')
            .and_then(|rest| rest.strip_suffix(']'));
        let address: IpAddr = inside.unwrap_or(text).parse().ok()?;
        Some(SocketAddr::new(address, 0))
    };
    let address: SocketAddr = text.parse().ok().or_else(bare)?;
    Some(SocketAddr::new(address.ip().to_canonical(), address.port()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn proxies(written: &[&str]) -> Proxies {
        Proxies(written.iter().map(|one| one.parse().expect(one)).collect())
    }

    /// Who is seen behind `peer`, and whether through TLS.
    fn seen(peer: &str, headers: &[(&'static str, &str)]) -> Result<(String, bool), Error> {
        let proxies = proxies(&["127.0.0.1", "10.0.0.0/8", "2001:db8::/32"]);
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().expect("a header"));
        }
        let address = SocketAddr::new(peer.parse().expect("an address"), 5000);
        let connection = Connection::plain(Peer::Tcp(address));
        let seen = proxies.seen(&connection, &map)?;
        Ok((seen.peer.ip().to_string(), seen.secure))
    }

    #[test]
    fn who_is_no_named_proxy_speaks_for_itself() {
        for headers in [
            &[
                ("x-forwarded-for", "192.0.2.1"),
                ("x-forwarded-proto", "https"),
            ][..],
            &[("forwarded", "for=192.0.2.1;proto=https")],
            &[],
        ] {
            for peer in ["203.0.113.9", "127.0.0.2", "11.0.0.1", "::1"] {
                assert_eq!(seen(peer, headers).expect("seen"), (peer.to_owned(), false));
            }
        }
    }

    #[test]
    fn the_right_most_that_is_no_named_proxy_counts() {
        let client = "192.0.2.1";
        for (listed, who) in [
            ("192.0.2.1", client),
            ("192.0.2.1:1234", client),
            ("198.51.100.7, 192.0.2.1", client),
            ("198.51.100.7, 192.0.2.1, 10.1.2.3", client),
            ("192.0.2.1 ,10.1.2.3,10.1.2.4", client),
            // Itself says that it is a proxy of ours: its proxy wrote 192.0.2.1.
            ("10.9.9.9, 192.0.2.1", client),
            // All are proxies: the left-most has asked.
            ("10.0.0.1, 10.0.0.2", "10.0.0.1"),
            ("::ffff:192.0.2.1", client),
            ("[2001:db8:1::1]:80, 2001:db8::5", "2001:db8:1::1"),
            ("2003::1, 2001:db8::5", "2003::1"),
            // Whom a proxy does not tell is that proxy.
            ("unknown", "127.0.0.1"),
            ("", "127.0.0.1"),
            ("192.0.2.1,", "127.0.0.1"),
            ("192.0.2.1, not an address", "127.0.0.1"),
            ("192.0.2.1, not an address, 10.1.2.3", "10.1.2.3"),
            ("192.0.2.256", "127.0.0.1"),
            ("192.0.2.1:99999", "127.0.0.1"),
        ] {
            let listed = seen("127.0.0.1", &[("x-forwarded-for", listed)]).expect(listed);
            assert_eq!(listed.0, who, "{listed:?}");
        }
        let many = vec!["10.0.0.1"; 5000].join(",");
        let long = format!("192.0.2.1,{many}");
        assert_eq!(
            seen("127.0.0.1", &[("x-forwarded-for", &long)])
                .expect("seen")
                .0,
            client
        );
        // Lines of the same name are one list.
        let lines = [
            ("x-forwarded-for", "198.51.100.7"),
            ("x-forwarded-for", client),
        ];
        assert_eq!(seen("127.0.0.1", &lines).expect("seen").0, client);
    }

    #[test]
    fn the_standard_header_is_read_as_it_is_written() {
        for (written, who, secure) in [
            ("for=192.0.2.1", "192.0.2.1", false),
            (
                "For=\"192.0.2.1:4711\";Proto=HTTPS;by=10.0.0.1",
                "192.0.2.1",
                true,
            ),
            ("for=\"[2003::1]:4711\";proto=http", "2003::1", false),
            (
                "for=198.51.100.7;proto=http, for=192.0.2.1;proto=https",
                "192.0.2.1",
                true,
            ),
            (
                "for=192.0.2.1;proto=https, for=10.0.0.3;proto=http",
                "192.0.2.1",
                true,
            ),
            ("for=_hidden;proto=https", "127.0.0.1", true),
            ("for=192.0.2.1, for=unknown", "127.0.0.1", false),
            ("by=10.0.0.1", "127.0.0.1", false),
            ("for=\"a,b\";proto=https", "127.0.0.1", true),
            (";;=,=;", "127.0.0.1", false),
        ] {
            let seen = seen("127.0.0.1", &[("forwarded", written)]).expect(written);
            assert_eq!(seen, (who.to_owned(), secure), "{written}");
        }
    }

    #[test]
    fn the_scheme_is_that_of_the_clients_own_connection() {
        let client = "192.0.2.1";
        for (listed, protocols, secure) in [
            (client, "https", true),
            (client, "wss", true),
            (client, "http", false),
            (client, "", false),
            ("192.0.2.1, 10.0.0.1", "https", true),
            ("192.0.2.1, 10.0.0.1", "https, http", true),
            ("198.51.100.7, 192.0.2.1", "https, http", false),
            ("192.0.2.1", "https, http", false),
        ] {
            let headers = [
                ("x-forwarded-for", listed),
                ("x-forwarded-proto", protocols),
            ];
            let seen = seen("127.0.0.1", &headers).expect(listed);
            assert_eq!(seen, (client.to_owned(), secure), "{listed} {protocols}");
        }
    }

    #[test]
    fn two_clients_in_one_request_are_refused() {
        let headers = [
            ("x-forwarded-for", "192.0.2.1"),
            ("forwarded", "for=198.51.100.7"),
        ];
        let refused = seen("127.0.0.1", &headers).expect_err("which?").problem();
        assert_eq!(refused.status, 400);
        assert!(refused.detail.contains("127.0.0.1"), "{refused:?}");
        let alike = [
            ("x-forwarded-for", "192.0.2.1:80"),
            ("x-forwarded-proto", "https"),
            ("forwarded", "for=192.0.2.1"),
        ];
        let seen = seen("127.0.0.1", &alike).expect("one client");
        assert_eq!(seen, ("192.0.2.1".to_owned(), true));
    }

    #[test]
    fn a_client_cannot_swallow_what_the_proxy_writes() {
        // The proxy has appended 192.0.2.1 to what its client sent.
        for sent in ["\"", "198.51.100.7, \"", "\"198.51.100.7", "\"a\"\""] {
            let listed = format!("{sent}, 192.0.2.1");
            let seen = seen("127.0.0.1", &[("x-forwarded-for", &listed)]).expect(&listed);
            assert_eq!(seen.0, "192.0.2.1", "{listed}");
        }
        for sent in [
            "for=\"198.51.100.7",
            "for=\"\\\"\"",
            "for=198.51.100.7;by=\"",
        ] {
            let written = format!("{sent}, for=192.0.2.1");
            let refused = seen("127.0.0.1", &[("forwarded", &written)]).expect_err(&written);
            let refused = refused.problem();
            assert_eq!(refused.status, 400, "{written}");
            assert!(refused.detail.contains("127.0.0.1"), "{refused:?}");
        }
    }

    #[test]
    fn a_proxys_certificate_is_not_its_clients() {
        let connection = Connection {
            secure: true,
            certificates: Arc::new([vec![1].into()]),
            ..Connection::plain(Peer::Tcp("10.0.0.1:5".parse().expect("an address")))
        };
        let mut headers = HeaderMap::new();
        headers.insert("x-forwarded-for", "192.0.2.1".parse().expect("a header"));
        let seen = proxies(&["10.0.0.1"])
            .seen(&connection, &headers)
            .expect("seen");
        assert!(seen.certificates.is_empty() && !seen.secure && seen.forwarded);
        headers.clear();
        headers.insert("x-forwarded-proto", "https".parse().expect("a header"));
        let seen = proxies(&["10.0.0.1"])
            .seen(&connection, &headers)
            .expect("seen");
        assert!(seen.secure && seen.forwarded && seen.peer == connection.peer);
        // Without such headers it asks for itself.
        let itself = proxies(&["10.0.0.1"])
            .seen(&connection, &HeaderMap::new())
            .expect("seen");
        assert!(!itself.certificates.is_empty() && itself.secure && !itself.forwarded);
    }

    #[test]
    fn networks_are_read_or_refused_with_what_is_right() {
        for (written, inside, outside) in [
            ("192.0.2.7", "192.0.2.7", "192.0.2.8"),
            ("10.0.0.0/8", "10.255.0.1", "11.0.0.0"),
            ("0.0.0.0/0", "203.0.113.1", "::1"),
            ("::/0", "2003::1", "203.0.113.1"),
            ("2001:db8::/33", "2001:db8:7fff::", "2001:db8:8000::"),
        ] {
            let network: Network = written.parse().expect(written);
            assert!(network.has(inside.parse().expect(inside)), "{network}");
            assert!(!network.has(outside.parse().expect(outside)), "{network}");
        }
        assert!(
            "10.0.0.0/8"
                .parse::<Network>()
                .expect("v4")
                .has("::ffff:10.1.1.1".parse().expect("mapped"))
        );
        for (written, words) in [
            ("proxy.lab", "names of hosts"),
            ("", "names of hosts"),
            ("10.0.0.0/33", "between 0 and 32"),
            ("10.0.0.0/x", "between 0 and 32"),
            ("::/129", "between 0 and 128"),
            ("10.0.0.1/8", "beyond its prefix"),
        ] {
            let refused = written.parse::<Network>().expect_err(written).to_string();
            assert!(
                refused.contains(words) && refused.contains("10.0.0.0/8"),
                "{refused}"
            );
        }
    }
}
