//! What runs in a robot's place: a ROS Master, the robot's own node, which plays a recording and hears the answers, and the package as it is
//! installed there or its stub.

mod answers;
mod asking;
mod boxes;
mod carried;
mod ends;
mod plan;
mod rate;

use std::path::Path;

use anyhow::{Context, Result, ensure};
use nix::sys::signal::Signal;
use servant::cgroup::Cgroup;
use support::site::{Running, Site};

use crate::application;
use crate::recording::{Recording, Step};
use crate::trace::Trace;

pub use answers::digest;
pub use asking::has_ended;
pub use plan::{Node, Pace, Plan};

/// Stamps of requests begin after this one.
pub const FIRST: u32 = 1000;
/// Requests whose answers are not counted: by then all are connected and awake.
pub const WARM_UP: usize = 3;

/// Runs the robot that `order` tells of, in this process, and writes what it saw to `answer`.
pub fn main(order: &Path, answer: &Path) -> Result<()> {
    let (plan, cgroup): (Plan, Cgroup) = serde_json::from_slice(&std::fs::read(order)?)?;
    cgroup.enter(std::process::id())?;
    let trace = run(&plan)?;
    Ok(std::fs::write(answer, serde_json::to_vec(&trace)?)?)
}

fn run(plan: &Plan) -> Result<Trace> {
    if let Pace::Played(seconds) = plan.pace {
        let site = Site::new()?;
        let node = start(&site, plan)?;
        let heard = application::run(&site, plan, seconds, &node);
        return heard.with_context(|| format!("the node said: {}", node.said()));
    }
    let recording = Recording::read(&plan.recording)?;
    let steps: Vec<Step> = recording.steps(&plan.request);
    ensure!(
        steps.len() > WARM_UP,
        "{} has {} messages of {}",
        plan.recording.display(),
        steps.len(),
        plan.request
    );
    let site = Site::new()?;
    let mut ends = ends::ends(&site, plan, &recording)?;
    let mut node = start(&site, plan)?;
    let asked = asking::ask(&site, &mut ends, plan, &steps, &mut node);
    let mut trace = asked.with_context(|| format!("the node said: {}", node.said()))?;
    if let Node::Stub { .. } = plan.node {
        trace.answered_locally = node.said().matches("answer=Some((Local").count();
        rate::told(&node.said(), &mut trace.requests);
        let warns = |line: &&str| line.contains(" WARN ");
        trace.warnings = node
            .said()
            .lines()
            .filter(warns)
            .map(str::to_owned)
            .collect();
    }
    if trace.node_ended.is_none() {
        // As roslaunch would.
        node.signal(Signal::SIGINT)?;
        node.ends()?;
    }
    Ok(trace)
}

fn start(site: &Site, plan: &Plan) -> Result<Running> {
    match &plan.node {
        Node::Native {
            script,
            program,
            argv,
        } => site.starts_in_image(script, program, argv),
        Node::Stub {
            package,
            executable,
            argv,
            settings,
            environment: besides,
        } => {
            let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
            let toml = format!("server = \"{}\"\n{settings}\n", plan.server);
            let mut environment = vec![
                ("ROS_IP", "127.0.0.1"),
                ("NO_COLOR", "1"),
                ("CLOUDROID_LOG", "info,requests=debug"),
            ];
            environment.extend(besides.iter().map(|(name, value)| (&**name, &**value)));
            site.stub_among(&environment, &toml, package, executable, &argv)
        }
    }
}
