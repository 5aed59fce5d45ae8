//! QoS of topics between the interface and the bus.

use std::time::Duration;

pub use api::interface::{Durability, Liveliness, Qos, Reliability};
use ros::bus;

/// Converts to the QoS of an endpoint of ours with this history depth.
pub fn to_bus(qos: &Qos, depth: usize) -> bus::QosProfile {
    let time = |seconds: Option<f64>| Duration::try_from_secs_f64(seconds?).ok();
    bus::QosProfile {
        reliability: match qos.reliability {
            Reliability::Reliable => bus::QosReliability::Reliable,
            Reliability::BestEffort => bus::QosReliability::BestEffort,
        },
        durability: match qos.durability {
            Durability::Volatile => bus::QosDurability::Volatile,
            Durability::TransientLocal => bus::QosDurability::TransientLocal,
        },
        depth,
        deadline: time(qos.deadline),
        lifespan: time(qos.lifespan),
        liveliness: match qos.liveliness {
            Liveliness::Automatic => bus::QosLiveliness::Automatic,
            Liveliness::ManualByTopic => bus::QosLiveliness::ManualByTopic,
        },
        lease: time(qos.lease),
    }
}

/// Converts from the QoS of an endpoint.
pub fn from_bus(profile: &bus::QosProfile) -> Qos {
    let seconds = |time: Option<Duration>| time.map(|time| time.as_secs_f64());
    Qos {
        reliability: match profile.reliability {
            bus::QosReliability::Reliable => Reliability::Reliable,
            bus::QosReliability::BestEffort => Reliability::BestEffort,
        },
        durability: match profile.durability {
            bus::QosDurability::Volatile => Durability::Volatile,
            bus::QosDurability::TransientLocal => Durability::TransientLocal,
        },
        deadline: seconds(profile.deadline),
        lifespan: seconds(profile.lifespan),
        liveliness: match profile.liveliness {
            bus::QosLiveliness::Automatic => Liveliness::Automatic,
            bus::QosLiveliness::ManualByTopic => Liveliness::ManualByTopic,
        },
        lease: seconds(profile.lease),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_on_a_bus_what_it_was_there() {
        let qos = Qos {
            reliability: Reliability::BestEffort,
            liveliness: Liveliness::ManualByTopic,
            deadline: Some(0.5),
            lifespan: Some(3.0),
            lease: Some(1.25),
            ..Qos::default()
        };
        assert_eq!(from_bus(&to_bus(&qos, 7)), qos);
        let impossible = Qos { deadline: Some(f64::INFINITY), ..qos };
        assert_eq!(to_bus(&impossible, 7).deadline, None);
    }
}
