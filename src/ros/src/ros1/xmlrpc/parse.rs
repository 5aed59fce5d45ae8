//! XML-RPC documents → values. A pull parser for the little XML that XML-RPC needs: no DTD, no entities but
//! the five of XML and character references, attributes skipped.

use std::borrow::Cow;
use std::collections::BTreeMap;

use super::{Error, Fault, Value};

/// Arrays and structs within each other, at most.
pub const MAX_DEPTH: usize = 100;
/// Values in one document, at most.
pub const MAX_ELEMENTS: usize = 500_000;

/// Bytes that a document takes in memory while it is read and afterwards, at most, itself included. They are known before it is read,
/// from its tags: a structure of one member is sixty bytes of text, and hundreds of memory.
pub fn weight(document: &[u8]) -> usize {
    /// A value in the list that holds it, while that grows.
    const VALUE: usize = 128;
    /// The first node of a structure, and a member's name and part of a node.
    const STRUCT: usize = 640;
    const MEMBER: usize = 192;
    let count = |tag: &str| memchr::memmem::find_iter(document, tag).count();
    // What is no UTF-8 is copied, and grows by that; base64 is gathered and decoded.
    let is_text = std::str::from_utf8(document).is_ok();
    let texts = if is_text { 2 } else { 5 } + usize::from(count("<base64") > 0);
    texts * document.len()
        + VALUE * count("<value")
        + STRUCT * count("<struct")
        + MEMBER * count("<member")
}

/// A method call.
#[derive(Debug, Clone, PartialEq)]
pub struct Call {
    /// The method's name.
    pub method: String,
    /// Arguments, in order.
    pub params: Vec<Value>,
}

/// Reads a `methodCall` document. Bytes that are not UTF-8 are replaced: roscpp sends what it was given.
pub fn parse_call(document: &[u8]) -> Result<Call, Error> {
    let text = String::from_utf8_lossy(document);
    let mut parser = Parser::new(&text);
    parser.expect_start("methodCall")?;
    parser.expect_start("methodName")?;
    let method = parser.text_until_end("methodName")?.trim().to_owned();
    if method.is_empty() {
        return Err(parser.error("the methodName is empty"));
    }
    let mut params = Vec::new();
    match parser.token()? {
        Token::End("methodCall") => return Ok(Call { method, params }),
        Token::Start { name: "params" } => {}
        other => return Err(parser.unexpected(&other, "<params>")),
    }
    loop {
        match parser.token()? {
            Token::Start { name: "param" } => {
                params.push(parser.value()?);
                parser.expect_end("param")?;
            }
            Token::End("params") => break,
            other => return Err(parser.unexpected(&other, "<param>")),
        }
    }
    parser.expect_end("methodCall")?;
    Ok(Call { method, params })
}

/// Reads a `methodResponse` document.
pub fn parse_response(document: &[u8]) -> Result<Result<Value, Fault>, Error> {
    let text = String::from_utf8_lossy(document);
    let mut parser = Parser::new(&text);
    parser.expect_start("methodResponse")?;
    match parser.token()? {
        Token::Start { name: "params" } => match parser.token()? {
            Token::Start { name: "param" } => {
                let value = parser.value()?;
                parser.expect_end("param")?;
                Ok(Ok(value))
            }
            Token::End("params") => Ok(Ok(Value::Nil)),
            other => Err(parser.unexpected(&other, "<param>")),
        },
        Token::Start { name: "fault" } => {
            let value = parser.value()?;
            Ok(Err(Fault {
                code: value.get("faultCode").and_then(Value::as_int).unwrap_or(-1),
                text: match value.get("faultString") {
                    Some(Value::String(text)) => text.clone(),
                    _ => "no reason given".to_owned(),
                },
            }))
        }
        other => Err(parser.unexpected(&other, "<params> or <fault>")),
    }
}

#[derive(Debug, PartialEq)]
enum Token<'a> {
    /// `<name …>`; a self-closing element is followed by its own [`Token::End`].
    Start {
        name: &'a str,
    },
    End(&'a str),
    /// Unescaped text, never only white space.
    Text(Cow<'a, str>),
    /// The document is over.
    Finished,
}

struct Parser<'a> {
    text: &'a str,
    at: usize,
    /// An element `<x/>` was just opened and closes now.
    closing: Option<&'a str>,
    depth: usize,
    elements: usize,
}

impl<'a> Parser<'a> {
    fn new(text: &'a str) -> Self {
        Self {
            text: text.strip_prefix('\u{feff}').unwrap_or(text),
            at: 0,
            closing: None,
            depth: 0,
            elements: 0,
        }
    }

    fn error(&self, reason: impl Into<String>) -> Error {
        Error::Malformed {
            at: self.at,
            reason: reason.into(),
        }
    }

    fn unexpected(&self, found: &Token<'_>, wanted: &str) -> Error {
        let found = match found {
            Token::Start { name } => format!("<{}>", short(name)),
            Token::End(name) => format!("</{}>", short(name)),
            Token::Text(_) => "text".to_owned(),
            Token::Finished => "the end of the document".to_owned(),
        };
        self.error(format!("{found} where {wanted} should be"))
    }

    /// The next start tag, end tag, or text that is not only white space.
    fn token(&mut self) -> Result<Token<'a>, Error> {
        loop {
            match self.raw_token()? {
                Token::Text(text) if text.chars().all(char::is_whitespace) => {}
                token => return Ok(token),
            }
        }
    }

    /// The next start tag, end tag or text, white space included.
    fn raw_token(&mut self) -> Result<Token<'a>, Error> {
        if let Some(name) = self.closing.take() {
            return Ok(Token::End(name));
        }
        loop {
            let rest = &self.text[self.at..];
            if rest.is_empty() {
                return Ok(Token::Finished);
            }
            if !rest.starts_with('<') {
                let end = memchr::memchr(b'<', rest.as_bytes()).unwrap_or(rest.len());
                self.at += end;
                return Ok(Token::Text(unescape(&rest[..end])));
            }
            if rest.starts_with("<!--") {
                self.skip_past("-->", 4)?;
            } else if let Some(data) = rest.strip_prefix("<![CDATA[") {
                let end = data
                    .find("]]>")
                    .ok_or_else(|| self.error("a CDATA section never ends"))?;
                self.at += "<![CDATA[".len() + end + "]]>".len();
                return Ok(Token::Text(Cow::Borrowed(&data[..end])));
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
        let found = rest
            .find(end)
            .ok_or_else(|| self.error(format!("{end} is missing")))?;
        self.at += from + found + end.len();
        Ok(())
    }

    /// `<name attributes>`, `<name/>` or `</name>`, with the cursor on `<`.
    fn tag(&mut self) -> Result<Token<'a>, Error> {
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
        let name = inside
            .split(|character: char| character.is_whitespace())
            .next()
            .unwrap_or_default();
        if name.is_empty() {
            return Err(self.error("a tag has no name"));
        }
        self.at += 1 + end + 1;
        if closing {
            return Ok(Token::End(name));
        }
        if empty {
            self.closing = Some(name);
        }
        Ok(Token::Start { name })
    }

    fn expect_start(&mut self, name: &str) -> Result<(), Error> {
        match self.token()? {
            Token::Start { name: found } if found == name => Ok(()),
            other => Err(self.unexpected(&other, &format!("<{name}>"))),
        }
    }

    fn expect_end(&mut self, name: &str) -> Result<(), Error> {
        match self.token()? {
            Token::End(found) if found == name => Ok(()),
            other => Err(self.unexpected(&other, &format!("</{name}>"))),
        }
    }

    /// All text up to `</name>`; other elements are refused.
    fn text_until_end(&mut self, name: &str) -> Result<Cow<'a, str>, Error> {
        let mut whole = Cow::Borrowed("");
        loop {
            match self.raw_token()? {
                Token::Text(text) if whole.is_empty() => whole = text,
                Token::Text(text) => whole.to_mut().push_str(&text),
                Token::End(found) if found == name => return Ok(whole),
                other => return Err(self.unexpected(&other, &format!("</{name}>"))),
            }
        }
    }

    /// `<value>…</value>`.
    fn value(&mut self) -> Result<Value, Error> {
        self.expect_start("value")?;
        self.value_body()
    }

    /// What follows `<value>`, with its end tag. Text without a type element is a string, white space included.
    fn value_body(&mut self) -> Result<Value, Error> {
        self.elements += 1;
        if self.elements > MAX_ELEMENTS {
            return Err(self.error(format!("more than {MAX_ELEMENTS} values")));
        }
        let mut bare = Cow::Borrowed("");
        loop {
            match self.raw_token()? {
                Token::Text(text) if bare.is_empty() => bare = text,
                Token::Text(text) => bare.to_mut().push_str(&text),
                Token::End("value") => return Ok(Value::String(bare.into_owned())),
                Token::Start { name } if bare.chars().all(char::is_whitespace) => {
                    let value = self.typed(name)?;
                    self.expect_end("value")?;
                    return Ok(value);
                }
                other => return Err(self.unexpected(&other, "</value>")),
            }
        }
    }

    fn typed(&mut self, name: &str) -> Result<Value, Error> {
        match name {
            "array" => self.deeper(Self::array),
            "struct" => self.deeper(Self::structure),
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
                scalar(name, text.trim()).map_err(|reason| self.error(reason))
            }
        }
    }

    fn deeper(&mut self, read: fn(&mut Self) -> Result<Value, Error>) -> Result<Value, Error> {
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
        match self.token()? {
            Token::Start { name: "data" } => {}
            // XmlRpcpp writes an empty array so.
            Token::End("array") => return Ok(Value::Array(elements)),
            other => return Err(self.unexpected(&other, "<data>")),
        }
        loop {
            match self.token()? {
                Token::Start { name: "value" } => elements.push(self.value_body()?),
                Token::End("data") => break,
                other => return Err(self.unexpected(&other, "<value>")),
            }
        }
        self.expect_end("array")?;
        Ok(Value::Array(elements))
    }

    fn structure(&mut self) -> Result<Value, Error> {
        let mut members = BTreeMap::new();
        loop {
            match self.token()? {
                Token::Start { name: "member" } => {
                    self.expect_start("name")?;
                    let name = self.text_until_end("name")?.into_owned();
                    let value = self.value()?;
                    self.expect_end("member")?;
                    members.insert(name, value);
                }
                Token::End("struct") => return Ok(Value::Struct(members)),
                other => return Err(self.unexpected(&other, "<member>")),
            }
        }
    }
}

fn scalar(name: &str, text: &str) -> Result<Value, String> {
    match name {
        "int" | "i4" | "i1" | "i2" | "i8" => text
            .parse()
            .map(Value::Int)
            .map_err(|_| format!("{} is not a 32-bit integer", quoted(text))),
        "boolean" => match text {
            "1" | "true" => Ok(Value::Bool(true)),
            "0" | "false" => Ok(Value::Bool(false)),
            _ => Err(format!("{} is neither 0 nor 1", quoted(text))),
        },
        "double" | "float" => text
            .parse()
            .map(Value::Double)
            .map_err(|_| format!("{} is not a number", quoted(text))),
        "base64" => {
            let dense: Vec<u8> = text
                .bytes()
                .filter(|byte| !byte.is_ascii_whitespace())
                .collect();
            base64_simd::STANDARD
                .decode_to_vec(dense)
                .map(Value::Base64)
                .map_err(|_| format!("{} is not base64", quoted(text)))
        }
        _ => Err(format!("values of type {} are not known", quoted(name))),
    }
}

/// Text for an error message: quoted, and not longer than a line.
fn quoted(text: &str) -> String {
    format!("{:?}", short(text))
}

/// Its first characters: who sends a document chooses how long a name in it is.
fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Replaces references to characters; an `&` that begins none stays, as XmlRpcpp leaves it.
fn unescape(text: &str) -> Cow<'_, str> {
    if memchr::memchr(b'&', text.as_bytes()).is_none() {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find('&') {
        out.push_str(&rest[..start]);
        rest = &rest[start..];
        let name = rest[1..]
            .find(';')
            .filter(|end| *end <= 8)
            .map(|end| &rest[1..=end]);
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
