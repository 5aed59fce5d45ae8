//! Trusted proxies: only their forwarding headers are believed. Of the listed addresses, the right-most one that is
//! not such a proxy is the client; anything left of it may have been made up by the client.
//!
//! Reads `Forwarded` (RFC 7239) and `X-Forwarded-For`, with `X-Forwarded-Proto`. A proxy writes one of the first two
//! and may pass on the other as sent by the client; so if both are present, they must name the same client.

use std::fmt;
use std::net::{IpAddr, SocketAddr};
use std::str::FromStr;
use std::sync::Arc;

use axum::http::HeaderMap;

use crate::caller::{ConnectionPeer, PortalConnection};
use crate::errors::Error;

const FORWARDED: &str = "forwarded";
const FORWARDED_FOR: &str = "x-forwarded-for";
const FORWARDED_PROTO: &str = "x-forwarded-proto";

/// An IP network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IpNetwork {
    address: IpAddr,
    prefix: u32,
}

/// Error for text that is not a network.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{written:?} is neither an address nor a network: {why}; write one such as 192.0.2.7 or 10.0.0.0/8")]
pub struct ParseIpNetworkError {
    written: String,
    why: String,
}

fn address_bits(address: IpAddr) -> (u128, u32) {
    match address.to_canonical() {
        IpAddr::V4(address) => (u128::from(address.to_bits()) << 96, 32),
        IpAddr::V6(address) => (address.to_bits(), 128),
    }
}

/// Returns the first bits of an address; the others are 0.
fn prefix_bits(address: u128, prefix: u32) -> u128 {
    match prefix {
        0 => 0,
        prefix => address & (u128::MAX << (128 - prefix)),
    }
}

impl IpNetwork {
    /// Returns true if the network contains the address.
    pub fn contains(&self, address: IpAddr) -> bool {
        let ((own, width), (other, other_width)) = (address_bits(self.address), address_bits(address));
        width == other_width && prefix_bits(own, self.prefix) == prefix_bits(other, self.prefix)
    }
}

impl FromStr for IpNetwork {
    type Err = ParseIpNetworkError;

    fn from_str(written: &str) -> Result<IpNetwork, ParseIpNetworkError> {
        let no = |why: &str| ParseIpNetworkError { written: written.to_owned(), why: why.to_owned() };
        let (address, prefix) = match written.split_once('/') {
            Some((address, prefix)) => (address, Some(prefix)),
            None => (written, None),
        };
        let address: IpAddr = address.parse().map_err(|_| no("host names are not supported"))?;
        let (value, width) = address_bits(address);
        let prefix = match prefix {
            None => width,
            Some(prefix) => prefix
                .parse()
                .ok()
                .filter(|bits| *bits <= width)
                .ok_or_else(|| no(&format!("its prefix is not between 0 and {width}")))?,
        };
        if prefix_bits(value, prefix) != value {
            return Err(no("it has bits set beyond its prefix"));
        }
        Ok(IpNetwork { address, prefix })
    }
}

impl fmt::Display for IpNetwork {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}/{}", self.address.to_canonical(), self.prefix)
    }
}

/// The client for which a proxy forwards.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct ForwardedClient {
    /// `None` if the proxy wrote something other than an address, because it does not know or reveal it.
    address: Option<SocketAddr>,
    /// True if the client uses TLS, where the proxy says so.
    secure: Option<bool>,
}

/// The trusted proxies.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Proxies(pub Vec<IpNetwork>);

impl Proxies {
    pub(crate) fn contains(&self, address: IpAddr) -> bool {
        self.0.iter().any(|network| network.contains(address))
    }

    /// Returns the connection with the properties of the client for which a proxy forwards.
    pub(crate) fn resolve_client(
        &self,
        connection: &PortalConnection,
        headers: &HeaderMap,
    ) -> Result<PortalConnection, Error> {
        let ConnectionPeer::Tcp(proxy) = connection.peer else {
            return Ok(connection.clone());
        };
        if !self.contains(proxy.ip()) {
            return Ok(connection.clone());
        }
        let written = parse_forwarded(headers).map_err(|why| {
            let proxy = proxy.ip();
            Error::BadRequest(format!(
                "the header Forwarded, as the proxy {proxy} passed it on, {why}; configure the proxy to remove this \
                    header from its clients"
            ))
        })?;
        let (listed, protocols) = (list_values(headers, FORWARDED_FOR), list_values(headers, FORWARDED_PROTO));
        let by_standard = (!written.is_empty()).then(|| self.pick_client(written.iter().map(parse_element)));
        let by_list = (!listed.is_empty()).then(|| {
            // A single protocol belongs to the client's own connection; of several, each belongs to the address at
            // the same position.
            let beside = |at: usize| match protocols.len() {
                1 => protocols.first(),
                count if count == listed.len() => protocols.get(at),
                _ => None,
            };
            let clients = listed.iter().enumerate().map(|(at, listed)| ForwardedClient {
                address: parse_address(listed),
                secure: beside(at).map(|protocol| is_secure(protocol)),
            });
            self.pick_client(clients)
        });
        let client = match (by_standard, by_list) {
            (Some(one), Some(other)) if one.address.map(|at| at.ip()) != other.address.map(|at| at.ip()) => {
                return Err(Error::BadRequest(format!(
                    "the proxy {} names two clients, in Forwarded and in X-Forwarded-For; have it set one and remove \
                     the other",
                    proxy.ip()
                )));
            }
            (Some(one), other) => {
                ForwardedClient { secure: one.secure.or(other.and_then(|other| other.secure)), ..one }
            }
            (None, Some(other)) => other,
            (None, None) if !protocols.is_empty() => {
                ForwardedClient { address: None, secure: protocols.last().map(|protocol| is_secure(protocol)) }
            }
            // The request is the proxy's own, such as a health check.
            (None, None) => return Ok(connection.clone()),
        };
        Ok(PortalConnection {
            peer: client.address.map_or(connection.peer, ConnectionPeer::Tcp),
            secure: client.secure.unwrap_or(false),
            forwarded: true,
            // A certificate presented is the proxy's.
            certificates: Arc::default(),
            stranger: connection.stranger.clone(),
        })
    }

    /// Returns the right-most client that is not a trusted proxy, or else the left-most.
    fn pick_client(&self, clients: impl DoubleEndedIterator<Item = ForwardedClient>) -> ForwardedClient {
        let mut nearest = ForwardedClient { address: None, secure: None };
        for client in clients.rev() {
            let Some(address) = client.address else {
                // If an address is unknown, the last proxy with a known address stands for whoever is behind it.
                return ForwardedClient { secure: client.secure, ..nearest };
            };
            nearest = client;
            if !self.contains(address.ip()) {
                break;
            }
        }
        nearest
    }
}

/// Returns all values of a header that is a list, in order. Those written by proxies contain no commas or quotes.
fn list_values<'a>(headers: &'a HeaderMap, name: &str) -> Vec<&'a str> {
    let lines = headers.get_all(name).into_iter();
    // A value that is not text is not an address either.
    let lines = lines.map(|line| line.to_str().unwrap_or("?"));
    lines.flat_map(|line| line.split(',').map(str::trim)).collect()
}

/// Returns all elements of `Forwarded`, in order; commas within quotes do not count. A client that could leave a
/// quote open would swallow what the proxy appends.
fn parse_forwarded(headers: &HeaderMap) -> Result<Vec<&str>, &'static str> {
    let mut elements = Vec::new();
    for line in headers.get_all(FORWARDED) {
        let line = line.to_str().map_err(|_| "is not text")?;
        if line.matches('"').count() % 2 == 1 {
            return Err("has a quote that is not closed");
        }
        if line.contains('\\') {
            return Err("has a backslash, which no address needs");
        }
        elements.extend(split_outside_quotes(line, ',').map(str::trim));
    }
    Ok(elements)
}

/// Splits a text at a character outside of quotes.
fn split_outside_quotes(text: &str, at: char) -> impl Iterator<Item = &str> {
    let mut quoted = false;
    text.split(move |c| {
        quoted ^= c == '"';
        c == at && !quoted
    })
}

/// Parses one element of `Forwarded`.
fn parse_element(written: &&str) -> ForwardedClient {
    let mut client = ForwardedClient { address: None, secure: None };
    for pair in split_outside_quotes(written, ';') {
        let Some((name, value)) = pair.split_once('=') else {
            continue;
        };
        let value = value.trim().trim_matches('"');
        match name.trim().to_ascii_lowercase().as_str() {
            "for" => client.address = parse_address(value),
            "proto" => client.secure = Some(is_secure(value)),
            _ => {}
        }
    }
    client
}

fn is_secure(protocol: &str) -> bool {
    ["https", "wss"].iter().any(|secure| protocol.eq_ignore_ascii_case(secure))
}

/// Parses an address with or without a port; the port is 0 if missing.
fn parse_address(text: &str) -> Option<SocketAddr> {
    let bare = || {
        let inside = text.strip_prefix('[').and_then(|rest| rest.strip_suffix(']'));
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

    /// Returns the client behind `peer`, and whether it uses TLS.
    fn resolve(peer: &str, headers: &[(&'static str, &str)]) -> Result<(String, bool), Error> {
        let proxies = proxies(&["127.0.0.1", "10.0.0.0/8", "2001:db8::/32"]);
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().expect("a header"));
        }
        let address = SocketAddr::new(peer.parse().expect("an address"), 5000);
        let connection = PortalConnection::without_tls(ConnectionPeer::Tcp(address));
        let seen = proxies.resolve_client(&connection, &map)?;
        Ok((seen.peer.ip().to_string(), seen.secure))
    }

    #[test]
    fn who_is_no_named_proxy_speaks_for_itself() {
        for headers in [
            &[("x-forwarded-for", "192.0.2.1"), ("x-forwarded-proto", "https")][..],
            &[("forwarded", "for=192.0.2.1;proto=https")],
            &[],
        ] {
            for peer in ["203.0.113.9", "127.0.0.2", "11.0.0.1", "::1"] {
                assert_eq!(resolve(peer, headers).expect("seen"), (peer.to_owned(), false));
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
            // The client claims to be one of our proxies; the proxy wrote 192.0.2.1.
            ("10.9.9.9, 192.0.2.1", client),
            // All are proxies: the left-most made the request.
            ("10.0.0.1, 10.0.0.2", "10.0.0.1"),
            ("::ffff:192.0.2.1", client),
            ("[2001:db8:1::1]:80, 2001:db8::5", "2001:db8:1::1"),
            ("2003::1, 2001:db8::5", "2003::1"),
            // A client that a proxy does not reveal is represented by that proxy.
            ("unknown", "127.0.0.1"),
            ("", "127.0.0.1"),
            ("192.0.2.1,", "127.0.0.1"),
            ("192.0.2.1, not an address", "127.0.0.1"),
            ("192.0.2.1, not an address, 10.1.2.3", "10.1.2.3"),
            ("192.0.2.256", "127.0.0.1"),
            ("192.0.2.1:99999", "127.0.0.1"),
        ] {
            let listed = resolve("127.0.0.1", &[("x-forwarded-for", listed)]).expect(listed);
            assert_eq!(listed.0, who, "{listed:?}");
        }
        let many = vec!["10.0.0.1"; 5000].join(",");
        let long = format!("192.0.2.1,{many}");
        assert_eq!(resolve("127.0.0.1", &[("x-forwarded-for", &long)]).expect("seen").0, client);
        // Header lines of the same name form one list.
        let lines = [("x-forwarded-for", "198.51.100.7"), ("x-forwarded-for", client)];
        assert_eq!(resolve("127.0.0.1", &lines).expect("seen").0, client);
    }

    #[test]
    fn the_standard_header_is_read_as_it_is_written() {
        for (written, who, secure) in [
            ("for=192.0.2.1", "192.0.2.1", false),
            ("For=\"192.0.2.1:4711\";Proto=HTTPS;by=10.0.0.1", "192.0.2.1", true),
            ("for=\"[2003::1]:4711\";proto=http", "2003::1", false),
            ("for=198.51.100.7;proto=http, for=192.0.2.1;proto=https", "192.0.2.1", true),
            ("for=192.0.2.1;proto=https, for=10.0.0.3;proto=http", "192.0.2.1", true),
            ("for=_hidden;proto=https", "127.0.0.1", true),
            ("for=192.0.2.1, for=unknown", "127.0.0.1", false),
            ("by=10.0.0.1", "127.0.0.1", false),
            ("for=\"a,b\";proto=https", "127.0.0.1", true),
            (";;=,=;", "127.0.0.1", false),
        ] {
            let seen = resolve("127.0.0.1", &[("forwarded", written)]).expect(written);
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
            let headers = [("x-forwarded-for", listed), ("x-forwarded-proto", protocols)];
            let seen = resolve("127.0.0.1", &headers).expect(listed);
            assert_eq!(seen, (client.to_owned(), secure), "{listed} {protocols}");
        }
    }

    #[test]
    fn two_clients_in_one_request_are_refused() {
        let headers = [("x-forwarded-for", "192.0.2.1"), ("forwarded", "for=198.51.100.7")];
        let refused = resolve("127.0.0.1", &headers).expect_err("which?").problem();
        assert_eq!(refused.status, 400);
        assert!(refused.detail.contains("127.0.0.1"), "{refused:?}");
        let alike =
            [("x-forwarded-for", "192.0.2.1:80"), ("x-forwarded-proto", "https"), ("forwarded", "for=192.0.2.1")];
        let seen = resolve("127.0.0.1", &alike).expect("one client");
        assert_eq!(seen, ("192.0.2.1".to_owned(), true));
    }

    #[test]
    fn a_client_cannot_swallow_what_the_proxy_writes() {
        // The proxy has appended 192.0.2.1 to what its client sent.
        for sent in ["\"", "198.51.100.7, \"", "\"198.51.100.7", "\"a\"\""] {
            let listed = format!("{sent}, 192.0.2.1");
            let seen = resolve("127.0.0.1", &[("x-forwarded-for", &listed)]).expect(&listed);
            assert_eq!(seen.0, "192.0.2.1", "{listed}");
        }
        for sent in ["for=\"198.51.100.7", "for=\"\\\"\"", "for=198.51.100.7;by=\""] {
            let written = format!("{sent}, for=192.0.2.1");
            let refused = resolve("127.0.0.1", &[("forwarded", &written)]).expect_err(&written);
            let refused = refused.problem();
            assert_eq!(refused.status, 400, "{written}");
            assert!(refused.detail.contains("127.0.0.1"), "{refused:?}");
        }
    }

    #[test]
    fn a_proxys_certificate_is_not_its_clients() {
        let connection = PortalConnection {
            secure: true,
            certificates: Arc::new([vec![1].into()]),
            ..PortalConnection::without_tls(ConnectionPeer::Tcp("10.0.0.1:5".parse().expect("an address")))
        };
        let mut headers = HeaderMap::new();
        headers.insert("x-forwarded-for", "192.0.2.1".parse().expect("a header"));
        let seen = proxies(&["10.0.0.1"]).resolve_client(&connection, &headers).expect("seen");
        assert!(seen.certificates.is_empty() && !seen.secure && seen.forwarded);
        headers.clear();
        headers.insert("x-forwarded-proto", "https".parse().expect("a header"));
        let seen = proxies(&["10.0.0.1"]).resolve_client(&connection, &headers).expect("seen");
        assert!(seen.secure && seen.forwarded && seen.peer == connection.peer);
        // Without such headers the request is the proxy's own.
        let itself = proxies(&["10.0.0.1"]).resolve_client(&connection, &HeaderMap::new()).expect("seen");
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
            let network: IpNetwork = written.parse().expect(written);
            assert!(network.contains(inside.parse().expect(inside)), "{network}");
            assert!(!network.contains(outside.parse().expect(outside)), "{network}");
        }
        assert!("10.0.0.0/8".parse::<IpNetwork>().expect("v4").contains("::ffff:10.1.1.1".parse().expect("mapped")));
        for (written, words) in [
            ("proxy.lab", "host names are not supported"),
            ("", "host names are not supported"),
            ("10.0.0.0/33", "between 0 and 32"),
            ("10.0.0.0/x", "between 0 and 32"),
            ("::/129", "between 0 and 128"),
            ("10.0.0.1/8", "beyond its prefix"),
        ] {
            let refused = written.parse::<IpNetwork>().expect_err(written).to_string();
            assert!(refused.contains(words) && refused.contains("10.0.0.0/8"), "{refused}");
        }
    }
}
