//! Conversions between the types and QoS profiles of a bus and their representation on the link.

use std::time::Duration;

use ros::bus::{self, Digest, QosDurability, QosLiveliness, QosReliability, RosVersion, ServiceType};

use crate::control::{ServiceChannel, WireQos};

impl WireQos {
    /// Converts a QoS profile of a bus.
    pub fn from_bus(qos: &bus::QosProfile) -> Self {
        let seconds = |time: Option<Duration>| time.map(|time| time.as_secs_f64());
        Self {
            best_effort: qos.reliability == QosReliability::BestEffort,
            transient_local: qos.is_latching(),
            depth: qos.depth,
            deadline: seconds(qos.deadline),
            lifespan: seconds(qos.lifespan),
            manual_liveliness: qos.liveliness == QosLiveliness::ManualByTopic,
            lease: seconds(qos.lease),
        }
    }

    /// Converts to a QoS profile of a bus with a history depth of at least `depth`. Times that cannot be represented
    /// are omitted.
    pub fn to_bus(&self, depth: usize) -> bus::QosProfile {
        let time = |seconds: Option<f64>| Duration::try_from_secs_f64(seconds?).ok();
        bus::QosProfile {
            reliability: if self.best_effort { QosReliability::BestEffort } else { QosReliability::Reliable },
            durability: if self.transient_local { QosDurability::TransientLocal } else { QosDurability::Volatile },
            depth: self.depth.max(depth),
            deadline: time(self.deadline),
            lifespan: time(self.lifespan),
            liveliness: if self.manual_liveliness { QosLiveliness::ManualByTopic } else { QosLiveliness::Automatic },
            lease: time(self.lease),
        }
    }
}

impl ServiceChannel {
    /// Creates the description of a service with this name and type.
    pub fn new(channel: u32, name: &str, of: &ServiceType) -> Self {
        let told = |digest: &Digest| !digest.is_any();
        let halves = if told(&of.request) || told(&of.response) {
            vec![of.request.to_string(), of.response.to_string()]
        } else {
            Vec::new()
        };
        Self { channel, name: name.to_owned(), type_name: of.name.clone(), md5: of.digest.to_string(), halves }
    }

    /// Returns the service type for the given ROS version.
    pub fn service_type(&self, version: RosVersion) -> ServiceType {
        let half = |at: usize| self.halves.get(at).map_or_else(Digest::any, Digest::from);
        ServiceType {
            request: half(0),
            response: half(1),
            ..ServiceType::new(self.type_name.clone(), self.md5.clone())
        }
        .with_version(version)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_qos_profile_round_trips() {
        let qos = bus::QosProfile {
            reliability: QosReliability::BestEffort,
            deadline: Some(Duration::from_millis(100)),
            lease: Some(Duration::from_secs(2)),
            liveliness: QosLiveliness::ManualByTopic,
            ..bus::QosProfile::keep_last(5).latching(true)
        };
        let told = serde_json::to_string(&WireQos::from_bus(&qos)).unwrap();
        let read: WireQos = serde_json::from_str(&told).unwrap();
        assert_eq!(read.to_bus(1), qos);
        assert_eq!(read.to_bus(256).depth, 256);
        let nonsense = WireQos { lease: Some(-1.0), deadline: Some(f64::NAN), ..WireQos::default() };
        assert_eq!(nonsense.to_bus(1), bus::QosProfile::keep_last(1));
    }

    #[test]
    fn a_service_keeps_the_hashes_of_both_its_messages() {
        let of = ServiceType { request: "RIHS01_1".into(), ..ServiceType::new("a/srv/B", "*") }
            .with_version(RosVersion::Two);
        let served = ServiceChannel::new(3, "/b", &of);
        assert_eq!(served.service_type(RosVersion::Two), of);
        let of = ServiceType::new("a/B", "d41d8cd98f00b204e9800998ecf8427e");
        let served = ServiceChannel::new(3, "/b", &of);
        assert!(served.halves.is_empty());
        assert_eq!(served.service_type(RosVersion::One), of);
    }
}
