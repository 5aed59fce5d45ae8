//! Nodes that do the same in either ROS, under the same names: who tells a story of both asks one of these.

use anyhow::Context;
use bytes::Bytes;
use ros::bus::RosVersion;

use crate::layout::Layout;
use crate::ros_system::Node;
use crate::site::{Running, Site, text_of};
use crate::world::{ADDER, CROSSING, GREETER, Service};

/// The nodes of ROS 2.
pub const TWINS: Service = Service {
    name: "twins_ros2",
    package: Some("twins_ros2"),
    arguments: &["--node", "greeter", "--node", "adder", "--node", "caller"],
};

/// One of them.
#[derive(Clone, Copy)]
pub struct Twin {
    /// In which ROS.
    pub ros: RosVersion,
    /// What is pushed; the package has its name.
    pub service: Service,
    /// Its executable.
    pub executable: &'static str,
}

impl Twin {
    /// Greets on `~greeting` whoever is named on `~name`, the last one latched; `~count` says how many were named.
    pub fn greeter(ros: RosVersion) -> Self {
        Self::of(ros, (GREETER, "greeter"), "greeter")
    }

    /// Adds by `/add_two`, and says what came out on `/sums`.
    pub fn adder(ros: RosVersion) -> Self {
        Self::of(ros, (ADDER, "adder.py"), "adder")
    }

    /// Called `crossing`: by `~ask` it asks its robot's `/robot/secret`, by `~wait` it waits for `/robot/late`; `~now` tells the time.
    pub fn caller(ros: RosVersion) -> Self {
        Self::of(ros, (CROSSING, "crossing.py"), "caller")
    }

    fn of(
        ros: RosVersion,
        (service, executable): (Service, &'static str),
        two: &'static str,
    ) -> Self {
        let (service, executable) = match ros {
            RosVersion::One => (service, executable),
            RosVersion::Two => (TWINS, two),
        };
        Self {
            ros,
            service,
            executable,
        }
    }

    /// Service, package and executable, as [`Site::stub`] takes them.
    pub fn names(&self) -> (&'static str, &'static str, &'static str) {
        (self.service.name, self.service.name, self.executable)
    }

    /// Where its program is in an image.
    pub fn program(&self) -> String {
        let (_, package, executable) = self.names();
        format!("/opt/cloudroid/install/lib/{package}/{executable}")
    }

    /// A command line by which the node has this name, and names are others: `~NAME` is one of the node's own.
    pub fn argv(&self, node: &str, remaps: &[(&str, &str)]) -> Vec<String> {
        match self.ros {
            RosVersion::One => {
                let remaps = remaps.iter().map(|(from, to)| format!("{from}:={to}"));
                [format!("__name:={node}")]
                    .into_iter()
                    .chain(remaps)
                    .collect()
            }
            RosVersion::Two => {
                let remaps = remaps.iter().map(|(from, to)| {
                    let from = from.replacen('~', "~/", 1);
                    format!("{from}:={to}")
                });
                let rules = [format!("__node:={node}")].into_iter().chain(remaps);
                let rules = rules.flat_map(|rule| ["-r".to_owned(), rule]);
                ["--ros-args".to_owned()].into_iter().chain(rules).collect()
            }
        }
    }

    /// A stub of it, with a server and a `robot` of its own and further settings.
    pub fn stub(
        &self,
        site: &Site,
        (server, robot): (&str, &str),
        settings: &str,
        argv: &[String],
    ) -> anyhow::Result<Running> {
        let (service, package, executable) = self.names();
        let toml = format!(
            "server = \"ws://{server}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n{settings}\n"
        );
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        site.stub_with(&toml, package, executable, &argv)
    }

    /// A robot's name in the story of this ROS.
    pub fn robot(&self, name: &str) -> String {
        format!("{name}-{}", self.ros.number())
    }
}

/// How many names a greeter has heard.
pub fn count(site: &Site, app: &(impl Node + ?Sized), node: &str) -> anyhow::Result<u32> {
    let service = format!("{node}/count");
    match site.system.version() {
        RosVersion::One => {
            let answer = site.calls(app, &service, &[0])?;
            let number = answer.first_chunk().context("too short")?;
            Ok(u32::from_le_bytes(*number))
        }
        RosVersion::Two => Ok(triggered(site, app, &service)?.1.parse()?),
    }
}

/// The request of a std_srvs/Trigger.
pub fn trigger(ros: RosVersion) -> Bytes {
    let mut request = Layout::of(ros);
    if ros == RosVersion::Two {
        // An empty message is a byte.
        request.u8(0);
    }
    request.finish()
}

/// What a std_srvs/Trigger answers.
pub fn answer_of(ros: RosVersion, success: bool, message: &str) -> Bytes {
    let mut answer = Layout::of(ros);
    answer.u8(success.into()).text(message).finish()
}

/// Whether a std_srvs/Trigger succeeded, and its words.
pub fn said(ros: RosVersion, answer: &[u8]) -> anyhow::Result<(bool, String)> {
    let at = match ros {
        RosVersion::One => 0,
        RosVersion::Two => 4,
    };
    let success = answer.get(at).context("too short")?;
    Ok((*success == 1, text_of(ros, answer, 1)?))
}

/// Calls a std_srvs/Trigger.
pub fn triggered(
    site: &Site,
    app: &(impl Node + ?Sized),
    service: &str,
) -> anyhow::Result<(bool, String)> {
    let ros = site.system.version();
    said(ros, &site.calls(app, service, &trigger(ros))?)
}

/// A call of an adder, with nothing to add to a number.
pub fn sum(ros: RosVersion, number: i64) -> Bytes {
    let bytes = number.to_le_bytes();
    match ros {
        RosVersion::One => [bytes, [0; 8]].concat().into(),
        RosVersion::Two => {
            // test_msgs/BasicTypes: other numbers, an int64, a uint64, a text.
            let mut out = Layout::of(ros);
            for _ in 0..BEFORE / 4 {
                out.u32(0);
            }
            for byte in bytes {
                out.u8(byte);
            }
            out.u32(0).u32(0).text("").finish()
        }
    }
}

/// What an adder has answered.
pub fn sum_of(ros: RosVersion, answer: &[u8]) -> anyhow::Result<i64> {
    let at = match ros {
        RosVersion::One => 0,
        RosVersion::Two => 4 + BEFORE,
    };
    let number = answer.get(at..).and_then(|rest| rest.first_chunk());
    Ok(i64::from_le_bytes(*number.context("too short")?))
}

/// Bytes of a test_msgs/BasicTypes before its int64.
const BEFORE: usize = 32;
