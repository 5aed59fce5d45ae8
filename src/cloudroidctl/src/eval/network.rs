//! A network that is added to the measured times, when the command is run on the server itself.

use std::fmt;
use std::str::FromStr;

use anyhow::{bail, ensure};
use serde::Serialize;

/// Delay and bandwidth of a network.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct AddedNetwork {
    /// Delay each way, in milliseconds.
    pub each_way: f64,
    /// Bandwidth each way in Mbit/s; unlimited if `None`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mbits: Option<f64>,
}

impl AddedNetwork {
    /// Returns whether the network adds any time.
    pub fn has_effect(&self) -> bool {
        self.each_way > 0.0 || self.mbits.is_some()
    }

    /// Returns the time for a message of this size one way, in milliseconds: the delay and the transmission of its
    /// bits.
    pub fn one_way_millis(&self, bytes: usize) -> f64 {
        let bits = bytes as f64 * 8.0;
        self.each_way + self.mbits.map_or(0.0, |mbits| bits / (mbits * 1000.0))
    }
}

impl FromStr for AddedNetwork {
    type Err = anyhow::Error;

    /// Parses `lan`, `wan` (the networks of docs/evaluation.md) or a number of milliseconds for both ways together.
    fn from_str(text: &str) -> anyhow::Result<AddedNetwork> {
        let of = |each_way, mbits| AddedNetwork { each_way, mbits: Some(mbits) };
        match text {
            "lan" => return Ok(of(1.0, 100.0)),
            "wan" => return Ok(of(30.0, 20.0)),
            _ => {}
        }
        let Ok(both) = text.parse::<f64>() else {
            bail!("expected lan, wan, or milliseconds per request");
        };
        ensure!((0.0..=3_600_000.0).contains(&both), "expected 0 to 3600000 milliseconds");
        Ok(AddedNetwork { each_way: both / 2.0, mbits: None })
    }
}

impl fmt::Display for AddedNetwork {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.mbits {
            Some(mbits) => write!(out, "{} ms each way, {mbits} Mbit/s", self.each_way),
            None => write!(out, "{} ms per request", self.each_way * 2.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_and_bits_are_added() {
        let read = |text: &str| text.parse::<AddedNetwork>();
        let lan = read("lan").expect("known");
        // 1 ms, and 1 Mbit at 100 Mbit/s.
        assert!((lan.one_way_millis(125_000) - 11.0).abs() < 1e-9);
        let wan = read("wan").expect("known");
        assert!((wan.one_way_millis(125_000) - 80.0).abs() < 1e-9);
        let given = read("25").expect("a number");
        assert_eq!(given.one_way_millis(1 << 30) * 2.0, 25.0);
        assert_eq!(given.to_string(), "25 ms per request");
        assert!(given.has_effect() && lan.has_effect() && !read("0").expect("a number").has_effect());
        for wrong in ["wifi", "-1", "nan", ""] {
            read(wrong).expect_err(wrong);
        }
    }
}
