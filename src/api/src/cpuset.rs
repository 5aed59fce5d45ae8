//! CPU sets in the kernel's list format, such as `0-3,6`.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Number of CPUs that a set can represent.
const CORES: usize = 256;

/// A set of CPUs, written as `0-3,6`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema), schema(value_type = String))]
pub struct CpuSet(
    /// Bit n of word n / 64 represents CPU n.
    pub [u64; CORES / 64],
);

impl CpuSet {
    fn contains(&self, core: usize) -> bool {
        core < CORES && self.0[core / 64] >> (core % 64) & 1 == 1
    }
}

/// Error of parsing a [`CpuSet`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is not a set of cores; write numbers below {CORES} and ranges, such as 0-3,6")]
pub struct ParseCpuSetError(String);

impl FromStr for CpuSet {
    type Err = ParseCpuSetError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let refused = || ParseCpuSetError(text.to_owned());
        let mut set = CpuSet([0; CORES / 64]);
        for part in text.trim().split(',') {
            let (first, last) = part.split_once('-').unwrap_or((part, part));
            let number = |text: &str| text.trim().parse::<usize>().map_err(|_| refused());
            let (first, last) = (number(first)?, number(last)?);
            if first > last || last >= CORES {
                return Err(refused());
            }
            (first..=last).for_each(|core| set.0[core / 64] |= 1 << (core % 64));
        }
        Ok(set)
    }
}

impl fmt::Display for CpuSet {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut separator = "";
        let mut core = 0;
        while core < CORES {
            if !self.contains(core) {
                core += 1;
                continue;
            }
            let first = core;
            while self.contains(core) {
                core += 1;
            }
            match core - first {
                1 => write!(out, "{separator}{first}")?,
                _ => write!(out, "{separator}{first}-{}", core - 1)?,
            }
            separator = ",";
        }
        Ok(())
    }
}

impl Serialize for CpuSet {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for CpuSet {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        String::deserialize(from)?.parse().map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_are_read_and_written() {
        for (written, read) in [("0-3,6", "0-3,6"), ("1,0,2", "0-2"), ("255", "255"), ("63-64", "63-64")] {
            let set: CpuSet = written.parse().expect("a set");
            assert_eq!(set.to_string(), read);
        }
        for wrong in ["", "a", "3-1", "256", "1,", "-1"] {
            let refused = wrong.parse::<CpuSet>().expect_err(wrong);
            assert!(refused.to_string().contains("0-3,6"), "{refused}");
        }
    }
}
