//! The hash of a type in what an end tells of itself (`PID_USER_DATA`): `typehash=RIHS01_…;` of its messages (REP 2016), and
//! from Lyrical on `sertypehash=…;` of its service. Distributions before Iron tell none.

use bytes::Bytes;

use crate::bus::Digest;

/// What hashes of this version begin with; 64 hexadecimal digits follow.
const VERSION: &str = "RIHS01_";
const DIGITS: usize = 64;

/// What an end of a type with this digest tells; nothing where it is not known.
pub(super) fn user_data(digest: &Digest) -> Bytes {
    match is_hash(digest.as_str()) {
        true => format!("typehash={digest};").into(),
        false => Bytes::new(),
    }
}

/// The digest of the messages of an end that tells this; `*` where it does not say, or in a version unknown here.
pub(super) fn of_message(user_data: &[u8]) -> Digest {
    value(user_data, "typehash")
}

/// The digest of the service that an end belongs to.
pub(super) fn of_service(user_data: &[u8]) -> Digest {
    value(user_data, "sertypehash")
}

/// `key=value;` one after the other.
fn value(user_data: &[u8], key: &str) -> Digest {
    let text = std::str::from_utf8(user_data).unwrap_or_default();
    let pairs = text.split(';').filter_map(|pair| pair.split_once('='));
    let mut values = pairs.filter(|(name, _)| *name == key);
    let hash = values
        .next()
        .map(|(_, hash)| hash)
        .filter(|hash| is_hash(hash));
    hash.map_or_else(Digest::any, Digest::from)
}

fn is_hash(text: &str) -> bool {
    text.strip_prefix(VERSION).is_some_and(|digits| {
        digits.len() == DIGITS && digits.bytes().all(|digit| digit.is_ascii_hexdigit())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_comes_back_from_what_an_end_tells() {
        let hash = Digest::from(format!("RIHS01_{}", "0a".repeat(32)));
        let told = user_data(&hash);
        assert_eq!(&told[..], format!("typehash={hash};").as_bytes());
        assert_eq!(of_message(&told), hash);
        assert!(of_service(&told).is_any());
        let both = format!("enclave=/;sertypehash={hash};");
        assert_eq!(of_service(both.as_bytes()), hash);
        assert!(of_message(both.as_bytes()).is_any());
    }

    #[test]
    fn what_is_no_hash_agrees_with_all() {
        for told in [
            &b""[..],
            b"typehash=;",
            b"typehash=RIHS01_00;",
            b"typehash=RIHS02_0000000000000000000000000000000000000000000000000000000000000000;",
            b"\xff\xfe",
        ] {
            assert!(of_message(told).is_any(), "{told:?}");
        }
        assert!(user_data(&Digest::any()).is_empty());
        assert!(user_data(&Digest::from("d41d8cd98f00b204e9800998ecf8427e")).is_empty());
    }
}
