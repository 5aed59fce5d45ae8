//! A network that is added to what was measured, where the command is typed at the server itself.

use std::fmt;
use std::str::FromStr;

use serde::Serialize;

/// What it adds to a request and its answer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Network {
    /// Delay each way, in milliseconds.
    pub each_way: f64,
    /// Mbit/s each way; none: as many as one likes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mbits: Option<f64>,
}

impl Network {
    /// Whether it adds anything.
    pub fn adds(&self) -> bool {
        self.each_way > 0.0 || self.mbits.is_some()
    }

    /// For a message of so many bytes one way, in milliseconds: the delay, and the time that its bits take.
    pub fn one_way(&self, bytes: usize) -> f64 {
        let bits = bytes as f64 * 8.0;
        self.each_way + self.mbits.map_or(0.0, |mbits| bits / (mbits * 1000.0))
    }
}

impl FromStr for Network {
    type Err = String;

    /// `lan` and `wan` are those of the evaluation (docs/evaluation.md); a number is for both ways together.
    fn from_str(text: &str) -> Result<Network, String> {
        let of = |each_way, mbits| Network {
            each_way,
            mbits: Some(mbits),
        };
        match text {
            "lan" => return Ok(of(1.0, 100.0)),
            "wan" => return Ok(of(30.0, 20.0)),
            _ => {}
        }
        let both: f64 = text
            .parse()
            .map_err(|_| "it is lan, wan, or milliseconds for each request".to_owned())?;
        if !(0.0..=3_600_000.0).contains(&both) {
            return Err("milliseconds are between 0 and 3600000".to_owned());
        }
        Ok(Network {
            each_way: both / 2.0,
            mbits: None,
        })
    }
}

impl fmt::Display for Network {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.mbits {
            Some(mbits) => write!(out, "{} ms each way, {mbits} Mbit/s", self.each_way),
            None => write!(out, "{} ms for each request", self.each_way * 2.0),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delay_and_bits_are_added() {
        let read = |text: &str| text.parse::<Network>();
        let lan = read("lan").expect("known");
        // 1 ms, and 1 Mbit by 100 Mbit/s.
        assert!((lan.one_way(125_000) - 11.0).abs() < 1e-9);
        let wan = read("wan").expect("known");
        assert!((wan.one_way(125_000) - 80.0).abs() < 1e-9);
        let given = read("25").expect("a number");
        assert_eq!(given.one_way(1 << 30) * 2.0, 25.0);
        assert_eq!(given.to_string(), "25 ms for each request");
        assert!(given.adds() && lan.adds() && !read("0").expect("a number").adds());
        for wrong in ["wifi", "-1", "nan", ""] {
            read(wrong).expect_err(wrong);
        }
    }
}
