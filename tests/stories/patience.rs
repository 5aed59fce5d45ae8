//! Nodes that wait for their robot before they show all of themselves.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, ensure};
use async_trait::async_trait;
use bytes::Bytes;
use ros::bus::{Bus, Message, Publisher, ServiceHandler, ServiceType, reaches};
use ros::ros1::Ros1Bus;
use support::Verdict;
use support::cable::{Badness, Cable};
use support::patience::{Deadline, scale};
use support::site::{Running, Site, string};
use support::world::world;

use crate::crossing::{Written, advertises, answers, listens, types, with_log};

/// The place that is reached when the robot says so.
const FAR: u32 = 1000;
/// Between two looks.
const MOMENT: Duration = Duration::from_millis(200);
const SILENT: Badness = Badness {
    rate: 100_000,
    delay: 1,
    jitter: 0,
    loss: 1.0,
    limit: 1000,
};

/// Always the same answer.
struct Answer(&'static [u8]);

#[async_trait]
impl ServiceHandler for Answer {
    async fn call(&self, _request: Bytes, _caller: &str) -> Result<Bytes, String> {
        Ok(Bytes::from_static(self.0))
    }
}

/// A robot around a node that waits as move_base does: it knows where it is, has a map and a scanner, and sends goals.
struct Base<'a> {
    site: &'a Site,
    app: Arc<Ros1Bus>,
    transforms: Box<dyn Publisher>,
    scans: Box<dyn Publisher>,
    goals: Box<dyn Publisher>,
    /// A service.
    _map: Box<dyn Send + Sync>,
}

impl<'a> Base<'a> {
    fn new(site: &'a Site) -> anyhow::Result<Self> {
        let types = types()?;
        types.insert(
            "sensor_msgs/LaserScan",
            "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
             float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities",
        )?;
        let action = types.action("actionlib/Test")?;
        let app = site.node("/app")?;
        let trigger = ServiceType::new("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522");
        let map = app.serve("/static_map", trigger, Arc::new(Answer(&[1, 0, 0, 0, 0])));
        let map = site.runtime.block_on(map)?;
        let scans = types.message("sensor_msgs/LaserScan")?;
        let transforms = types.message("tf2_msgs/TFMessage")?;
        Ok(Self {
            scans: advertises(site, &app, "/scan", &scans, false)?,
            transforms: advertises(site, &app, "/tf", &transforms, false)?,
            goals: advertises(site, &app, "/move_base/goal", &action.action_goal, false)?,
            site,
            app,
            _map: map,
        })
    }

    /// Says where it is, and what it sees, as it does all the time.
    fn gives(&self) {
        let now = link::clock::now();
        let transform = Written::default()
            .word(1)
            .word(0)
            .time(now)
            .text("map")
            .text("chassis");
        self.transforms.publish(transform.zeros(7 * 8).0.into());
        let scan = Written::default()
            .word(0)
            .time(now)
            .text("chassis")
            .zeros(7 * 4 + 8);
        self.scans.publish(scan.0.into());
    }

    /// Goes on so until something is so.
    fn gives_until(
        &self,
        what: &str,
        stub: &Running,
        mut is_so: impl FnMut() -> anyhow::Result<bool>,
    ) -> Verdict {
        let deadline = Deadline::begin();
        loop {
            self.gives();
            if is_so()? {
                return Ok(());
            }
            deadline.check(|| format!("{what}: {}", stub.said()))?;
        }
    }

    /// Returns once somebody takes its goals.
    fn is_driven(&self, stub: &Running) -> Verdict {
        self.gives_until("no action came", stub, || {
            let connected = reaches(self.goals.matched(), 1);
            let wait = async { tokio::time::timeout(scale(MOMENT), connected).await };
            Ok(self.site.runtime.block_on(wait).is_ok())
        })
    }

    fn sends(&self, id: &str, number: u32) {
        let now = link::clock::now();
        let goal = Written::default()
            .word(0)
            .time(now)
            .text("")
            .time(now)
            .text(id)
            .word(number);
        self.goals.publish(goal.0.into());
    }
}

/// The number at the end of a result.
fn number(result: &Message) -> anyhow::Result<u32> {
    let number = result.bytes.last_chunk().context("a number")?;
    Ok(u32::from_le_bytes(*number))
}

/// Whether a message of an action is about this goal.
fn is_of(message: &Message, id: &str) -> bool {
    String::from_utf8_lossy(&message.bytes).contains(id)
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
        names("topics") == ["/arrived", "/scan", "/tf"] && names("actions") == ["/move_base"],
        "{interface:#}\n{}",
        pushed.said()
    );
    ensure!(names("needs") == ["/static_map"], "{interface:#}");
    ensure!(service["nodes"][0]["name"] == "/move_base", "{service:#}");

    let site = Site::new()?;
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
    let base = Base::new(&site)?;
    base.is_driven(&stub).with_context(|| {
        match daemon.deployer().types(&["logs", "patient_py"]) {
            Ok(node) => format!("the node said: {}", node.said()),
            Err(error) => error.to_string(),
        }
    })?;
    let mut results = listens(&site, &base.app, "/move_base/result")?;
    let drives = || {
        base.gives();
        base.sends("there", 7);
    };
    let result = with_log(answers(&site, drives, &mut results), &stub)?;
    ensure!(number(&result)? == 7, "{result:?}");
    Ok(())
}

pub fn a_goal_is_reached_by_the_original_when_the_cable_is_cut_on_the_way() -> Verdict {
    let daemon = world().shared()?;
    let service = "patient_original";
    let pushed = ["--node", "patient.py", "--name", service];
    daemon
        .deployer()
        .pushes("patient_py", &pushed)?
        .succeeded()?;
    let cable = Cable::new(&daemon.address)?;
    let site = Site::new()?;
    let overlay = site.installs(&daemon, service, "")?;
    let original = ("patient_py", "patient.py");
    let program = "/opt/cloudroid/install/lib/patient_py/patient.py";
    let workspace = site.installs_original(&daemon, service, original, program)?;
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let server = format!("ws://{}", cable.server);
    let variables = [
        ("CMAKE_PREFIX_PATH", prefixes.as_str()),
        ("CLOUDROID_SERVER", server.as_str()),
        ("CLOUDROID_ROBOT", "patience-cut"),
        ("NO_COLOR", "1"),
    ];
    let stub = site.runs_among(
        &variables,
        &overlay,
        original.0,
        original.1,
        &["__name:=move_base", "_keeps_scanning:=true"],
    )?;
    let base = Base::new(&site)?;
    base.is_driven(&stub)?;
    let count = |words: &str| stub.said().matches(words).count();
    let (over, back) = (
        "the local original answers, too why=LinkDown",
        "the cloud answers alone why=LinkUp",
    );
    // A slow machine reaches the cloud late: the original may have stood in already.
    base.gives_until("no link", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count("linked to") > 0 && count(over) == count(back))
    })?;
    let before = count(over);
    let mut feedback = listens(&site, &base.app, "/move_base/feedback")?;
    let mut results = listens(&site, &base.app, "/move_base/result")?;
    let arrivals = site.says(&base.app, "/arrived", false)?;
    site.fed(&feedback, 1)?;
    site.fed(&results, 1)?;
    // On its way, in the cloud.
    base.sends("far", FAR);
    base.gives_until("it is not on its way", &stub, || {
        let told = site.next_within(&mut feedback, scale(MOMENT))?;
        Ok(told.is_some_and(|told| is_of(&told, "far")))
    })?;
    cable.degrade(SILENT)?;
    // The original waits for a transform, a service and a scan before it takes goals.
    base.gives_until("the original does not take over", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count(over) > before)
    })?;
    let mut arrived = None;
    base.gives_until("nobody drives on", &stub, || {
        arrivals.publish(string("there"));
        arrived = site.next_within(&mut results, scale(MOMENT))?;
        Ok(arrived.is_some())
    })?;
    let arrived = arrived.context("a result")?;
    ensure!(
        is_of(&arrived, "far") && number(&arrived)? == FAR && count(back) == before,
        "{arrived:?}\n{}",
        stub.said()
    );
    cable.restore()?;
    base.gives_until("the cloud does not come back", &stub, || {
        std::thread::sleep(scale(MOMENT));
        Ok(count(back) > before)
    })?;
    // The next goal is the cloud's, and the last one is not answered again.
    let mut near = None;
    base.gives_until("no second result", &stub, || {
        base.sends("near", 7);
        near = site.next_within(&mut results, scale(MOMENT))?;
        Ok(near.is_some())
    })?;
    let near = near.context("a result")?;
    ensure!(is_of(&near, "near") && number(&near)? == 7, "{near:?}");
    Ok(())
}
