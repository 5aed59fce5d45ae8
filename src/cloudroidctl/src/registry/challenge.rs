//! Challenges of a registry (RFC 9110, section 11.6.1): what it asks its clients to log in with.

/// Way to log in.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Challenge {
    /// User name and password (RFC 7617).
    Basic,
    /// Token of a token server (RFC 6750, and the specification of Docker's token authentication).
    Bearer {
        /// URL of the token server.
        realm: String,
        /// Name of the registry there.
        service: Option<String>,
    },
}

/// Parses the values of `WWW-Authenticate`. Unknown schemes are left out, and so is what follows a mistake.
pub fn parse_challenges<'a>(values: impl Iterator<Item = &'a str>) -> Vec<Challenge> {
    values.flat_map(parse_value).collect()
}

/// A scheme and its parameters.
struct RawChallenge {
    scheme: String,
    parameters: Vec<(String, String)>,
}

impl RawChallenge {
    fn parameter(&self, name: &str) -> Option<String> {
        let found = self.parameters.iter().find(|(own, _)| own.eq_ignore_ascii_case(name));
        found.map(|(_, value)| value.clone())
    }

    fn to_challenge(&self) -> Option<Challenge> {
        if self.scheme.eq_ignore_ascii_case("basic") {
            return Some(Challenge::Basic);
        }
        let is_bearer = self.scheme.eq_ignore_ascii_case("bearer");
        let realm = self.parameter("realm").filter(|_| is_bearer)?;
        Some(Challenge::Bearer { realm, service: self.parameter("service") })
    }
}

fn parse_value(value: &str) -> Vec<Challenge> {
    let mut found: Vec<RawChallenge> = Vec::new();
    let mut rest = value;
    loop {
        rest = rest.trim_start_matches([' ', '\t', ',']);
        let (word, after) = split_token(rest);
        if word.is_empty() {
            break;
        }
        let Some(written) = after.trim_start().strip_prefix('=') else {
            found.push(RawChallenge { scheme: word.to_owned(), parameters: Vec::new() });
            rest = after;
            continue;
        };
        let (Some((value, after)), Some(challenge)) = (split_value(written.trim_start()), found.last_mut()) else {
            break;
        };
        challenge.parameters.push((word.to_owned(), value));
        rest = after;
    }
    found.iter().filter_map(RawChallenge::to_challenge).collect()
}

/// Splits a token from the beginning of a text.
fn split_token(text: &str) -> (&str, &str) {
    let is_part = |c: char| c.is_ascii_alphanumeric() || "!#$%&'*+-.^_`|~".contains(c);
    text.split_at(text.find(|c: char| !is_part(c)).unwrap_or(text.len()))
}

/// Splits a token or a quoted string from the beginning of a text; `None` if its end is missing.
fn split_value(text: &str) -> Option<(String, &str)> {
    let Some(quoted) = text.strip_prefix('"') else {
        let (token, rest) = split_token(text);
        return Some((token.to_owned(), rest));
    };
    let mut value = String::new();
    let mut characters = quoted.char_indices();
    while let Some((place, character)) = characters.next() {
        match character {
            '"' => return Some((value, &quoted[place + 1..])),
            '\\' => value.push(characters.next()?.1),
            other => value.push(other),
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bearer(realm: &str, service: Option<&str>) -> Challenge {
        Challenge::Bearer { realm: realm.to_owned(), service: service.map(str::to_owned) }
    }

    #[test]
    fn challenges_are_read_as_registries_write_them() {
        let realm = "https://auth.example.org/token";
        let usual = r#"Bearer realm="https://auth.example.org/token",service="lab",scope="repository:x:pull,push""#;
        let spaced = r#"bearer  service = lab , realm="https://auth.example.org/token""#;
        let both = r#"Basic realm="cloudroid", charset="UTF-8", Bearer realm="https://auth.example.org/token""#;
        for (value, expected) in [
            (usual, vec![bearer(realm, Some("lab"))]),
            (spaced, vec![bearer(realm, Some("lab"))]),
            (both, vec![Challenge::Basic, bearer(realm, None)]),
            (r#"BASIC realm="a \"b\", Bearer realm=c""#, vec![Challenge::Basic]),
            ("Basic", vec![Challenge::Basic]),
            ("Bearer", vec![]),
            ("Negotiate, Digest realm=x", vec![]),
            (r#"Bearer realm="https://auth"#, vec![]),
            (r#"realm="x" Basic"#, vec![]),
            ("=,=\"", vec![]),
            ("", vec![]),
        ] {
            assert_eq!(parse_challenges([value].into_iter()), expected, "{value}");
        }
    }
}
