//! Types and qualities of service between a bus and what links tell of them.

use std::time::Duration;

use ros::bus::{self, Digest, Durability, Liveliness, Reliability, RosVersion, ServiceType};

use crate::control::{Qos, Served};

impl Qos {
    /// What is told of this one.
    pub fn of(qos: &bus::Qos) -> Self {
        let seconds = |time: Option<Duration>| time.map(|time| time.as_secs_f64());
        Self {
            best_effort: qos.reliability == Reliability::BestEffort,
            transient_local: qos.is_latching(),
            depth: qos.depth,
            deadline: seconds(qos.deadline),
            lifespan: seconds(qos.lifespan),
            manual_liveliness: qos.liveliness == Liveliness::ManualByTopic,
            lease: seconds(qos.lease),
        }
    }

    /// What it tells of, with a queue of at least `depth` messages. Times that no clock has are left out.
    pub fn to_qos(&self, depth: usize) -> bus::Qos {
        let time = |seconds: Option<f64>| Duration::try_from_secs_f64(seconds?).ok();
        bus::Qos {
            reliability: match self.best_effort {
                true => Reliability::BestEffort,
                false => Reliability::Reliable,
            },
            durability: match self.transient_local {
                true => Durability::TransientLocal,
                false => Durability::Volatile,
            },
            depth: self.depth.max(depth),
            deadline: time(self.deadline),
            lifespan: time(self.lifespan),
            liveliness: match self.manual_liveliness {
                true => Liveliness::ManualByTopic,
                false => Liveliness::Automatic,
            },
            lease: time(self.lease),
        }
    }
}

impl Served {
    /// A service of this type under this name.
    pub fn of(channel: u32, name: &str, of: &ServiceType) -> Self {
        let told = |digest: &Digest| !digest.is_any();
        let halves = match told(&of.request) || told(&of.response) {
            true => vec![of.request.to_string(), of.response.to_string()],
            false => Vec::new(),
        };
        Self {
            channel,
            name: name.to_owned(),
            type_name: of.name.clone(),
            md5: of.digest.to_string(),
            halves,
        }
    }

    /// The type, as a robot or servant of this ROS has it.
    pub fn service_type(&self, version: RosVersion) -> ServiceType {
        let half = |at: usize| self.halves.get(at).map_or_else(Digest::any, Digest::from);
        ServiceType {
            request: half(0),
            response: half(1),
            ..ServiceType::new(self.type_name.clone(), self.md5.clone())
        }
        .written_by(version)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_told_of_a_quality_of_service_comes_back() {
        let qos = bus::Qos {
            reliability: Reliability::BestEffort,
            deadline: Some(Duration::from_millis(100)),
            lease: Some(Duration::from_secs(2)),
            liveliness: Liveliness::ManualByTopic,
            ..bus::Qos::keep_last(5).latching(true)
        };
        let told = serde_json::to_string(&Qos::of(&qos)).unwrap();
        let read: Qos = serde_json::from_str(&told).unwrap();
        assert_eq!(read.to_qos(1), qos);
        assert_eq!(read.to_qos(256).depth, 256);
        let nonsense = Qos {
            lease: Some(-1.0),
            deadline: Some(f64::NAN),
            ..Qos::default()
        };
        assert_eq!(nonsense.to_qos(1), bus::Qos::keep_last(1));
    }

    #[test]
    fn a_service_keeps_the_hashes_of_both_its_messages() {
        let of = ServiceType {
            request: "RIHS01_1".into(),
            ..ServiceType::new("a/srv/B", "*")
        }
        .written_by(RosVersion::Two);
        let served = Served::of(3, "/b", &of);
        assert_eq!(served.service_type(RosVersion::Two), of);
        let of = ServiceType::new("a/B", "d41d8cd98f00b204e9800998ecf8427e");
        let served = Served::of(3, "/b", &of);
        assert!(served.halves.is_empty());
        assert_eq!(served.service_type(RosVersion::One), of);
    }
}
