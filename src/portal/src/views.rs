//! Conversion of the daemon's records to the types of the API.

use std::sync::Arc;

use api::{Capacity, Interface, Isolation, Node, Revision, ServiceDetail, ServiceSummary, Status};
use package::interface as recorded;
use ros::bus::RosVersion;

use crate::app::App;
use crate::errors::Error;
use crate::log_levels;
use choreographer::Handle;
use store::RevisionRecord;

/// Returns the summary of a service.
pub fn summary(app: &App, revision: &RevisionRecord) -> ServiceSummary {
    let interface = &revision.interface;
    let servants = app.choreographer.servants();
    ServiceSummary {
        name: revision.service.clone(),
        address: app.address(&revision.service),
        package: revision.package.clone(),
        revision: revision.number,
        image: revision.image.clone(),
        published: revision.published,
        topics: interface.topics.len(),
        services: interface.services.len(),
        actions: interface.actions.len(),
        parameters: interface.parameters.len(),
        servants: servants.iter().filter(|servant| servant.service() == revision.service).count(),
        limits: revision.plan.limits.or(app.choreographer.default_limits()),
    }
}

/// Returns everything known of a service.
pub fn service(app: &App, name: &str) -> Result<ServiceDetail, Error> {
    let current = app.catalogue.current_revision(name)?;
    let revisions = app.state.revisions(name)?;
    Ok(ServiceDetail {
        summary: summary(app, &current),
        revisions: revisions
            .into_iter()
            .map(|revision| Revision {
                current: revision.number == current.number,
                number: revision.number,
                image: revision.image,
                published: revision.published,
                source: revision.source,
            })
            .collect(),
        nodes: current
            .plan
            .nodes
            .iter()
            .map(|node| Node { name: node.name.clone(), argv: node.argv.clone() })
            .collect(),
        interface: interface(current.flavour.ros.ros_version(), &current.interface),
        shared: current.plan.shared,
        groups: app.choreographer.groups(name),
        rollout: app.choreographer.rollout(name).is_ok(),
    })
}

fn interface(ros: RosVersion, of: &recorded::Interface) -> Interface {
    Interface {
        topics: of.topics.iter().map(topic).collect(),
        services: of
            .services
            .iter()
            .map(|service| api::interface::Service {
                name: service.name.clone(),
                type_name: service.type_name.clone(),
                node: service.node.clone(),
            })
            .collect(),
        actions: of
            .actions
            .iter()
            .map(|action| api::interface::Action {
                name: action.name.clone(),
                type_name: action.type_name.clone(),
                node: action.node.clone(),
            })
            .collect(),
        parameters: of
            .parameters
            .iter()
            .map(|parameter| api::interface::Parameter {
                name: parameter.name.clone(),
                node: Some(parameter.node.clone()).filter(|node| !node.is_empty()),
                value: parameter.value.clone(),
                descriptor: parameter.descriptor.as_ref().map(descriptor),
            })
            .collect(),
        lifecycle: of.lifecycle.clone(),
        needs: of
            .needs
            .iter()
            .map(|need| api::interface::Need { name: need.name.clone(), nodes: need.nodes.clone() })
            .collect(),
        requests: of.decided_requests(ros).iter().map(request).collect(),
    }
}

fn request(of: &package::requests::Request) -> api::interface::Request {
    use package::requests::Reason;
    api::interface::Request {
        node: of.node.clone(),
        input: of.pair.input.clone(),
        outputs: of.pair.outputs.clone(),
        by: of.pair.by.map(|by| by.to_string()).unwrap_or_default(),
        reason: match of.reason {
            Reason::Stated => "stated",
            Reason::Watched => "watched",
            Reason::Alone => "alone",
            Reason::Guessed => "guessed",
        }
        .to_owned(),
    }
}

fn topic(of: &recorded::Topic) -> api::interface::Topic {
    api::interface::Topic {
        name: of.name.clone(),
        type_name: of.type_name.clone(),
        md5: of.md5.clone(),
        direction: match of.direction {
            recorded::Direction::Input => api::interface::Direction::Input,
            recorded::Direction::Output => api::interface::Direction::Output,
        },
        latched: of.latched,
        lazy: of.lazy,
        qos: of.qos,
    }
}

fn descriptor(of: &recorded::Descriptor) -> api::interface::Descriptor {
    let number = |number: &Option<serde_json::Number>| number.as_ref()?.as_f64();
    api::interface::Descriptor {
        kind: of.kind.clone(),
        description: of.description.clone(),
        constraints: of.constraints.clone(),
        read_only: of.read_only,
        dynamic_typing: of.dynamic_typing,
        range: of.range.as_ref().map(|range| api::interface::Range {
            from: number(&range.from),
            to: number(&range.to),
            step: number(&range.step),
        }),
    }
}

/// Returns the daemon's status.
pub async fn status(app: &App) -> Result<Status, Error> {
    let servants = app.choreographer.servants();
    let usage = total_usage(&servants).await;
    let (capacity, taken, waiting) = app.choreographer.admission().snapshot();
    let (warm_pool, warm_nodes) = app.choreographer.warm_pool();
    Ok(Status {
        version: env!("CARGO_PKG_VERSION").to_owned(),
        architecture: std::env::consts::ARCH.to_owned(),
        pid: std::process::id(),
        home: app.home.display().to_string(),
        listen: app.listen.to_string(),
        certificate: app.tls.as_ref().map(|tls| tls.fingerprint().to_string()),
        default_service: app.options.default_service.clone(),
        started: app.started,
        isolation: Isolation {
            mode: app.options.isolation.clone(),
            cgroup_version: app.machine.cgroup_version,
            missing: app.machine.missing_limits.clone(),
        },
        capacity: Capacity {
            cpus: capacity.cpus(),
            memory: capacity.memory,
            cpus_reserved: taken.cpus(),
            memory_reserved: taken.memory,
            waiting,
        },
        limits: app.choreographer.default_limits(),
        services: app.state.service_names()?.len(),
        servants: servants.len(),
        warm_pool,
        warm_nodes,
        connections: servants.iter().map(|servant| servant.connections()).sum(),
        usage,
        black_box: app.options.black_box.span.as_secs_f64(),
        warnings: app
            .machine
            .warnings
            .iter()
            .cloned()
            .chain(app.state.outage_message())
            .chain(app.choreographer.admission().stall_reason())
            .collect(),
    })
}

/// Returns the servants' total usage, and the machine's pressure.
async fn total_usage(servants: &[Arc<Handle>]) -> api::Usage {
    let mut sum = api::Usage { pressure: servant::host::pressure(), ..api::Usage::default() };
    for servant in servants {
        if let Some(usage) = choreographer::usage(servant).await {
            sum.cpu_usec += usage.cpu_usec;
            sum.memory += usage.memory;
            sum.pids += usage.pids;
            sum.oom_kills += usage.oom_kills;
            sum.throttled_usec += usage.throttled_usec;
        }
    }
    sum
}

/// Converts a line of a servant's log.
pub fn log_line(line: servant::engine::LogLine) -> api::LogLine {
    api::LogLine {
        time: store::millis(line.time),
        node: line.node,
        stream: match &*line.stream {
            "stderr" => api::Stream::Stderr,
            _ => api::Stream::Stdout,
        },
        level: log_levels::find_level(&line.line),
        line: line.line,
    }
}
