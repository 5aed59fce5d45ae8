//! Nodes that wait for their robot before they show all of themselves.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, ServiceHandler, ServiceType, reaches};
use support::Verdict;
use support::patience::{Deadline, scale};
use support::site::Site;
use support::world::world;

use crate::crossing::{Written, advertises, answers, listens, types, with_log};

/// Always the same answer.
struct Answer(&'static [u8]);

#[async_trait]
impl ServiceHandler for Answer {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, String> {
        Ok(Bytes::from_static(self.0))
    }
}

pub fn a_node_that_waits_is_seen_whole_and_driven_by_its_robot() -> Verdict {
    let daemon = world().shared()?;
    // Its frame is known by nothing but what it complains of, its name only when it runs.
    let pushed = daemon
        .deployer()
        .pushes("patient_py", &["--node", "patient.py"])?
        .succeeded()?;
    let service = daemon.deployer().asks(&["services", "patient_py"])?;
    let interface = &service["interface"];
    let names = |kind: &str| -> Vec<String> {
        let all = interface[kind].as_array().into_iter().flatten();
        all.filter_map(|one| Some(one["name"].as_str()?.to_owned()))
            .collect()
    };
    ensure!(
        names("topics") == ["/scan", "/tf"] && names("actions") == ["/move_base"],
        "{interface:#}\n{}",
        pushed.said()
    );
    ensure!(names("needs") == ["/static_map"], "{interface:#}");
    ensure!(service["nodes"][0]["name"] == "/move_base", "{service:#}");

    let types = types()?;
    types.insert(
        "sensor_msgs/LaserScan",
        "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
         float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities",
    )?;
    let action = types.action("actionlib/Test")?;
    let site = Site::new()?;
    let app = site.node("/app")?;
    let settings = format!(
        "server = \"ws://{}\"\nservice = \"patient_py\"\nrobot = \"patience\"\nlocal = \"none\"\n",
        daemon.address
    );
    let stub = site.stub_with(
        &settings,
        "patient_py",
        "patient.py",
        &["__name:=move_base"],
    )?;
    let trigger = ServiceType::new("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522");
    let map = app.serve("/static_map", trigger, Arc::new(Answer(&[1, 0, 0, 0, 0])));
    let _map = site.runtime.block_on(map)?;
    let scans = types.message("sensor_msgs/LaserScan")?;
    let scans = advertises(&site, &app, "/scan", &scans, false)?;
    let transforms = types.message("tf2_msgs/TFMessage")?;
    let transforms = advertises(&site, &app, "/tf", &transforms, false)?;
    let goals = advertises(&site, &app, "/move_base/goal", &action.action_goal, false)?;
    let now = link::clock::now();
    let transform = Written::default()
        .word(1)
        .word(0)
        .time(now)
        .text("map")
        .text("chassis");
    let transform: Bytes = transform.zeros(7 * 8).0.into();
    let scan = Written::default()
        .word(0)
        .time(now)
        .text("chassis")
        .zeros(7 * 4 + 8);
    let scan: Bytes = scan.0.into();
    let goal = Written::default()
        .word(0)
        .time(now)
        .text("")
        .time(now)
        .text("there")
        .word(7);
    let goal: Bytes = goal.0.into();
    // The action is there once the node has what it waits for.
    let gives = || {
        transforms.publish(transform.clone());
        scans.publish(scan.clone());
    };
    let deadline = Deadline::begin();
    let there = || {
        let connected = reaches(goals.matched(), 1);
        let moment = scale(Duration::from_millis(200));
        let wait = async { tokio::time::timeout(moment, connected).await };
        site.runtime.block_on(wait).is_ok()
    };
    while !there() {
        deadline.check(|| {
            let node = daemon.deployer().types(&["logs", "patient_py"]);
            let node = node.map_or_else(|error| error.to_string(), |node| node.said());
            format!("no action came: {}\nthe node said: {node}", stub.said())
        })?;
        gives();
    }
    let mut results = listens(&site, &app, "/move_base/result")?;
    let drives = || {
        gives();
        goals.publish(goal.clone());
    };
    let result = with_log(answers(&site, drives, &mut results), &stub)?;
    let steps = i32::from_le_bytes(*result.bytes.last_chunk().context("a number")?);
    ensure!(steps == 7, "{result:?}");
    Ok(())
}
