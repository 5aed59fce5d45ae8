//! The subset of JSON that an envelope needs: finds where the value of each field begins and ends, reads strings,
//! numbers and booleans, writes strings. The inside of a payload is only skipped; the codec that knows its type checks
//! it.

use std::borrow::Cow;

use crate::Problem;

/// Maximum nesting depth; no ROS message is nested deeper.
const MAX_DEPTH: usize = 128;

fn syntax_error(at: usize, reason: &'static str) -> Problem {
    Problem::Syntax { format: "JSON", at, reason }
}

/// A position in a JSON text.
pub(crate) struct JsonCursor<'a> {
    text: &'a str,
    at: usize,
}

impl<'a> JsonCursor<'a> {
    pub(crate) fn new(text: &'a str) -> Self {
        Self { text, at: 0 }
    }

    fn bytes(&self) -> &'a [u8] {
        self.text.as_bytes()
    }

    fn skip_space(&mut self) {
        let bytes = self.bytes();
        while matches!(bytes.get(self.at), Some(b' ' | b'\t' | b'\n' | b'\r')) {
            self.at += 1;
        }
    }

    fn peek(&mut self) -> Option<u8> {
        self.skip_space();
        self.bytes().get(self.at).copied()
    }

    fn expect(&mut self, byte: u8, reason: &'static str) -> Result<(), Problem> {
        if self.peek() == Some(byte) {
            self.at += 1;
            Ok(())
        } else {
            Err(syntax_error(self.at, reason))
        }
    }

    /// Calls `each` with every key and the slice of its value; the text must be exactly one object.
    pub(crate) fn object(
        &mut self,
        mut each: impl FnMut(Cow<'a, str>, &'a str) -> Result<(), Problem>,
    ) -> Result<(), Problem> {
        match self.peek() {
            Some(b'{') => self.at += 1,
            Some(b'[' | b'"' | b'0'..=b'9' | b'-' | b't' | b'f' | b'n') => {
                return Err(Problem::NotAnObject("JSON object"));
            }
            _ => return Err(syntax_error(self.at, "an object is expected")),
        }
        if self.peek() == Some(b'}') {
            self.at += 1;
        } else {
            loop {
                if self.peek() != Some(b'"') {
                    return Err(syntax_error(self.at, "a field name in quotes is expected"));
                }
                let key = self.value()?;
                let key = unescape(key).ok_or_else(|| syntax_error(self.at, "a field name has a bad escape"))?;
                self.expect(b':', "a colon is expected")?;
                let value = self.value()?;
                each(key, value)?;
                match self.peek() {
                    Some(b',') => self.at += 1,
                    Some(b'}') => {
                        self.at += 1;
                        break;
                    }
                    _ => {
                        return Err(syntax_error(self.at, "a comma or the object's end is expected"));
                    }
                }
            }
        }
        match self.peek() {
            None => Ok(()),
            Some(_) => Err(syntax_error(self.at, "nothing may follow the object")),
        }
    }

    /// Returns the slices of a list's values.
    pub(crate) fn list(&mut self) -> Option<Vec<&'a [u8]>> {
        self.expect(b'[', "a list is expected").ok()?;
        let mut items = Vec::new();
        if self.peek() == Some(b']') {
            return Some(items);
        }
        loop {
            items.push(self.value().ok()?.as_bytes());
            match self.peek()? {
                b',' => self.at += 1,
                b']' => return Some(items),
                _ => return None,
            }
        }
    }

    /// Returns the slice of the value that starts here.
    fn value(&mut self) -> Result<&'a str, Problem> {
        let first = self.peek().ok_or_else(|| syntax_error(self.at, "a value is expected"))?;
        let start = self.at;
        match first {
            b'"' => self.skip_string()?,
            b'{' | b'[' => self.skip_nested()?,
            b't' => self.skip_word("true")?,
            b'f' => self.skip_word("false")?,
            b'n' => self.skip_word("null")?,
            b'-' | b'0'..=b'9' => {
                let bytes = self.bytes();
                while matches!(bytes.get(self.at), Some(b'-' | b'+' | b'.' | b'e' | b'E' | b'0'..=b'9')) {
                    self.at += 1;
                }
            }
            _ => return Err(syntax_error(start, "a value is expected")),
        }
        Ok(&self.text[start..self.at])
    }

    fn skip_word(&mut self, word: &'static str) -> Result<(), Problem> {
        if self.bytes()[self.at..].starts_with(word.as_bytes()) {
            self.at += word.len();
            Ok(())
        } else {
            Err(syntax_error(self.at, "a value is expected"))
        }
    }

    /// Skips from an opening quote past the closing one.
    fn skip_string(&mut self) -> Result<(), Problem> {
        let bytes = self.bytes();
        let start = self.at;
        let mut at = self.at + 1;
        loop {
            match memchr::memchr2(b'"', b'\\', &bytes[at..]) {
                Some(found) if bytes[at + found] == b'"' => {
                    self.at = at + found + 1;
                    return Ok(());
                }
                Some(found) if at + found + 2 <= bytes.len() => at += found + 2,
                _ => return Err(syntax_error(start, "a string is not closed")),
            }
        }
    }

    /// Skips from an opening bracket past the matching one.
    fn skip_nested(&mut self) -> Result<(), Problem> {
        let bytes = self.bytes();
        let start = self.at;
        let mut depth = 0usize;
        while let Some(&byte) = bytes.get(self.at) {
            match byte {
                b'"' => {
                    self.skip_string()?;
                    continue;
                }
                b'{' | b'[' => {
                    depth += 1;
                    if depth > MAX_DEPTH {
                        return Err(syntax_error(self.at, "nested deeper than 128 levels"));
                    }
                }
                b'}' | b']' => {
                    depth -= 1;
                    if depth == 0 {
                        self.at += 1;
                        return Ok(());
                    }
                }
                _ => {}
            }
            self.at += 1;
        }
        Err(syntax_error(start, "a bracket is not closed"))
    }
}

/// Decodes a JSON string (`raw` includes the quotes); borrows it if nothing is escaped.
pub(crate) fn unescape(raw: &str) -> Option<Cow<'_, str>> {
    let inner = raw.strip_prefix('"')?.strip_suffix('"')?;
    if memchr::memchr(b'\\', inner.as_bytes()).is_none() {
        return if inner.bytes().any(|byte| byte < 0x20) { None } else { Some(Cow::Borrowed(inner)) };
    }
    let mut text = String::with_capacity(inner.len());
    let mut rest = inner;
    while let Some(at) = rest.find('\\') {
        text.push_str(&rest[..at]);
        let escape = *rest.as_bytes().get(at + 1)?;
        let mut used = at + 2;
        match escape {
            b'"' | b'\\' | b'/' => text.push(char::from(escape)),
            b'b' => text.push('\u{8}'),
            b'f' => text.push('\u{c}'),
            b'n' => text.push('\n'),
            b'r' => text.push('\r'),
            b't' => text.push('\t'),
            b'u' => {
                let mut unit = hex4(rest, used)?;
                used += 4;
                if (0xd800..0xdc00).contains(&unit) {
                    // A pair of surrogates is one character; a lone one becomes the replacement character.
                    match rest.get(used..used + 2) {
                        Some("\\u") => {
                            let low = hex4(rest, used + 2)?;
                            if (0xdc00..0xe000).contains(&low) {
                                unit = 0x10000 + ((unit - 0xd800) << 10) + (low - 0xdc00);
                                used += 6;
                            }
                        }
                        _ => unit = 0xfffd,
                    }
                }
                text.push(char::from_u32(unit).unwrap_or(char::REPLACEMENT_CHARACTER));
            }
            _ => return None,
        }
        rest = rest.get(used..)?;
    }
    text.push_str(rest);
    Some(Cow::Owned(text))
}

fn hex4(text: &str, at: usize) -> Option<u32> {
    let digits = text.get(at..at + 4)?;
    digits.bytes().all(|byte| byte.is_ascii_hexdigit()).then(|| u32::from_str_radix(digits, 16).ok()).flatten()
}

/// Appends `text` as a JSON string.
pub(crate) fn write_string(out: &mut Vec<u8>, text: &str) {
    const HEX: &[u8; 16] = b"0123456789abcdef";
    out.push(b'"');
    let mut start = 0;
    let bytes = text.as_bytes();
    for (at, &byte) in bytes.iter().enumerate() {
        if byte >= 0x20 && byte != b'"' && byte != b'\\' {
            continue;
        }
        out.extend_from_slice(&bytes[start..at]);
        start = at + 1;
        match byte {
            b'"' => out.extend_from_slice(b"\\\""),
            b'\\' => out.extend_from_slice(b"\\\\"),
            b'\n' => out.extend_from_slice(b"\\n"),
            b'\r' => out.extend_from_slice(b"\\r"),
            b'\t' => out.extend_from_slice(b"\\t"),
            _ => {
                out.extend_from_slice(b"\\u00");
                out.push(HEX[usize::from(byte >> 4)]);
                out.push(HEX[usize::from(byte & 15)]);
            }
        }
    }
    out.extend_from_slice(&bytes[start..]);
    out.push(b'"');
}

/// Escapes all characters of a JSON text beyond ASCII; they can only occur in its strings.
pub fn to_ascii(json: &str) -> Cow<'_, str> {
    if json.is_ascii() {
        return Cow::Borrowed(json);
    }
    let mut ascii = String::with_capacity(json.len() * 2);
    let mut units = [0; 2];
    for character in json.chars() {
        if character.is_ascii() {
            ascii.push(character);
            continue;
        }
        for unit in character.encode_utf16(&mut units) {
            ascii.push_str("\\u");
            for shift in [12, 8, 4, 0] {
                let digit = char::from_digit(u32::from(*unit >> shift) & 0xf, 16);
                ascii.extend(digit);
            }
        }
    }
    Cow::Owned(ascii)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(text: &str) -> Result<Vec<(String, String)>, Problem> {
        let mut found = Vec::new();
        JsonCursor::new(text).object(|key, value| {
            found.push((key.into_owned(), value.to_owned()));
            Ok(())
        })?;
        Ok(found)
    }

    #[test]
    fn fields_are_found_with_their_slices() {
        let found = fields(r#" { "op" : "x\"y" , "n":-1.5e3,"m":{"a":["}",{}]},"t":true,"z":null} "#).unwrap();
        let expected = [("op", r#""x\"y""#), ("n", "-1.5e3"), ("m", r#"{"a":["}",{}]}"#), ("t", "true"), ("z", "null")];
        assert_eq!(found, expected.map(|(key, value)| (key.to_owned(), value.to_owned())));
        assert_eq!(fields("{}").unwrap(), []);
    }

    #[test]
    fn broken_json_is_located() {
        for (text, at, reason) in [
            ("", 0, "an object is expected"),
            ("{", 1, "a field name in quotes is expected"),
            ("{\"a\" 1}", 5, "a colon is expected"),
            ("{\"a\":1,}", 7, "a field name in quotes is expected"),
            ("{\"a\":\"x}", 5, "a string is not closed"),
            ("{\"a\":\"x\\", 5, "a string is not closed"),
            ("{\"a\":[1,2}", 10, "a comma or the object's end is expected"),
            ("{\"a\":[1,2", 5, "a bracket is not closed"),
            ("{\"a\":tru}", 5, "a value is expected"),
            ("{\"a\":1} x", 8, "nothing may follow the object"),
        ] {
            assert_eq!(fields(text), Err(syntax_error(at, reason)), "{text}");
        }
        assert_eq!(fields("[1]"), Err(Problem::NotAnObject("JSON object")));
        let deep = format!("{{\"a\":{}{}}}", "[".repeat(100_000), "]".repeat(100_000));
        assert_eq!(fields(&deep), Err(syntax_error(133, "nested deeper than 128 levels")));
    }

    #[test]
    fn json_becomes_ascii_and_means_the_same() {
        assert!(matches!(to_ascii(r#"{"a":"b\n"}"#), Cow::Borrowed(_)));
        let json = r#"{"grüße":["🤖 \u00fc",1]}"#;
        let ascii = to_ascii(json);
        assert_eq!(ascii, r#"{"gr\u00fc\u00dfe":["\ud83e\udd16 \u00fc",1]}"#);
        let read = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
        assert_eq!(read(&ascii), read(json));
    }

    #[test]
    fn strings_go_both_ways() {
        for text in ["", "plain", "a\"b\\c/\n\r\t\u{1}", "grüße 🤖"] {
            let mut out = Vec::new();
            write_string(&mut out, text);
            let written = String::from_utf8(out).unwrap();
            assert_eq!(serde_json::from_str::<String>(&written).unwrap(), text);
            assert_eq!(unescape(&written).unwrap(), text);
        }
        assert_eq!(unescape(r#""\ud83e\udd16\u00fc""#).unwrap(), "🤖ü");
        assert_eq!(unescape(r#""\ud83e!""#).unwrap(), "\u{fffd}!");
        assert_eq!(unescape(r#""\q""#), None);
        assert_eq!(unescape(r#""\u12""#), None);
        assert_eq!(unescape("\"\n\""), None);
    }
}
