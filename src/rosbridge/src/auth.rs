//! `auth`: the credentials of rosauth.

use std::borrow::Cow;

use crate::fields::Fields;
use crate::message::Message;
use crate::{Id, Problem, Writer};

/// Credentials: a MAC over the other fields, with a secret shared with a third party.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Auth<'a> {
    /// Id of the interaction.
    pub id: Option<Id<'a>>,
    /// SHA-512 of the secret and the other fields, in hex.
    pub mac: Cow<'a, str>,
    /// Address of the client.
    pub client: Cow<'a, str>,
    /// Address of the server.
    pub dest: Cow<'a, str>,
    /// A random string.
    pub rand: Cow<'a, str>,
    /// Time of the request, in seconds since 1970.
    pub t: i64,
    /// Level of the client.
    pub level: Cow<'a, str>,
    /// Expiry, in seconds since 1970.
    pub end: i64,
}

impl<'a> Message<'a> for Auth<'a> {
    const OP: &'static str = "auth";
    const FIELDS: &'static [&'static str] = &["mac", "client", "dest", "rand", "t", "level", "end"];

    fn read(id: Option<Id<'a>>, fields: &Fields<'a>) -> Result<Self, Problem> {
        let seconds = |field| fields.integer(field)?.ok_or(Problem::Missing { field, expected: "seconds since 1970" });
        Ok(Self {
            id,
            mac: fields.required_text("mac", "a hash in hex")?,
            client: fields.required_text("client", "the client's address")?,
            dest: fields.required_text("dest", "the server's address")?,
            rand: fields.required_text("rand", "a random text")?,
            t: seconds("t")?,
            level: fields.required_text("level", "a text")?,
            end: seconds("end")?,
        })
    }

    fn id(&self) -> Option<&Id<'a>> {
        self.id.as_ref()
    }

    fn write(&self, writer: &mut Writer<'_>) {
        writer.text("mac", &self.mac);
        writer.text("client", &self.client);
        writer.text("dest", &self.dest);
        writer.text("rand", &self.rand);
        writer.integer("t", self.t);
        writer.text("level", &self.level);
        writer.integer("end", self.end);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::op::tests::{assert_parses, assert_refused, assert_survives_cbor};

    #[test]
    fn auth_is_read_and_checked() {
        let op = Auth {
            id: None,
            mac: "abcd".into(),
            client: "10.0.0.2".into(),
            dest: "10.0.0.1".into(),
            rand: "xyz".into(),
            t: 1_500_000_000,
            level: "user".into(),
            end: 1_500_000_060,
        };
        assert_parses(
            r#"{"op":"auth","mac":"abcd","client":"10.0.0.2","dest":"10.0.0.1","rand":"xyz","t":1500000000,"level":"user","end":1500000060}"#,
            op.clone(),
        );
        assert_survives_cbor(op);
        assert_refused(r#"{"op":"auth"}"#, "auth: field \"mac\" is missing, a hash in hex is expected");
        assert_refused(
            r#"{"op":"auth","mac":"a","client":"b","dest":"c","rand":"d","t":"now"}"#,
            "auth: field \"t\" is \"now\", an integer is expected",
        );
    }
}
