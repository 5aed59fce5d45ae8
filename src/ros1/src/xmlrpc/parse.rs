//! XML-RPC documents → values. A pull parser for the subset of XML that XML-RPC needs: no DTD, no entities except XML's
//! five and character references, attributes skipped.

use std::borrow::Cow;
use std::collections::BTreeMap;

use super::{Error, Fault, Value};

/// Maximum nesting of arrays and structs.
pub const MAX_DEPTH: usize = 100;
/// Maximum number of values in a document.
pub const MAX_ELEMENTS: usize = 500_000;

/// Returns an upper bound for the memory in bytes that a document takes during and after parsing, itself included. It
/// is computed in advance from the tags: a struct with one member is sixty bytes of text, and hundreds in memory.
pub fn weight(document: &[u8]) -> usize {
    /// A value in its list, while that grows.
    const VALUE: usize = 128;
    /// The first B-tree node of a struct; per member, its name and share of a node.
    const STRUCT: usize = 640;
    const MEMBER: usize = 192;
    let count = |tag: &str| memchr::memmem::find_iter(document, tag).count();
    // Invalid UTF-8 is copied and grows by that; base64 is collected and decoded.
    let is_text = std::str::from_utf8(document).is_ok();
    let texts = if is_text { 2 } else { 5 } + usize::from(count("<base64") > 0);
    texts * document.len() + VALUE * count("<value") + STRUCT * count("<struct") + MEMBER * count("<member")
}

/// A method call.
#[derive(Debug, Clone, PartialEq)]
pub struct MethodCall {
    /// Name of the method.
    pub method: String,
    /// Arguments, in order.
    pub params: Vec<Value>,
}

/// Parses a `methodCall` document. Invalid UTF-8 is replaced: roscpp sends strings as they were given.
pub fn parse_call(document: &[u8]) -> Result<MethodCall, Error> {
    let text = String::from_utf8_lossy(document);
    let mut parser = Parser::new(&text);
    parser.expect_start("methodCall")?;
    parser.expect_start("methodName")?;
    let method = parser.text_until_end("methodName")?.trim().to_owned();
    if method.is_empty() {
        return Err(parser.error("the methodName is empty"));
    }
    let mut params = Vec::new();
    match parser.next_token()? {
        XmlToken::End("methodCall") => return Ok(MethodCall { method, params }),
        XmlToken::Start { name: "params" } => {}
        other => return Err(parser.unexpected_error(&other, "<params>")),
    }
    loop {
        match parser.next_token()? {
            XmlToken::Start { name: "param" } => {
                params.push(parser.value()?);
                parser.expect_end("param")?;
            }
            XmlToken::End("params") => break,
            other => return Err(parser.unexpected_error(&other, "<param>")),
        }
    }
    parser.expect_end("methodCall")?;
    Ok(MethodCall { method, params })
}

/// Parses a `methodResponse` document.
pub fn parse_response(document: &[u8]) -> Result<Result<Value, Fault>, Error> {
    let text = String::from_utf8_lossy(document);
    let mut parser = Parser::new(&text);
    parser.expect_start("methodResponse")?;
    match parser.next_token()? {
        XmlToken::Start { name: "params" } => match parser.next_token()? {
            XmlToken::Start { name: "param" } => {
                let value = parser.value()?;
                parser.expect_end("param")?;
                Ok(Ok(value))
            }
            XmlToken::End("params") => Ok(Ok(Value::Nil)),
            other => Err(parser.unexpected_error(&other, "<param>")),
        },
        XmlToken::Start { name: "fault" } => {
            let value = parser.value()?;
            Ok(Err(Fault {
                code: value.get("faultCode").and_then(Value::as_int).unwrap_or(-1),
                text: match value.get("faultString") {
                    Some(Value::String(text)) => text.clone(),
                    _ => "no reason given".to_owned(),
                },
            }))
        }
        other => Err(parser.unexpected_error(&other, "<params> or <fault>")),
    }
}

#[derive(Debug, PartialEq)]
enum XmlToken<'a> {
    /// `<name …>`; a self-closing element is followed by its own [`XmlToken::End`].
    Start {
        name: &'a str,
    },
    End(&'a str),
    /// Unescaped text, never only white space.
    Text(Cow<'a, str>),
    /// The end of the document.
    Finished,
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    /// Element `<x/>` that was just opened and ends now.
    closing: Option<&'a str>,
    depth: usize,
    elements: usize,
}

impl<'a> Parser<'a> {
    fn new(text: &'a str) -> Self {
        Self { text: text.strip_prefix('\u{feff}').unwrap_or(text), at: 0, closing: None, depth: 0, elements: 0 }
    }

    fn error(&self, reason: impl Into<String>) -> Error {
        Error::Malformed { at: self.at, reason: reason.into() }
    }

    fn unexpected_error(&self, found: &XmlToken<'_>, wanted: &str) -> Error {
        let found = match found {
            XmlToken::Start { name } => format!("<{}>", truncate(name)),
            XmlToken::End(name) => format!("</{}>", truncate(name)),
            XmlToken::Text(_) => "text".to_owned(),
            XmlToken::Finished => "the end of the document".to_owned(),
        };
        self.error(format!("{found} where {wanted} should be"))
    }

    /// Returns the next start tag, end tag, or text that is not only white space.
    fn next_token(&mut self) -> Result<XmlToken<'a>, Error> {
        loop {
            match self.next_raw_token()? {
                XmlToken::Text(text) if text.chars().all(char::is_whitespace) => {}
                token => return Ok(token),
            }
        }
    }

    /// Returns the next start tag, end tag or text, including white space.
    fn next_raw_token(&mut self) -> Result<XmlToken<'a>, Error> {
        if let Some(name) = self.closing.take() {
            return Ok(XmlToken::End(name));
        }
        loop {
            let rest = &self.text[self.at..];
            if rest.is_empty() {
                return Ok(XmlToken::Finished);
            }
            if !rest.starts_with('<') {
                let end = memchr::memchr(b'<', rest.as_bytes()).unwrap_or(rest.len());
                self.at += end;
                return Ok(XmlToken::Text(unescape(&rest[..end])));
            }
            if rest.starts_with("<!--") {
                self.skip_past("-->", 4)?;
            } else if let Some(data) = rest.strip_prefix("<![CDATA[") {
                let end = data.find("]]>").ok_or_else(|| self.error("a CDATA section never ends"))?;
                self.at += "<![CDATA[".len() + end + "]]>".len();
                return Ok(XmlToken::Text(Cow::Borrowed(&data[..end])));
            } else if rest.starts_with("<?") {
                self.skip_past("?>", 2)?;
            } else if rest.starts_with("<!") {
                return Err(self.error("document type declarations are not accepted"));
            } else {
                return self.tag();
            }
        }
    }

    fn skip_past(&mut self, end: &str, from: usize) -> Result<(), Error> {
        let rest = &self.text[self.at + from..];
        let found = rest.find(end).ok_or_else(|| self.error(format!("{end} is missing")))?;
        self.at += from + found + end.len();
        Ok(())
    }

    /// Parses `<name attributes>`, `<name/>` or `</name>`, with the cursor on `<`.
    fn tag(&mut self) -> Result<XmlToken<'a>, Error> {
        let rest = &self.text[self.at + 1..];
        let mut quote = None;
        let end = rest
            .bytes()
            .position(|byte| match (quote, byte) {
                (None, b'>') => true,
                (None, b'"' | b'\'') => {
                    quote = Some(byte);
                    false
                }
                (Some(open), _) if open == byte => {
                    quote = None;
                    false
                }
                _ => false,
            })
            .ok_or_else(|| self.error("a tag never ends"))?;
        let inside = &rest[..end];
        let (closing, inside) = match inside.strip_prefix('/') {
            Some(name) => (true, name),
            None => (false, inside),
        };
        let (empty, inside) = match inside.strip_suffix('/') {
            Some(name) if !closing => (true, name),
            _ => (false, inside),
        };
        let name = inside.split(|character: char| character.is_whitespace()).next().unwrap_or_default();
        if name.is_empty() {
            return Err(self.error("a tag has no name"));
        }
        self.at += 1 + end + 1;
        if closing {
            return Ok(XmlToken::End(name));
        }
        if empty {
            self.closing = Some(name);
        }
        Ok(XmlToken::Start { name })
    }

    fn expect_start(&mut self, name: &str) -> Result<(), Error> {
        match self.next_token()? {
            XmlToken::Start { name: found } if found == name => Ok(()),
            other => Err(self.unexpected_error(&other, &format!("<{name}>"))),
        }
    }

    fn expect_end(&mut self, name: &str) -> Result<(), Error> {
        match self.next_token()? {
            XmlToken::End(found) if found == name => Ok(()),
            other => Err(self.unexpected_error(&other, &format!("</{name}>"))),
        }
    }

    /// Returns all text up to `</name>`; other elements are refused.
    fn text_until_end(&mut self, name: &str) -> Result<Cow<'a, str>, Error> {
        let mut whole = Cow::Borrowed("");
        loop {
            match self.next_raw_token()? {
                XmlToken::Text(text) if whole.is_empty() => whole = text,
                XmlToken::Text(text) => whole.to_mut().push_str(&text),
                XmlToken::End(found) if found == name => return Ok(whole),
                other => return Err(self.unexpected_error(&other, &format!("</{name}>"))),
            }
        }
    }

    /// Parses `<value>…</value>`.
    fn value(&mut self) -> Result<Value, Error> {
        self.expect_start("value")?;
        self.value_body()
    }

    /// Parses the rest of a value after `<value>`, including its end tag. Text without a type element is a string,
    /// white space included.
    fn value_body(&mut self) -> Result<Value, Error> {
        self.elements += 1;
        if self.elements > MAX_ELEMENTS {
            return Err(self.error(format!("more than {MAX_ELEMENTS} values")));
        }
        let mut bare = Cow::Borrowed("");
        loop {
            match self.next_raw_token()? {
                XmlToken::Text(text) if bare.is_empty() => bare = text,
                XmlToken::Text(text) => bare.to_mut().push_str(&text),
                XmlToken::End("value") => return Ok(Value::String(bare.into_owned())),
                XmlToken::Start { name } if bare.chars().all(char::is_whitespace) => {
                    let value = self.typed_value(name)?;
                    self.expect_end("value")?;
                    return Ok(value);
                }
                other => return Err(self.unexpected_error(&other, "</value>")),
            }
        }
    }

    fn typed_value(&mut self, name: &str) -> Result<Value, Error> {
        match name {
            "array" => self.descend(Self::array),
            "struct" => self.descend(Self::structure),
            "nil" | "ex:nil" => {
                self.text_until_end(name)?;
                Ok(Value::Nil)
            }
            "string" => Ok(Value::String(self.text_until_end(name)?.into_owned())),
            "dateTime.iso8601" => {
                let text = self.text_until_end(name)?;
                Ok(Value::DateTime(text.trim().to_owned()))
            }
            _ => {
                let text = self.text_until_end(name)?;
                self.scalar(name, text.trim())
            }
        }
    }

    fn descend(&mut self, read: fn(&mut Self) -> Result<Value, Error>) -> Result<Value, Error> {
        self.depth += 1;
        if self.depth > MAX_DEPTH {
            return Err(self.error(format!("nested more than {MAX_DEPTH} deep")));
        }
        let value = read(self)?;
        self.depth -= 1;
        Ok(value)
    }

    fn array(&mut self) -> Result<Value, Error> {
        let mut elements = Vec::new();
        match self.next_token()? {
            XmlToken::Start { name: "data" } => {}
            // XmlRpcpp writes an empty array like this.
            XmlToken::End("array") => return Ok(Value::Array(elements)),
            other => return Err(self.unexpected_error(&other, "<data>")),
        }
        loop {
            match self.next_token()? {
                XmlToken::Start { name: "value" } => elements.push(self.value_body()?),
                XmlToken::End("data") => break,
                other => return Err(self.unexpected_error(&other, "<value>")),
            }
        }
        self.expect_end("array")?;
        Ok(Value::Array(elements))
    }

    fn structure(&mut self) -> Result<Value, Error> {
        let mut members = BTreeMap::new();
        loop {
            match self.next_token()? {
                XmlToken::Start { name: "member" } => {
                    self.expect_start("name")?;
                    let name = self.text_until_end("name")?.into_owned();
                    let value = self.value()?;
                    self.expect_end("member")?;
                    members.insert(name, value);
                }
                XmlToken::End("struct") => return Ok(Value::Struct(members)),
                other => return Err(self.unexpected_error(&other, "<member>")),
            }
        }
    }

    fn scalar(&self, name: &str, text: &str) -> Result<Value, Error> {
        match name {
            "int" | "i4" | "i1" | "i2" | "i8" => {
                text.parse().map(Value::Int).map_err(|_| self.error(format!("{} is not a 32-bit integer", quote(text))))
            }
            "boolean" => match text {
                "1" | "true" => Ok(Value::Bool(true)),
                "0" | "false" => Ok(Value::Bool(false)),
                _ => Err(self.error(format!("{} is neither 0 nor 1", quote(text)))),
            },
            "double" | "float" => {
                text.parse().map(Value::Double).map_err(|_| self.error(format!("{} is not a number", quote(text))))
            }
            "base64" => {
                let dense: Vec<u8> = text.bytes().filter(|byte| !byte.is_ascii_whitespace()).collect();
                base64_simd::STANDARD
                    .decode_to_vec(dense)
                    .map(Value::Base64)
                    .map_err(|_| self.error(format!("{} is not base64", quote(text))))
            }
            _ => Err(self.error(format!("values of type {} are not known", quote(name)))),
        }
    }
}

/// Formats text for an error message: quoted, and not longer than a line.
fn quote(text: &str) -> String {
    format!("{:?}", truncate(text))
}

/// Returns the first characters: the sender of a document chooses the length of the names in it.
fn truncate(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Replaces character references; an `&` that begins none is kept, as in XmlRpcpp.
fn unescape(text: &str) -> Cow<'_, str> {
    if memchr::memchr(b'&', text.as_bytes()).is_none() {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find('&') {
        out.push_str(&rest[..start]);
        rest = &rest[start..];
        let name = rest[1..].find(';').filter(|end| *end <= 8).map(|end| &rest[1..=end]);
        match name.and_then(reference) {
            Some(character) => {
                out.push(character);
                rest = &rest[name.map_or(1, |name| name.len() + 2)..];
            }
            None => {
                out.push('&');
                rest = &rest[1..];
            }
        }
    }
    out.push_str(rest);
    Cow::Owned(out)
}

fn reference(name: &str) -> Option<char> {
    match name {
        "lt" => Some('<'),
        "gt" => Some('>'),
        "amp" => Some('&'),
        "apos" => Some('\''),
        "quot" => Some('"'),
        _ => {
            let number = name.strip_prefix('#')?;
            let code = match number.strip_prefix(['x', 'X']) {
                Some(hex) => u32::from_str_radix(hex, 16).ok()?,
                None => number.parse().ok()?,
            };
            char::from_u32(code)
        }
    }
}

#[cfg(test)]
mod tests;
