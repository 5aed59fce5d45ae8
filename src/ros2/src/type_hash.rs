//! Type hashes in the user data of endpoints (`PID_USER_DATA`): `typehash=RIHS01_…;` of the messages (REP 2016), and
//! since Lyrical `sertypehash=…;` of the service. Distributions before Iron announce none.

use bytes::Bytes;
use ros_bus::Digest;

/// Prefix of hashes of this version, followed by 64 hexadecimal digits.
const VERSION: &str = "RIHS01_";
const DIGITS: usize = 64;

/// Returns the user data of an endpoint with this digest; empty if the digest is not known.
pub(super) fn user_data(digest: &Digest) -> Bytes {
    if is_hash(digest.as_str()) { format!("typehash={digest};").into() } else { Bytes::new() }
}

/// Returns the digest of an endpoint's messages; `*` if it is missing or of an unknown version.
pub(super) fn message_hash(user_data: &[u8]) -> Digest {
    hash_value(user_data, "typehash")
}

/// Returns the digest of the service that an endpoint belongs to.
pub(super) fn service_hash(user_data: &[u8]) -> Digest {
    hash_value(user_data, "sertypehash")
}

/// Returns the hash for a key in `key=value;` pairs.
fn hash_value(user_data: &[u8], key: &str) -> Digest {
    let text = std::str::from_utf8(user_data).unwrap_or_default();
    let pairs = text.split(';').filter_map(|pair| pair.split_once('='));
    let mut values = pairs.filter(|(name, _)| *name == key);
    let hash = values.next().map(|(_, hash)| hash).filter(|hash| is_hash(hash));
    hash.map_or_else(Digest::any, Digest::from)
}

fn is_hash(text: &str) -> bool {
    text.strip_prefix(VERSION)
        .is_some_and(|digits| digits.len() == DIGITS && digits.bytes().all(|digit| digit.is_ascii_hexdigit()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_comes_back_from_what_an_end_tells() {
        let hash = Digest::from(format!("RIHS01_{}", "0a".repeat(32)));
        let told = user_data(&hash);
        assert_eq!(&told[..], format!("typehash={hash};").as_bytes());
        assert_eq!(message_hash(&told), hash);
        assert!(service_hash(&told).is_any());
        let both = format!("enclave=/;sertypehash={hash};");
        assert_eq!(service_hash(both.as_bytes()), hash);
        assert!(message_hash(both.as_bytes()).is_any());
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
            assert!(message_hash(told).is_any(), "{told:?}");
        }
        assert!(user_data(&Digest::any()).is_empty());
        assert!(user_data(&Digest::from("d41d8cd98f00b204e9800998ecf8427e")).is_empty());
    }
}
