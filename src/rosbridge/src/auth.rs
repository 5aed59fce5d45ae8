//! `auth`: the credentials of rosauth.

use std::borrow::Cow;

use crate::Id;
use crate::field_kinds::{Integer, OptionalId, Text};
use crate::message::message;

const SECONDS: Integer = Integer("seconds since 1970");

message! {
    /// Credentials: a MAC over the other fields, with a secret shared with a third party.
    Auth "auth"
    /// Id of the interaction.
    id: Option<Id<'a>> = OptionalId,
    /// SHA-512 of the secret and the other fields, in hex.
    mac: Cow<'a, str> = "mac" Text("a hash in hex"),
    /// Address of the client.
    client: Cow<'a, str> = "client" Text("the client's address"),
    /// Address of the server.
    dest: Cow<'a, str> = "dest" Text("the server's address"),
    /// A random string.
    rand: Cow<'a, str> = "rand" Text("a random text"),
    /// Time of the request, in seconds since 1970.
    t: i64 = "t" SECONDS,
    /// Level of the client.
    level: Cow<'a, str> = "level" Text("a text"),
    /// Expiry, in seconds since 1970.
    end: i64 = "end" SECONDS,
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
