//! Pairing line: printed by the operator's program and passed to the robot's. It is a URI (RFC 3986) without
//! percent-encoding, so that a shell can parse it, too.
//!
//! `cloudroid://HOST:PORT/?robot=NAME&fingerprint=SHA256:HEX&key=BASE64URL&code=CODE`

use std::fmt;
use std::str::FromStr;

use crate::Fingerprint;

const SCHEME: &str = "cloudroid://";
/// Length of a code in characters out of 36 letters and digits: 134 bits.
pub const CODE: usize = 26;
/// Length of the key in characters: 51 bytes (RFC 8709, section 4) in base64url (RFC 4648, section 5).
const KEY: usize = 68;

/// Data a robot needs for pairing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PairingLine {
    /// Host and port of the server, as in a URI.
    pub server: String,
    /// Name of the robot.
    pub robot: String,
    /// Fingerprint of the server's certificate.
    pub fingerprint: Fingerprint,
    /// Key with which the server signs stubs: the second word of `ssh-ed25519 AAAA…`.
    pub key: String,
    /// Pairing code, valid once and for some minutes.
    pub code: String,
}

/// Error for text that is not a pairing line.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not a pairing line: {0}; copy the whole line that cloudroidctl pair ROBOT prints, between single quotes")]
pub struct ParsePairingLineError(String);

impl fmt::Display for PairingLine {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let key = self.key.replace('+', "-").replace('/', "_");
        write!(
            out,
            "{SCHEME}{}/?robot={}&fingerprint={}&key={key}&code={}",
            self.server, self.robot, self.fingerprint, self.code
        )
    }
}

/// Returns true if the text has the form of a pairing code.
pub fn is_code(text: &str) -> bool {
    let digit = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit();
    text.len() == CODE && text.chars().all(digit)
}

impl FromStr for PairingLine {
    type Err = ParsePairingLineError;

    fn from_str(text: &str) -> Result<Self, ParsePairingLineError> {
        let no = |why: &str| ParsePairingLineError(why.to_owned());
        let text = text.trim_matches([' ', '\n', '\r']);
        if text.chars().any(|c| !c.is_ascii_graphic()) {
            return Err(no("it contains spaces or control characters"));
        }
        let rest = text.strip_prefix(SCHEME).ok_or_else(|| no("it does not begin with cloudroid://"))?;
        let (server, query) = rest.split_once("/?").ok_or_else(|| no("it ends after the server's address"))?;
        let host = |c: char| c.is_ascii_alphanumeric() || ".-_:[]".contains(c);
        let port = server.rsplit_once(':').map(|(_, port)| port.parse::<u16>());
        if !server.chars().all(host) || !matches!(port, Some(Ok(_))) || server.starts_with(':') {
            return Err(no("the server's address is not HOST:PORT"));
        }
        let mut values = [None; 4];
        const NAMES: [&str; 4] = ["robot", "fingerprint", "key", "code"];
        for pair in query.split('&') {
            let (name, value) = pair.split_once('=').unwrap_or((pair, ""));
            let Some(at) = NAMES.iter().position(|known| *known == name) else {
                return Err(ParsePairingLineError(format!("this version does not know its parameter {name}")));
            };
            if values[at].replace(value).is_some() {
                return Err(ParsePairingLineError(format!("it has {name} twice")));
            }
        }
        let value = |at: usize| values[at].ok_or_else(|| ParsePairingLineError(format!("it lacks {}", NAMES[at])));
        let (robot, fingerprint, key, code) = (value(0)?, value(1)?, value(2)?, value(3)?);
        let named = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if robot.is_empty() || robot.len() > 64 || !robot.chars().all(named) {
            return Err(no("robot is not a robot's name"));
        }
        let fingerprint = fingerprint
            .parse()
            .map_err(|error: crate::ParseFingerprintError| ParsePairingLineError(error.to_string()))?;
        let encoded = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
        if key.len() != KEY || !key.chars().all(encoded) {
            return Err(no("key is not an ed25519 key"));
        }
        if !is_code(code) {
            return Err(ParsePairingLineError(format!(
                "its code has {} characters, but must have {CODE} lowercase letters and digits",
                code.len()
            )));
        }
        Ok(PairingLine {
            server: server.to_owned(),
            robot: robot.to_owned(),
            fingerprint,
            key: key.replace('-', "+").replace('_', "/"),
            code: code.to_owned(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pairing_line() -> PairingLine {
        PairingLine {
            server: "lab.example:9090".into(),
            robot: "rover-1".into(),
            fingerprint: format!("SHA256:{}", "5d".repeat(32)).parse().unwrap(),
            key: format!("AAAAC3NzaC1lZDI1NTE5AAAAI{}+/", "b".repeat(41)),
            code: "0123456789abcdefghijklmnop".into(),
        }
    }

    #[test]
    fn a_line_is_read_as_it_is_written() {
        let line = pairing_line();
        let text = line.to_string();
        assert!(!text.contains(['+', '%', '\'', ' ']), "{text}");
        assert_eq!(text.parse(), Ok(line.clone()));
        assert_eq!(format!(" {text}\n").parse(), Ok(line.clone()));
        let at = PairingLine { server: "[2001:db8::1]:9090".into(), ..line };
        assert_eq!(at.to_string().parse(), Ok(at));
    }

    #[test]
    fn what_is_no_line_is_refused_with_what_to_copy() {
        let good = pairing_line().to_string();
        let with = |old: &str, new: &str| good.replace(old, new);
        for (text, words) in [
            (String::new(), "does not begin with"),
            ("https://lab.example:9090/".into(), "does not begin with"),
            ("cloudroid://lab.example:9090".into(), "ends after"),
            (with("lab.example:9090", "lab.example"), "HOST:PORT"),
            (with("lab.example:9090", "lab.example:99999"), "HOST:PORT"),
            (with("lab.example:9090", ":9090"), "HOST:PORT"),
            (with("lab.example", "me@lab"), "HOST:PORT"),
            (with("rover-1", "rover\u{7}1"), "control characters"),
            (with("rover-1", "rover\n1"), "control characters"),
            (with("rover-1", "rover\u{1b}[2J"), "control characters"),
            (with("rover-1", "rövér"), "control characters"),
            (with("rover-1", "a$(reboot)"), "not a robot's name"),
            (with("rover-1", ""), "not a robot's name"),
            (with("rover-1", &"r".repeat(65)), "not a robot's name"),
            (with("SHA256:5d", "SHA256:"), "64 hexadecimal digits"),
            (with("key=AAAA", "key="), "not an ed25519 key"),
            (with("ijklmnop", "ijklmno"), "has 25 characters"),
            (with("ijklmnop", "ijklmnoP"), "lowercase letters"),
            (with("&code=", "&kode="), "parameter kode"),
            (format!("{good}&robot=r2"), "robot twice"),
            (good[..good.find("&code").unwrap()].into(), "lacks code"),
        ] {
            let refused = text.parse::<PairingLine>().expect_err(&text).to_string();
            assert!(refused.contains(words) && refused.contains("cloudroidctl pair"), "{text}: {refused}");
        }
    }
}
