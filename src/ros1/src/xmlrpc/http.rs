//! The part of HTTP/1.1 that XML-RPC needs: heads and bodies in both directions, read with limits.

use std::io;

use budget::Permit;
use bytes::{Buf as _, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _};

/// Maximum size of start line and header fields together.
const MAX_HEAD: usize = 16 << 10;
/// Maximum number of header fields.
const MAX_FIELDS: usize = 100;
/// Minimum space reserved per read; bigger bodies grow as they arrive.
const READ_STEP: usize = 8 << 10;
/// Size up to which bodies are not charged to a budget: the number of connections bounds them.
pub(super) const SMALL: usize = 64 << 10;
/// Step in which bigger bodies are charged as they arrive.
const CHARGE_STEP: usize = 256 << 10;

/// Error reading a message.
#[derive(Debug, thiserror::Error)]
pub(super) enum HttpError {
    #[error(transparent)]
    Io(#[from] io::Error),
    /// Status to answer with, and the problem.
    #[error("{1}")]
    Bad(u16, String),
}

fn bad(status: u16, reason: impl Into<String>) -> HttpError {
    HttpError::Bad(status, reason.into())
}

/// Start line and header fields.
#[derive(Debug)]
pub(super) struct HttpHead {
    pub(super) start: String,
    /// Names are in lower case.
    fields: Vec<(String, String)>,
}

impl HttpHead {
    pub(super) fn field(&self, name: &str) -> Option<&str> {
        self.fields.iter().find(|(found, _)| found == name).map(|(_, value)| value.as_str())
    }

    /// Returns true if the connection may carry another message after this one.
    pub(super) fn keeps_alive(&self, version: &str) -> bool {
        match self.field("connection").map(str::to_ascii_lowercase) {
            Some(tokens) if tokens.contains("close") => false,
            Some(tokens) if tokens.contains("keep-alive") => true,
            _ => version == "HTTP/1.1",
        }
    }

    /// Returns true if the peer waits for `100 Continue` before it sends the body.
    pub(super) fn expects_continue(&self) -> bool {
        self.field("expect").is_some_and(|value| value.eq_ignore_ascii_case("100-continue"))
    }

    /// Returns the announced length, if there is one.
    pub(super) fn content_length(&self) -> Result<Option<usize>, HttpError> {
        self.field("content-length")
            .map(|text| text.parse().map_err(|_| bad(400, format!("Content-Length {text:?} is not a number"))))
            .transpose()
    }

    fn is_chunked(&self) -> bool {
        self.field("transfer-encoding").is_some_and(|value| value.to_ascii_lowercase().contains("chunked"))
    }
}

/// Reads messages from one side of a connection.
pub(super) struct HttpReader {
    buffer: BytesMut,
}

impl HttpReader {
    pub(super) fn new() -> Self {
        Self { buffer: BytesMut::new() }
    }

    /// Returns true if nothing of a next message has arrived yet.
    pub(super) fn is_empty(&self) -> bool {
        self.buffer.is_empty()
    }

    /// Returns the number of bytes read beyond the last message.
    pub(super) fn len(&self) -> usize {
        self.buffer.len()
    }

    /// Charges the body read so far, including the read buffer, to the permit.
    fn grow_permit(&self, before: usize, permit: &mut Permit) -> Result<(), HttpError> {
        let size = before + self.buffer.len();
        if size <= SMALL {
            return Ok(());
        }
        let counted = permit.grow_to(size.next_multiple_of(CHARGE_STEP));
        counted.map_err(|full| bad(503, full.to_string()))
    }

    /// Reads more; returns false at the end of the stream.
    pub(super) async fn fill(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> io::Result<bool> {
        self.buffer.reserve(READ_STEP);
        Ok(stream.read_buf(&mut self.buffer).await? > 0)
    }

    async fn read_more(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> Result<(), HttpError> {
        if self.fill(stream).await? { Ok(()) } else { Err(io::Error::from(io::ErrorKind::UnexpectedEof).into()) }
    }

    /// Reads one line without its line end.
    async fn read_line(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
        budget: &mut usize,
    ) -> Result<String, HttpError> {
        loop {
            if let Some(end) = memchr::memchr(b'\n', &self.buffer) {
                *budget = budget
                    .checked_sub(end + 1)
                    .ok_or_else(|| bad(431, format!("the head is over {MAX_HEAD} bytes")))?;
                let line = self.buffer.split_to(end + 1);
                let line = line.strip_suffix(b"\n").unwrap_or(&line);
                let line = line.strip_suffix(b"\r").unwrap_or(line);
                return Ok(String::from_utf8_lossy(line).into_owned());
            }
            if self.buffer.len() > *budget {
                return Err(bad(431, format!("the head is over {MAX_HEAD} bytes")));
            }
            self.read_more(stream).await?;
        }
    }

    /// Reads start line and fields; skips blank lines before them.
    pub(super) async fn read_head(&mut self, stream: &mut (impl AsyncRead + Unpin)) -> Result<HttpHead, HttpError> {
        let mut budget = MAX_HEAD;
        let mut start = String::new();
        while start.is_empty() {
            start = self.read_line(stream, &mut budget).await?;
        }
        let mut fields = Vec::new();
        loop {
            let line = self.read_line(stream, &mut budget).await?;
            if line.is_empty() {
                return Ok(HttpHead { start, fields });
            }
            if fields.len() == MAX_FIELDS {
                return Err(bad(431, format!("more than {MAX_FIELDS} header fields")));
            }
            let (name, value) = line.split_once(':').ok_or_else(|| bad(400, "a header field has no colon"))?;
            fields.push((name.trim().to_ascii_lowercase(), value.trim().to_owned()));
        }
    }

    /// Reads the body announced by `head`. Without any length, a response lasts until the stream ends (`until_end`),
    /// and a request has none. `permit` grows with the body.
    pub(super) async fn read_body(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
        head: &HttpHead,
        max: usize,
        until_end: bool,
        permit: &mut Permit,
    ) -> Result<Vec<u8>, HttpError> {
        let too_large = || bad(413, format!("the body is over {max} bytes"));
        if head.is_chunked() {
            return self.read_chunks(stream, max, permit).await;
        }
        let Some(length) = head.content_length()? else {
            if !until_end {
                return Err(bad(411, "Content-Length is missing"));
            }
            while self.fill(stream).await? {
                if self.buffer.len() > max {
                    return Err(too_large());
                }
                self.grow_permit(0, permit)?;
            }
            return Ok(std::mem::take(&mut self.buffer).into());
        };
        if length > max {
            return Err(too_large());
        }
        self.read_length(stream, length, 0, permit).await
    }

    /// Reads `length` bytes; memory grows with the data received, never with the announced length.
    async fn read_length(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
        length: usize,
        before: usize,
        permit: &mut Permit,
    ) -> Result<Vec<u8>, HttpError> {
        while self.buffer.len() < length {
            self.read_more(stream).await?;
            self.grow_permit(before, permit)?;
        }
        if self.buffer.len() == length {
            // No copy, and no big buffer left on an idle connection.
            return Ok(std::mem::take(&mut self.buffer).into());
        }
        let body = self.buffer[..length].to_vec();
        self.buffer.advance(length);
        Ok(body)
    }

    async fn read_chunks(
        &mut self,
        stream: &mut (impl AsyncRead + Unpin),
        max: usize,
        permit: &mut Permit,
    ) -> Result<Vec<u8>, HttpError> {
        let mut body = Vec::new();
        loop {
            let line = self.read_line(stream, &mut MAX_HEAD.clone()).await?;
            let digits = line.split(';').next().unwrap_or_default().trim();
            let length = usize::from_str_radix(digits, 16)
                .map_err(|_| bad(400, format!("chunk length {digits:?} is not a number")))?;
            if length == 0 {
                break;
            }
            if length > max || body.len() + length > max {
                return Err(bad(413, format!("the body is over {max} bytes")));
            }
            body.extend(self.read_length(stream, length, body.len(), permit).await?);
            self.read_line(stream, &mut 2).await?;
        }
        let mut budget = MAX_HEAD;
        while !self.read_line(stream, &mut budget).await?.is_empty() {}
        Ok(body)
    }
}
