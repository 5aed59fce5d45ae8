//! Conversion of the configuration into the options of each crate.

use api::{Caps, Size};
use bridge::BridgeOptions;
use choreographer::MemoryOptions;

use super::{ClassConfig, Config, Controller, Hung, LoopbackRobots, NonFinite, PushConfig};
use crate::machine;

/// Default limit of the daemon's memory: a quarter of the machine's, and at most 1 GiB.
const MEMORY_DIVISOR: u64 = 4;
const MAX_DEFAULT_MEMORY: u64 = 1 << 30;

impl Config {
    /// Returns the choreographer's options.
    pub fn choreographer_options(&self) -> choreographer::Options {
        let (servant, memory) = (&self.servant, &self.memory);
        let daemon = memory.daemon.map(|size| size.0);
        choreographer::Options {
            limits: self.limits,
            classes: self.class.iter().map(|(name, class)| (name.clone(), to_choreographer_class(class))).collect(),
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
                Hung::Ignore => choreographer::HungPolicy::Ignore,
                Hung::Report => choreographer::HungPolicy::Report,
                Hung::Restart => choreographer::HungPolicy::Restart,
            },
            hung_after: servant.hung_after,
            bridge: bridge_options(self),
            memory: MemoryOptions {
                daemon: daemon.unwrap_or_else(|| (machine::usable_memory() / MEMORY_DIVISOR).min(MAX_DEFAULT_MEMORY)),
                client: memory.client.0,
                servant: memory.servant.0,
                unfinished: memory.unfinished.0,
            },
            kept_logs: self.logs.options(),
            tracer: None,
        }
    }

    /// Returns the options for pushes.
    pub fn push_options(&self) -> push::Options {
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

    /// Returns the portal's options.
    pub fn portal_options(&self) -> portal::Options {
        portal::Options {
            origins: self.origins.clone(),
            // `check` has validated them before anything was started.
            proxies: self.proxies().unwrap_or_default(),
            default_service: self.default_service.clone(),
            default_robot: self.default_robot.clone(),
            loopback_robots: self.portal.loopback_robots == LoopbackRobots::Allowed,
            handshake: self.portal.handshake.0,
            drain: self.portal.drain.0,
            isolation: self.isolation.to_string(),
            black_box: self.black_box.options(),
            exec: self.portal.exec,
        }
    }
}

impl PushConfig {
    /// Returns the limits of each container of a build.
    pub fn limits(&self) -> api::Limits {
        api::Limits { cpus: self.cpus, memory: self.memory, pids: Some(self.pids), ..api::Limits::default() }
    }
}

fn to_choreographer_class(class: &ClassConfig) -> choreographer::ClassOptions {
    choreographer::ClassOptions {
        priority: class.priority,
        caps: Caps { cpus: class.max_cpus, memory: class.max_memory },
        sla: class.sla,
        limits: class.limits,
    }
}

/// Returns the options of bridges.
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
