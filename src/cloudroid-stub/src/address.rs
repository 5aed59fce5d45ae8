//! The portal's address, as `stub.toml` says it: `ws://host:9090`, or `wss://host` where TLS is spoken.

/// A portal's address, taken apart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Address {
    /// TLS is spoken.
    pub secure: bool,
    /// Name or IP address, without brackets.
    pub host: String,
    /// The port; WebSocket's own (RFC 6455, section 3) where none is said.
    pub port: u16,
    /// Host and port as written, for HTTP's `Host`.
    pub authority: String,
}

impl Address {
    /// The name by which its certificate is remembered: host and port.
    pub fn known_as(&self) -> String {
        match self.host.contains(':') {
            true => format!("[{}]:{}", self.host, self.port),
            false => format!("{}:{}", self.host, self.port),
        }
    }

    /// Reads it; says what is wrong with it.
    pub fn parse(server: &str) -> Result<Self, String> {
        let wrong = |what: &str| {
            format!("server is {server:?}: {what}, such as ws://host:9090 or wss://host")
        };
        let (scheme, authority) = server
            .split_once("://")
            .ok_or_else(|| wrong("it should be an address"))?;
        let secure = match scheme {
            "ws" => false,
            "wss" => true,
            _ => return Err(wrong("it should begin with ws:// or wss://")),
        };
        let authority = authority.trim_end_matches('/');
        if authority.is_empty()
            || authority.contains(['/', '?', '#', '@'])
            || authority.contains(char::is_whitespace)
        {
            return Err(wrong("it should be a host and a port and nothing else"));
        }
        let (host, port) = match authority.rsplit_once(':') {
            Some((host, port)) if !port.contains(']') => {
                let port = port
                    .parse()
                    .map_err(|_| wrong("its port should be a number"))?;
                (host, port)
            }
            _ => (authority, if secure { 443 } else { 80 }),
        };
        Ok(Self {
            secure,
            host: host.trim_matches(['[', ']']).to_owned(),
            port,
            authority: authority.to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn addresses_are_taken_apart() {
        let parts = |server| {
            let address = Address::parse(server).unwrap();
            (address.secure, address.host, address.port)
        };
        assert_eq!(
            parts("ws://robots.local:9090/"),
            (false, "robots.local".into(), 9090)
        );
        assert_eq!(parts("ws://server"), (false, "server".into(), 80));
        assert_eq!(parts("wss://server"), (true, "server".into(), 443));
        assert_eq!(parts("ws://[::1]:81"), (false, "::1".into(), 81));
        assert_eq!(parts("ws://[::1]"), (false, "::1".into(), 80));
    }

    #[test]
    fn others_are_named_with_what_is_right() {
        for server in [
            "cloud:9090",
            "http://cloud",
            "ws://",
            "ws://a/b",
            "ws://a:b",
            "ws://me@a",
        ] {
            let words = Address::parse(server).unwrap_err();
            assert!(
                words.contains(server) && words.contains("ws://host:9090"),
                "{words}"
            );
        }
    }
}
