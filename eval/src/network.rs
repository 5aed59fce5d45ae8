//! Networks between a robot and the server.

use serde::{Deserialize, Serialize};
use support::cable::NetworkImpairment;

/// Networks between a robot and the server.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NetworkProfile {
    /// 1 ms each way, 100 Mbit/s.
    Lan,
    /// 30 ms each way, 20 Mbit/s.
    Wan,
    /// 5 ms each way with a jitter of 4 ms, 40 Mbit/s, 1 % packet loss.
    Wifi,
    /// 100 ms each way, 2 Mbit/s, 1 % packet loss: a degraded network.
    Bad,
}

impl NetworkProfile {
    pub const ALL: [Self; 4] = [Self::Lan, Self::Wan, Self::Wifi, Self::Bad];

    pub fn name(self) -> &'static str {
        match self {
            Self::Lan => "LAN",
            Self::Wan => "WAN",
            Self::Wifi => "Wi-Fi",
            Self::Bad => "bad",
        }
    }

    pub fn rules(self) -> NetworkImpairment {
        let (rate, delay, jitter, loss) = match self {
            Self::Lan => (100_000, 1, 0, 0.0),
            Self::Wan => (20_000, 30, 0, 0.0),
            Self::Wifi => (40_000, 5, 4, 0.01),
            Self::Bad => (2000, 100, 0, 0.01),
        };
        NetworkImpairment { rate, delay, jitter, loss, limit: if self == Self::Bad { 100 } else { 1000 } }
    }

    pub fn describe(self) -> String {
        let rules = self.rules();
        let mut told = format!("{} ms each way", rules.delay);
        if rules.jitter > 0 {
            told += &format!(", more or less {} ms", rules.jitter);
        }
        told += &format!(", {} Mbit/s", f64::from(rules.rate) / 1e3);
        if rules.loss > 0.0 {
            told += &format!(", {} % of packets lost", rules.loss * 100.0);
        }
        told
    }

    /// Returns the seconds that sending `bytes` takes at its rate.
    pub fn transfer_time(self, bytes: usize) -> f64 {
        8.0 * bytes as f64 / (f64::from(self.rules().rate) * 1e3)
    }
}
