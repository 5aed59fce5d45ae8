//! Nodes with the same behaviour and names in both versions of ROS, for stories that cover both.

use anyhow::Context;
use bytes::Bytes;
use ros::bus::RosVersion;

use crate::layout::MessageLayout;
use crate::ros_system::HasBus;
use crate::site::{NodeProcess, Site, string_text};
use crate::world::{ADDER, CROSSING, GREETER, StoryService};

/// The nodes of ROS 2.
pub const TWINS: StoryService = StoryService {
    name: "twins_ros2",
    package: Some("twins_ros2"),
    arguments: &["--node", "greeter", "--node", "adder", "--node", "caller"],
};

/// One of these nodes.
#[derive(Clone, Copy)]
pub struct Twin {
    /// Version of ROS.
    pub ros: RosVersion,
    /// Service that is pushed; its package has the same name.
    pub service: StoryService,
    /// Executable.
    pub executable: &'static str,
}

impl Twin {
    /// A node that greets the names published on `~name` on `~greeting`, which is latched; `~count` returns how many
    /// names there were.
    pub fn greeter(ros: RosVersion) -> Self {
        Self::new(ros, (GREETER, "greeter"), "greeter")
    }

    /// A node that adds numbers by `/add_two`, and publishes the results on `/sums`.
    pub fn adder(ros: RosVersion) -> Self {
        Self::new(ros, (ADDER, "adder.py"), "adder")
    }

    /// A node named `crossing`: `~ask` calls the robot's `/robot/secret`, `~wait` waits for `/robot/late`, and `~now`
    /// returns the time.
    pub fn caller(ros: RosVersion) -> Self {
        Self::new(ros, (CROSSING, "crossing.py"), "caller")
    }

    fn new(ros: RosVersion, (service, executable): (StoryService, &'static str), two: &'static str) -> Self {
        let (service, executable) = match ros {
            RosVersion::One => (service, executable),
            RosVersion::Two => (TWINS, two),
        };
        Self { ros, service, executable }
    }

    /// Returns service, package and executable, as [`Site::start_stub`] takes them.
    pub fn names(&self) -> (&'static str, &'static str, &'static str) {
        (self.service.name, self.service.name, self.executable)
    }

    /// Returns the path of its program in an image.
    pub fn program(&self) -> String {
        let (_, package, executable) = self.names();
        format!("/opt/cloudroid/install/lib/{package}/{executable}")
    }

    /// Returns a command line with the name of the node and remappings of names; `~NAME` is a private name.
    pub fn argv(&self, node: &str, remaps: &[(&str, &str)]) -> Vec<String> {
        match self.ros {
            RosVersion::One => {
                let remaps = remaps.iter().map(|(from, to)| format!("{from}:={to}"));
                [format!("__name:={node}")].into_iter().chain(remaps).collect()
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

    /// Starts a stub of it, with this server, robot and further settings.
    pub fn stub(
        &self,
        site: &Site,
        (server, robot): (&str, &str),
        settings: &str,
        argv: &[String],
    ) -> anyhow::Result<NodeProcess> {
        let (service, package, executable) = self.names();
        let toml = format!(
            "server = \"ws://{server}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nlocal = \"none\"\n{settings}\n"
        );
        let argv: Vec<&str> = argv.iter().map(String::as_str).collect();
        site.start_stub_with_config(&toml, package, executable, &argv)
    }

    /// Returns a robot's name that is unique for this version of ROS.
    pub fn robot_name(&self, name: &str) -> String {
        format!("{name}-{}", self.ros.number())
    }
}

/// Returns how many names a greeter has received.
pub fn greeting_count(site: &Site, app: &(impl HasBus + ?Sized), node: &str) -> anyhow::Result<u32> {
    let service = format!("{node}/count");
    match site.system.version() {
        RosVersion::One => {
            let answer = site.call_service(app, &service, &[0])?;
            let number = answer.first_chunk().context("too short")?;
            Ok(u32::from_le_bytes(*number))
        }
        RosVersion::Two => Ok(call_trigger(site, app, &service)?.1.parse()?),
    }
}

/// Serializes a request of std_srvs/Trigger.
pub fn trigger_request(ros: RosVersion) -> Bytes {
    let mut request = MessageLayout::new(ros);
    if ros == RosVersion::Two {
        // An empty message is serialized as one byte.
        request.u8(0);
    }
    request.finish()
}

/// Serializes a response of std_srvs/Trigger.
pub fn trigger_response(ros: RosVersion, success: bool, message: &str) -> Bytes {
    let mut answer = MessageLayout::new(ros);
    answer.u8(success.into()).text(message).finish()
}

/// Parses a response of std_srvs/Trigger: success and message.
pub fn parse_trigger_response(ros: RosVersion, answer: &[u8]) -> anyhow::Result<(bool, String)> {
    let at = match ros {
        RosVersion::One => 0,
        RosVersion::Two => 4,
    };
    let success = answer.get(at).context("too short")?;
    Ok((*success == 1, string_text(ros, answer, 1)?))
}

/// Calls a std_srvs/Trigger.
pub fn call_trigger(site: &Site, app: &(impl HasBus + ?Sized), service: &str) -> anyhow::Result<(bool, String)> {
    let ros = site.system.version();
    parse_trigger_response(ros, &site.call_service(app, service, &trigger_request(ros))?)
}

/// Serializes a request to an adder: `number` and zero.
pub fn sum_request(ros: RosVersion, number: i64) -> Bytes {
    let bytes = number.to_le_bytes();
    match ros {
        RosVersion::One => [bytes, [0; 8]].concat().into(),
        RosVersion::Two => {
            // test_msgs/BasicTypes: other numbers, an int64, a uint64, a string.
            let mut out = MessageLayout::new(ros);
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

/// Parses the response of an adder.
pub fn parse_sum(ros: RosVersion, answer: &[u8]) -> anyhow::Result<i64> {
    let at = match ros {
        RosVersion::One => 0,
        RosVersion::Two => 4 + BEFORE,
    };
    let number = answer.get(at..).and_then(|rest| rest.first_chunk());
    Ok(i64::from_le_bytes(*number.context("too short")?))
}

/// Bytes of a test_msgs/BasicTypes before its int64.
const BEFORE: usize = 32;
