//! ROS names and the addresses of ROS nodes.

/// Maximum length of a name.
const MAX_NAME: usize = 1024;

/// Returns true if `name` is absolute and made of the characters that ROS allows: `/camera/image_raw`.
pub fn is_global(name: &str) -> bool {
    name.len() <= MAX_NAME
        && name.len() > 1
        && name.starts_with('/')
        && !name.ends_with('/')
        && !name.contains("//")
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_' || byte == b'/')
}

/// Makes `name` absolute as the ROS Master does: `/x` stays, `~x` goes below the node, `x` beside it.
pub fn resolve(name: &str, node: &str) -> String {
    let joined = match name.strip_prefix('~') {
        Some(private) => format!("{node}/{private}"),
        None if name.starts_with('/') => name.to_owned(),
        None => {
            let parent = node.rfind('/').map_or("", |slash| &node[..slash]);
            format!("{parent}/{name}")
        }
    };
    canonical(&joined)
}

/// Normalizes a name: one slash at the start and between parts, none at the end; `/` alone is the root.
pub fn canonical(name: &str) -> String {
    let mut out = String::with_capacity(name.len() + 1);
    for part in parts(name) {
        out.push('/');
        out.push_str(part);
    }
    if out.is_empty() {
        out.push('/');
    }
    out
}

/// Returns the parts between slashes.
pub fn parts(name: &str) -> impl DoubleEndedIterator<Item = &str> {
    name.split('/').filter(|part| !part.is_empty())
}

/// Address of a node's server: `http://host:port/path` or `rosrpc://host:port`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct PeerUri {
    /// Host name or literal address.
    pub host: String,
    /// TCP port.
    pub port: u16,
    /// Path, at least `/`.
    pub path: String,
}

impl PeerUri {
    /// Parses an address of the given scheme.
    pub fn parse(uri: &str, scheme: &str) -> Option<Self> {
        let rest = uri.strip_prefix(scheme)?.strip_prefix("://")?;
        let (authority, path) = match rest.find('/') {
            Some(slash) => (&rest[..slash], &rest[slash..]),
            None => (rest, "/"),
        };
        let authority = authority.rsplit('@').next()?;
        let (host, port) = authority.rsplit_once(':')?;
        let clean = |text: &str| text.bytes().all(|byte| byte.is_ascii_graphic());
        if host.is_empty() || host.len() > 255 || !clean(host) || path.len() > 255 || !clean(path) {
            return None;
        }
        Some(Self { host: host.to_owned(), port: port.parse().ok().filter(|port| *port > 0)?, path: path.to_owned() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_resolve_as_the_master_resolves_them() {
        assert_eq!(resolve("/a//b/", "/n"), "/a/b");
        assert_eq!(resolve("~p", "/ns/node"), "/ns/node/p");
        assert_eq!(resolve("p", "/ns/node"), "/ns/p");
        assert_eq!(resolve("p", "/node"), "/p");
        assert_eq!(resolve("p", "anonymous"), "/p");
        assert_eq!(resolve("", "/ns/node"), "/ns");
        assert_eq!(resolve("/", "/node"), "/");
    }

    #[test]
    fn only_absolute_clean_names_are_global() {
        for good in ["/a", "/a/b_2", "/_hidden"] {
            assert!(is_global(good), "{good}");
        }
        for bad in ["", "/", "a", "/a/", "/a//b", "/ä", "/a b", "~a"] {
            assert!(!is_global(bad), "{bad}");
        }
        assert!(!is_global(&format!("/{}", "x".repeat(MAX_NAME))));
    }

    #[test]
    fn addresses_are_read() {
        let uri = PeerUri::parse("http://localhost:11311/RPC2", "http").unwrap();
        assert_eq!((uri.host.as_str(), uri.port, uri.path.as_str()), ("localhost", 11311, "/RPC2"));
        assert_eq!(PeerUri::parse("rosrpc://[::1]:5", "rosrpc").unwrap().host, "[::1]");
        for bad in ["http://host/", "http://:1/", "http://h:0/", "http://h:99999/", "h:1", "http://a\r\nb:1/"] {
            assert_eq!(PeerUri::parse(bad, "http"), None, "{bad}");
        }
    }
}
