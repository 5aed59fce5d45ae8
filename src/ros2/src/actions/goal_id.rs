//! Goal ids: UUIDs, displayed as text.

use std::fmt;
use std::hash::{BuildHasher as _, RandomState};

/// A UUID.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub(super) struct GoalId(pub(super) [u8; 16]);

impl GoalId {
    /// No goal: in a cancel request it stands for all.
    pub(super) const NONE: Self = Self([0; 16]);

    /// Creates a random id (RFC 9562, version 4).
    pub(super) fn random() -> Self {
        let mut bytes = [0; 16];
        for half in bytes.chunks_exact_mut(8) {
            // The keys come from the operating system's random numbers, and no two are alike.
            half.copy_from_slice(&RandomState::new().hash_one(()).to_ne_bytes());
        }
        bytes[6] = bytes[6] & 0x0f | 0x40;
        bytes[8] = bytes[8] & 0x3f | 0x80;
        Self(bytes)
    }

    /// Parses a UUID with or without hyphens.
    pub(super) fn parse(text: &str) -> Option<Self> {
        let mut digits = [0; 32];
        let mut written = text.bytes().filter(|byte| *byte != b'-');
        for digit in &mut digits {
            *digit = written.next()?;
        }
        let mut bytes = [0; 16];
        hex::decode_to_slice(digits, &mut bytes).ok()?;
        let whole = written.next().is_none() && matches!(text.len(), 32 | 36);
        Some(Self(bytes)).filter(|id| whole && *id != Self::NONE)
    }
}

/// Displays groups of 8, 4, 4, 4 and 12 lower-case hex digits.
impl fmt::Display for GoalId {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = hex::encode(self.0);
        let groups = [0..8, 8..12, 12..16, 16..20, 20..32].map(|group| &digits[group]);
        formatter.write_str(&groups.join("-"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_uuid_is_read_as_it_is_shown() {
        let shown = "00112233-4455-6677-8899-aabbccddeeff";
        let id = GoalId::parse(shown).unwrap();
        assert_eq!(id.0[..6], [0, 0x11, 0x22, 0x33, 0x44, 0x55]);
        assert_eq!(id.to_string(), shown);
        assert_eq!(GoalId::parse("00112233445566778899AABBCCDDEEFF"), Some(id));
        for other in [
            "",
            "/node-1-12.000000001",
            "00112233-4455-6677-8899-aabbccddeef",
            "00112233-4455-6677-8899-aabbccddeefg",
            "00112233-4455-6677-8899-aabbccddeeff0",
            "00112233445566778899aabbccddeef-----",
            "0-0112233445566778899aabbccddeeff",
            "00000000-0000-0000-0000-000000000000",
        ] {
            assert_eq!(GoalId::parse(other), None, "{other}");
        }
    }

    #[test]
    fn random_ones_differ() {
        let (one, two) = (GoalId::random(), GoalId::random());
        assert_ne!(one, two);
        assert_eq!(one.0[6] >> 4, 4);
        assert_eq!(one.0[8] >> 6, 2);
        assert_eq!(GoalId::parse(&one.to_string()), Some(one));
    }
}
