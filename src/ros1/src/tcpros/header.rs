//! The connection header that each side sends first: length-prefixed fields of the form `name=value`.

use std::collections::BTreeMap;

use bytes::{Buf as _, BufMut as _, BytesMut};
use tokio::io::{AsyncRead, AsyncReadExt as _, AsyncWrite, AsyncWriteExt as _};

use super::Error;

/// Maximum size of a header in bytes. Full message definitions are sent in it.
pub const MAX_HEADER: usize = 4 << 20;
/// Maximum number of fields in a header; real ones have ten.
const MAX_FIELDS: usize = 100;

/// A connection header.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Header {
    fields: BTreeMap<String, String>,
}

impl Header {
    /// Creates a header with these fields.
    pub fn new<const N: usize>(fields: [(&str, &str); N]) -> Self {
        let owned = |(name, value): (&str, &str)| (name.to_owned(), value.to_owned());
        Self { fields: fields.into_iter().map(owned).collect() }
    }

    /// Creates a header that refuses the connection.
    pub fn error(reason: &str) -> Self {
        Self::new([("error", reason)])
    }

    /// Returns a field.
    pub fn get(&self, name: &str) -> Option<&str> {
        self.fields.get(name).map(String::as_str)
    }

    /// Returns a field, or the empty string.
    pub fn text(&self, name: &str) -> &str {
        self.get(name).unwrap_or_default()
    }

    /// Returns true if a field is present and affirmative.
    pub fn flag(&self, name: &str) -> bool {
        matches!(self.get(name), Some("1" | "true" | "True"))
    }

    /// Returns the header with one more field.
    pub fn with_field(mut self, name: &str, value: &str) -> Self {
        self.fields.insert(name.to_owned(), value.to_owned());
        self
    }

    /// Encodes the header, with its total length in front.
    pub fn encode(&self) -> Vec<u8> {
        let size = |(name, value): (&String, &String)| 4 + name.len() + 1 + value.len();
        let total: usize = self.fields.iter().map(size).sum();
        let mut out = Vec::with_capacity(4 + total);
        out.put_u32_le(total as u32);
        for (name, value) in &self.fields {
            out.put_u32_le((name.len() + 1 + value.len()) as u32);
            out.put_slice(name.as_bytes());
            out.put_u8(b'=');
            out.put_slice(value.as_bytes());
        }
        out
    }

    /// Decodes the fields of a header, without the total length.
    pub fn decode(mut bytes: &[u8]) -> Result<Self, Error> {
        let bad = |reason: &str| Error::Header(reason.to_owned());
        let mut fields = BTreeMap::new();
        while !bytes.is_empty() {
            if fields.len() == MAX_FIELDS {
                return Err(Error::Header(format!("more than {MAX_FIELDS} fields")));
            }
            if bytes.len() < 4 {
                return Err(bad("it ends inside the length of a field"));
            }
            let length = bytes.get_u32_le() as usize;
            if length > bytes.len() {
                return Err(bad("a field is longer than the header"));
            }
            let (field, rest) = bytes.split_at(length);
            bytes = rest;
            let equals = memchr::memchr(b'=', field).ok_or_else(|| bad("a field has no equals sign"))?;
            let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
            fields.insert(text(&field[..equals]), text(&field[equals + 1..]));
        }
        Ok(Self { fields })
    }

    /// Reads a header; what was read beyond it stays in `buffer`.
    pub async fn read(stream: &mut (impl AsyncRead + Unpin), buffer: &mut BytesMut) -> Result<Self, Error> {
        fill_to(stream, buffer, 4).await?;
        let length = buffer.get_u32_le() as usize;
        if length > MAX_HEADER {
            return Err(Error::Header(format!("{length} bytes announced; the limit is {MAX_HEADER}")));
        }
        fill_to(stream, buffer, length).await?;
        Self::decode(&buffer.split_to(length))
    }

    /// Sends the header.
    pub async fn write(&self, stream: &mut (impl AsyncWrite + Unpin)) -> Result<(), Error> {
        Ok(stream.write_all(&self.encode()).await?)
    }

    /// Sends this header and reads the answer; an `error` field in it is a refusal.
    pub async fn exchange(
        &self,
        stream: &mut (impl AsyncRead + AsyncWrite + Unpin),
        buffer: &mut BytesMut,
    ) -> Result<Self, Error> {
        self.write(stream).await?;
        let answer = Self::read(stream, buffer).await?;
        match answer.get("error") {
            Some(reason) => Err(Error::Refused(reason.to_owned())),
            None => Ok(answer),
        }
    }
}

/// Reads until `buffer` holds `length` bytes; memory grows with the data received, not with the announced length.
pub(super) async fn fill_to(
    stream: &mut (impl AsyncRead + Unpin),
    buffer: &mut BytesMut,
    length: usize,
) -> Result<(), Error> {
    while buffer.len() < length {
        buffer.reserve(1 << 10);
        if stream.read_buf(buffer).await? == 0 {
            return Err(Error::Io(std::io::ErrorKind::UnexpectedEof.into()));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    async fn read(bytes: &[u8]) -> Result<Header, Error> {
        let mut stream = bytes;
        Header::read(&mut stream, &mut BytesMut::new()).await
    }

    #[tokio::test]
    async fn what_is_sent_is_read() {
        let header = Header::new([("topic", "/a"), ("md5sum", "*"), ("odd", "x=y=z")]);
        let mut bytes = header.encode();
        bytes.extend_from_slice(b"rest");
        let mut stream = bytes.as_slice();
        let mut buffer = BytesMut::new();
        assert_eq!(Header::read(&mut stream, &mut buffer).await.unwrap(), header);
        assert_eq!(&buffer[..], b"rest");
    }

    #[tokio::test]
    async fn bad_headers_are_named() {
        let huge = read(&u32::MAX.to_le_bytes()).await.unwrap_err();
        assert!(huge.to_string().contains("limit"), "{huge}");
        let cut = read(&[8, 0, 0, 0, 1]).await.unwrap_err();
        assert!(matches!(cut, Error::Io(_)), "{cut}");
        let long_field = read(&[5, 0, 0, 0, 200, 0, 0, 0, b'a']).await.unwrap_err();
        assert!(long_field.to_string().contains("longer"), "{long_field}");
        let short = read(&[2, 0, 0, 0, 1, 0]).await.unwrap_err();
        assert!(short.to_string().contains("length of a field"), "{short}");
        let no_equals = read(&[5, 0, 0, 0, 1, 0, 0, 0, b'a']).await.unwrap_err();
        assert!(no_equals.to_string().contains("equals"), "{no_equals}");
        let mut many = BytesMut::new();
        for n in 0..200u32 {
            let field = format!("f{n}=");
            many.put_u32_le(field.len() as u32);
            many.put_slice(field.as_bytes());
        }
        let many = Header::decode(&many).unwrap_err();
        assert!(many.to_string().contains("fields"), "{many}");
    }
}
