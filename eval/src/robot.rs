//! The program in a robot's sandbox: a ROS Master, the robot's own node, which plays a recording and receives the
//! answers, and the package itself or its stub.

mod answers;
mod asking;
mod boxes;
mod carried;
mod ends;
mod plan;
mod stub_log;

use std::path::Path;

use anyhow::{Context, Result, ensure};
use nix::sys::signal::Signal;
use servant::cgroup::Cgroup;
use support::site::{NodeProcess, Site};

use crate::application;
use crate::recording::{RecordedStep, Recording};
use crate::trace::Trace;
use plan::WARM_UP;

pub use answers::digest_message;
pub use asking::has_ended;
pub use plan::{NodeUnderTest, RequestPacing, RobotPlan};

/// Runs the robot with the plan in the file `order` in this process, and writes its trace to `answer`.
pub fn main(order: &Path, answer: &Path) -> Result<()> {
    let (plan, cgroup): (RobotPlan, Cgroup) = serde_json::from_slice(&std::fs::read(order)?)?;
    cgroup.add_process(std::process::id())?;
    let trace = run(&plan)?;
    Ok(std::fs::write(answer, serde_json::to_vec(&trace)?)?)
}

fn run(plan: &RobotPlan) -> Result<Trace> {
    if let RequestPacing::Played(seconds) = plan.pace {
        let site = Site::new()?;
        let node = start_node(&site, plan)?;
        let heard = application::run(&site, plan, seconds, &node);
        return heard.with_context(|| format!("the node said: {}", node.output()));
    }
    let recording = Recording::read(&plan.recording)?;
    let steps: Vec<RecordedStep> = recording.steps(&plan.request);
    ensure!(steps.len() > WARM_UP, "{} has {} messages of {}", plan.recording.display(), steps.len(), plan.request);
    let site = Site::new()?;
    let mut ends = ends::create_endpoints(&site, plan, &recording)?;
    let mut node = start_node(&site, plan)?;
    let asked = asking::ask(&site, &mut ends, plan, &steps, &mut node);
    let mut trace = asked.with_context(|| format!("the node said: {}", node.output()))?;
    if let NodeUnderTest::Stub { .. } = plan.node {
        trace.handovers = stub_log::count_handovers(&node.output());
        stub_log::apply_stub_log(&node.output(), &mut trace.requests);
        let warns = |line: &&str| line.contains(" WARN ");
        trace.warnings = node.output().lines().filter(warns).map(str::to_owned).collect();
    }
    if trace.node_ended.is_none() {
        // SIGINT, as roslaunch sends it.
        node.signal(Signal::SIGINT)?;
        node.wait_for_exit()?;
    }
    Ok(trace)
}

fn start_node(site: &Site, plan: &RobotPlan) -> Result<NodeProcess> {
    match &plan.node {
        NodeUnderTest::Native { script, program, argv } => site.start_in_image(script, program, argv),
        NodeUnderTest::Stub { package, executable, argv, settings, environment: besides } => {
            let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
            let toml = format!("server = \"{}\"\n{settings}\n", plan.server);
            let mut environment =
                vec![("ROS_IP", "127.0.0.1"), ("NO_COLOR", "1"), ("CLOUDROID_LOG", "info,requests=debug")];
            environment.extend(besides.iter().map(|(name, value)| (&**name, &**value)));
            site.start_stub_with_environment(&environment, &toml, package, executable, &argv)
        }
    }
}
