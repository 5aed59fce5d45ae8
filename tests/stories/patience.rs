//! Nodes that wait for their robot before they register everything.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, FailureReason, Publisher, SerializedMessage, ServiceHandler, ServiceType, wait_for_connected};
use ros::ros1::Ros1Bus;
use support::Verdict;
use support::cable::{Cable, NetworkImpairment};
use support::patience::{Deadline, scale};
use support::site::{NodeProcess, Site, string};
use support::world::world;

use crate::crossing::{MessageBytes, advertise, message_types, subscribe, wait_for_answer, with_log};

/// Number of the goal that is reached when the robot says so.
const FAR: u32 = 1000;
/// Polling interval.
const MOMENT: Duration = Duration::from_millis(200);
const SILENT: NetworkImpairment = NetworkImpairment { rate: 100_000, delay: 1, jitter: 0, loss: 1.0, limit: 1000 };

/// A service with a constant response.
struct FixedAnswer(&'static [u8]);

#[async_trait]
impl ServiceHandler for FixedAnswer {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, FailureReason> {
        Ok(Bytes::from_static(self.0))
    }
}

/// A robot around a node that waits as move_base does: it publishes its position, a map and scans, and sends goals.
struct NavigationBase<'a> {
    site: &'a Site,
    app: Arc<Ros1Bus>,
    transforms: Box<dyn Publisher>,
    scans: Box<dyn Publisher>,
    goals: Box<dyn Publisher>,
    /// Server of the map.
    _map: Box<dyn Send + Sync>,
}

impl<'a> NavigationBase<'a> {
    fn new(site: &'a Site) -> anyhow::Result<Self> {
        let types = message_types()?;
        types.insert(
            "sensor_msgs/LaserScan",
            "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
             float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities",
        )?;
        let action = types.action("actionlib/Test")?;
        let app = site.node("/app")?;
        let trigger = ServiceType::new("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522");
        let map = app.serve("/static_map", trigger, Arc::new(FixedAnswer(&[1, 0, 0, 0, 0])));
        let map = site.runtime.block_on(map)?;
        let scans = types.message("sensor_msgs/LaserScan")?;
        let transforms = types.message("tf2_msgs/TFMessage")?;
        Ok(Self {
            scans: advertise(site, &app, "/scan", &scans, false)?,
            transforms: advertise(site, &app, "/tf", &transforms, false)?,
            goals: advertise(site, &app, "/move_base/goal", &action.action_goal, false)?,
            site,
            app,
            _map: map,
        })
    }

    /// Publishes its position and a scan, as it does continuously.
    fn publish_state(&self) {
        let now = link::clock::now();
        let transform = MessageBytes::default().word(1).word(0).time(now).text("map").text("chassis");
        self.transforms.publish(transform.zeros(7 * 8).0.into());
        let scan = MessageBytes::default().word(0).time(now).text("chassis").zeros(7 * 4 + 8);
        self.scans.publish(scan.0.into());
    }

    /// Publishes until a condition is satisfied.
    fn publish_until(
        &self,
        what: &str,
        stub: &NodeProcess,
        mut is_so: impl FnMut() -> anyhow::Result<bool>,
    ) -> Verdict {
        let deadline = Deadline::begin();
        loop {
            self.publish_state();
            if is_so()? {
                return Ok(());
            }
            deadline.check(|| format!("{what}: {}", stub.output()))?;
        }
    }

    /// Waits until a node accepts its goals.
    fn wait_until_driven(&self, stub: &NodeProcess) -> Verdict {
        self.publish_until("no action came", stub, || {
            let connected = wait_for_connected(self.goals.matched_subscribers(), 1);
            let wait = async { tokio::time::timeout(scale(MOMENT), connected).await };
            Ok(self.site.runtime.block_on(wait).is_ok())
        })
    }

    fn send_goal(&self, id: &str, number: u32) {
        let now = link::clock::now();
        let goal = MessageBytes::default().word(0).time(now).text("").time(now).text(id).word(number);
        self.goals.publish(goal.0.into());
    }
}

/// Returns the number at the end of a result.
fn result_number(result: &SerializedMessage) -> anyhow::Result<u32> {
    let number = result.bytes.last_chunk().context("a number")?;
    Ok(u32::from_le_bytes(*number))
}

/// Returns whether a message of an action is about this goal.
fn is_about_goal(message: &SerializedMessage, id: &str) -> bool {
    String::from_utf8_lossy(&message.bytes).contains(id)
}

pub fn a_node_that_waits_is_seen_whole_and_driven_by_its_robot() -> Verdict {
    let daemon = world().ensure_shared()?;
    // Its frame is only known from its warnings, its name only when it runs.
    let pushed = daemon.deployer().push("patient_py", &["--node", "patient.py"])?.expect_success()?;
    let service = daemon.deployer().run_json(&["services", "patient_py"])?;
    let interface = &service["interface"];
    let names = |kind: &str| -> Vec<String> {
        let all = interface[kind].as_array().into_iter().flatten();
        all.filter_map(|one| Some(one["name"].as_str()?.to_owned())).collect()
    };
    ensure!(
        names("topics") == ["/arrived", "/scan", "/tf"] && names("actions") == ["/move_base"],
        "{interface:#}\n{}",
        pushed.output()
    );
    ensure!(names("needs") == ["/static_map"], "{interface:#}");
    ensure!(service["nodes"][0]["name"] == "/move_base", "{service:#}");

    let site = Site::new()?;
    let settings = format!(
        "server = \"ws://{}\"\nservice = \"patient_py\"\nrobot = \"patience\"\nlocal = \"none\"\n",
        daemon.address
    );
    let stub = site.start_stub_with_config(&settings, "patient_py", "patient.py", &["__name:=move_base"])?;
    let base = NavigationBase::new(&site)?;
    base.wait_until_driven(&stub).with_context(|| match daemon.deployer().run(&["logs", "patient_py"]) {
        Ok(node) => format!("the node said: {}", node.output()),
        Err(error) => error.to_string(),
    })?;
    let mut results = subscribe(&site, &base.app, "/move_base/result")?;
    let drives = || {
        base.publish_state();
        base.send_goal("there", 7);
    };
    let result = with_log(wait_for_answer(&site, drives, &mut results), &stub)?;
    ensure!(result_number(&result)? == 7, "{result:?}");
    Ok(())
}

pub fn a_goal_is_reached_by_the_original_when_the_cable_is_cut_on_the_way() -> Verdict {
    let daemon = world().ensure_shared()?;
    let service = "patient_original";
    let pushed = ["--node", "patient.py", "--name", service];
    daemon.deployer().push("patient_py", &pushed)?.expect_success()?;
    let cable = Cable::new(&daemon.address)?;
    let site = Site::new()?;
    let overlay = site.install_stub(&daemon, service, "")?;
    let original = ("patient_py", "patient.py");
    let program = "/opt/cloudroid/install/lib/patient_py/patient.py";
    let workspace = site.install_original(&daemon, service, original, program)?;
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let server = format!("ws://{}", cable.server);
    let variables = [
        ("CMAKE_PREFIX_PATH", prefixes.as_str()),
        ("CLOUDROID_SERVER", server.as_str()),
        ("CLOUDROID_ROBOT", "patience-cut"),
        ("NO_COLOR", "1"),
    ];
    let stub = site.start_installed_with_environment(
        &variables,
        &overlay,
        original.0,
        original.1,
        &["__name:=move_base", "_keeps_scanning:=true"],
    )?;
    let base = NavigationBase::new(&site)?;
    base.wait_until_driven(&stub)?;
    let count = |words: &str| stub.output().matches(words).count();
    let (over, back) = ("the local original answers, too why=LinkDown", "the cloud answers alone why=LinkUp");
    // On a slow machine the original may already have taken over before the first link.
    base.publish_until("no link", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count("linked to") > 0 && count(over) == count(back))
    })?;
    let before = count(over);
    let mut feedback = subscribe(&site, &base.app, "/move_base/feedback")?;
    let mut results = subscribe(&site, &base.app, "/move_base/result")?;
    let arrivals = site.advertise_strings(&base.app, "/arrived", false)?;
    site.wait_for_publishers(&feedback, 1)?;
    site.wait_for_publishers(&results, 1)?;
    // On its way, in the cloud.
    base.send_goal("far", FAR);
    base.publish_until("it is not on its way", &stub, || {
        let told = site.next_message_within(&mut feedback, scale(MOMENT))?;
        Ok(told.is_some_and(|told| is_about_goal(&told, "far")))
    })?;
    cable.degrade(SILENT)?;
    // The original waits for a transform, a service and a scan before it accepts goals.
    base.publish_until("the original does not take over", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count(over) > before)
    })?;
    let mut arrived = None;
    base.publish_until("nobody drives on", &stub, || {
        arrivals.publish(string("there"));
        arrived = site.next_message_within(&mut results, scale(MOMENT))?;
        Ok(arrived.is_some())
    })?;
    let arrived = arrived.context("a result")?;
    ensure!(
        is_about_goal(&arrived, "far") && result_number(&arrived)? == FAR && count(back) == before,
        "{arrived:?}\n{}",
        stub.output()
    );
    cable.restore()?;
    base.publish_until("the cloud does not come back", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count(back) > before)
    })?;
    // The next goal goes to the cloud, and the last one is not answered again.
    let mut near = None;
    base.publish_until("no second result", &stub, || {
        base.send_goal("near", 7);
        near = site.next_message_within(&mut results, scale(MOMENT))?;
        Ok(near.is_some())
    })?;
    let near = near.context("a result")?;
    ensure!(is_about_goal(&near, "near") && result_number(&near)? == 7, "{near:?}");
    Ok(())
}
