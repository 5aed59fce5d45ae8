//! What of the file is whose: the options of each crate.

use api::{Caps, Size};
use bridge::BridgeOptions;
use choreographer::MemoryOptions;

use super::{Class, Config, Controller, Hung, NonFinite, Push};
use crate::machine;

/// Without a configured limit the daemon uses at most this part (a quarter) of the machine's memory, and at most
/// `MOST` bytes.
const PART: u64 = 4;
const MOST: u64 = 1 << 30;

impl Config {
    /// What of it is the choreographer's.
    pub fn choreographer(&self) -> choreographer::Options {
        let (servant, memory) = (&self.servant, &self.memory);
        let daemon = memory.daemon.map(|size| size.0);
        choreographer::Options {
            limits: self.limits,
            classes: self
                .class
                .iter()
                .map(|(name, class)| (name.clone(), of(class)))
                .collect(),
            cores: self.capacity.cores().min(machine::cores()),
            controller: self.capacity.controller == Controller::On,
            reserve_cpus: servant.reserve_cpus,
            reserve_memory: servant.reserve_memory.0,
            deadline: self.capacity.deadline.0,
            start: servant.start.0,
            grace: servant.grace.0,
            anonymous_grace: servant.anonymous_grace.0,
            warm_pool: servant.warm_pool,
            warm_memory: servant.warm_memory.0,
            warm_nodes: servant.warm_nodes,
            hung: match servant.hung {
                Hung::Ignore => choreographer::Hung::Ignore,
                Hung::Report => choreographer::Hung::Report,
                Hung::Restart => choreographer::Hung::Restart,
            },
            hung_after: servant.hung_after,
            bridge: bridge_options(self),
            memory: MemoryOptions {
                daemon: daemon.unwrap_or_else(|| (machine::most_memory() / PART).min(MOST)),
                client: memory.client.0,
                servant: memory.servant.0,
                unfinished: memory.unfinished.0,
            },
        }
    }

    /// What of it is for pushes.
    pub fn push(&self) -> push::Options {
        let push = &self.push;
        push::Options {
            archive: push.archive,
            unpacked: push.unpacked,
            entries: push.entries,
            probe: push.probe.0,
            stall: push.stall.0,
            min_rate: push.min_rate,
            at_once: push.at_once,
            queue: push.queue,
            time: push.time.0,
            disk: push.disk,
            free: push.free,
            per_deployer: push.per_deployer,
        }
    }

    /// What of it is the portal's.
    pub fn portal(&self) -> portal::Options {
        portal::Options {
            origins: self.origins.clone(),
            // They were checked before anything was started.
            proxies: self.proxies().unwrap_or_default(),
            default_service: self.default_service.clone(),
            default_robot: self.default_robot.clone(),
            handshake: self.portal.handshake.0,
            drain: self.portal.drain.0,
            isolation: self.isolation.to_string(),
            black_box: self.black_box.options(),
        }
    }
}

impl Push {
    /// Limits of each container of a build.
    pub fn limits(&self) -> servant::spec::Limits {
        servant::spec::Limits {
            cpus: self.cpus,
            memory: self.memory.map(|memory| memory.0),
            pids: Some(self.pids),
            ..servant::spec::Limits::default()
        }
    }
}

fn of(class: &Class) -> choreographer::Class {
    choreographer::Class {
        priority: class.priority,
        caps: Caps {
            cpus: class.max_cpus,
            memory: class.max_memory,
        },
        sla: class.sla,
        limits: class.limits,
    }
}

/// What the configuration says of bridges.
fn bridge_options(config: &Config) -> BridgeOptions {
    let bytes = |size: Size| usize::try_from(size.0).unwrap_or(usize::MAX);
    BridgeOptions {
        max_frame: bytes(config.portal.max_frame),
        max_message: bytes(config.portal.max_message),
        max_encoded: bytes(config.portal.max_encoded),
        unfinished: config.memory.unfinished.0,
        ping_interval: config.portal.ping.0,
        idle_timeout: config.portal.idle.0,
        non_finite: match config.portal.non_finite {
            NonFinite::Null => ros::codec::NonFinite::Null,
            NonFinite::Text => ros::codec::NonFinite::String,
            NonFinite::Bare => ros::codec::NonFinite::Bare,
        },
        resume_grace: config.servant.grace.0,
        ..BridgeOptions::default()
    }
}
