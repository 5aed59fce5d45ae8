//! Human-readable sizes: `512M`, `1.5G`, `65536`. Units are powers of 1024.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize};

/// Number of bytes: a number in JSON, or a string such as `512M` in the configuration.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(transparent)]
pub struct Size(pub u64);

/// Error of parsing a [`Size`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NotASize(String);

impl fmt::Display for NotASize {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{:?} is not a size; write bytes or a number with K, M, G or T, such as 512M", self.0)
    }
}

impl std::error::Error for NotASize {}

const UNITS: [(char, u64); 4] = [('T', 1 << 40), ('G', 1 << 30), ('M', 1 << 20), ('K', 1 << 10)];

impl FromStr for Size {
    type Err = NotASize;

    fn from_str(text: &str) -> Result<Self, NotASize> {
        let refused = || NotASize(text.to_owned());
        let upper = text.trim().to_ascii_uppercase();
        let bare = upper.trim_end_matches('B').trim_end_matches('I').trim_end();
        let (digits, unit) = match UNITS.iter().find(|(letter, _)| bare.ends_with(*letter)) {
            Some((letter, unit)) => (bare.trim_end_matches(*letter).trim_end(), *unit),
            None => (bare, 1),
        };
        if let Ok(whole) = digits.parse::<u64>() {
            return whole.checked_mul(unit).map(Size).ok_or_else(refused);
        }
        let fraction: f64 = digits.parse().map_err(|_| refused())?;
        let bytes = fraction * unit as f64;
        if bytes.is_finite() && (0.0..u64::MAX as f64).contains(&bytes) {
            Ok(Size(bytes as u64))
        } else {
            Err(refused())
        }
    }
}

impl fmt::Display for Size {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match UNITS.iter().find(|(_, unit)| self.0 >= *unit) {
            Some((letter, unit)) if self.0 % unit == 0 => write!(out, "{}{letter}", self.0 / unit),
            Some((letter, unit)) => write!(out, "{:.1}{letter}", self.0 as f64 / *unit as f64),
            None => write!(out, "{}", self.0),
        }
    }
}

impl<'de> Deserialize<'de> for Size {
    fn deserialize<D: Deserializer<'de>>(source: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(untagged)]
        enum Written {
            Number(u64),
            Text(String),
        }
        match Written::deserialize(source)? {
            Written::Number(bytes) => Ok(Size(bytes)),
            Written::Text(text) => text.parse().map_err(serde::de::Error::custom),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_as_people_write_them() {
        for (text, bytes) in [
            ("0", 0),
            ("65536", 65_536),
            ("512M", 512 << 20),
            ("512m", 512 << 20),
            ("512MiB", 512 << 20),
            ("1.5G", 3 << 29),
            (" 2 K ", 2048),
            ("1TB", 1 << 40),
        ] {
            assert_eq!(text.parse::<Size>(), Ok(Size(bytes)), "{text}");
        }
    }

    #[test]
    fn what_is_no_size_is_named() {
        for text in ["", "M", "-1", "many", "1e400G", "99999999999T", "nan"] {
            let refused = text.parse::<Size>().expect_err(text);
            assert!(refused.to_string().contains(&format!("{text:?}")), "{refused}");
        }
    }

    #[test]
    fn sizes_are_printed_shortly() {
        let printed: Vec<String> =
            [0, 1023, 1024, 1536, 512 << 20, 3 << 29].map(|bytes| Size(bytes).to_string()).to_vec();
        assert_eq!(printed, ["0", "1023", "1K", "1.5K", "512M", "1.5G"]);
    }
}
