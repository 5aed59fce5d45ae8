//! A robot whose camera asks people_detect, wherever that runs: in the cloud behind a cable, or on the robot. Of ROS 1 it is
//! Debian's; of ROS 2 a package of ours does the same with pictures and stamps.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{Bus, Message, Publisher, Qos, RosVersion, Subscription, WireType};
use ros::schema::MessageType;

use crate::cable::Cable;
use crate::daemon::Daemon;
use crate::layout::Layout;
use crate::site::{Running, Site};
use crate::world::{PEOPLE, SEER, Service};

/// What detects people in one ROS.
struct Detector {
    service: Service,
    package: &'static str,
    executable: &'static str,
    program: &'static str,
    argv: &'static [&'static str],
    /// The variable on which workspaces stand.
    workspaces: &'static str,
}

const DEBIANS: Detector = Detector {
    service: PEOPLE,
    package: "opencv_apps",
    executable: "people_detect",
    program: "/usr/lib/opencv_apps/people_detect",
    argv: &["__name:=people_detect", "_debug_view:=false"],
    workspaces: "CMAKE_PREFIX_PATH",
};

const OURS: Detector = Detector {
    service: SEER,
    package: "seer_ros2",
    executable: "people_detect",
    program: "/opt/cloudroid/install/lib/seer_ros2/people_detect",
    argv: &["--ros-args", "-r", "__node:=people_detect"],
    workspaces: "AMENT_PREFIX_PATH",
};

fn detector(version: RosVersion) -> &'static Detector {
    match version {
        RosVersion::One => &DEBIANS,
        RosVersion::Two => &OURS,
    }
}

/// The service that is people_detect in this ROS.
pub fn service(version: RosVersion) -> Service {
    detector(version).service
}

/// Starts the stub of a service that is people_detect, with the original installed on the robot; `settings` are lines
/// for `stub.toml`.
pub fn stub(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    (service, robot): (&str, &str),
    settings: &str,
    environment: &[(&str, &str)],
) -> anyhow::Result<Running> {
    let of = detector(site.system.version());
    let original = (of.package, of.executable);
    let workspace = site.installs_original(daemon, service, original, of.program)?;
    let workspace = workspace.to_string_lossy();
    let mut variables = vec![(of.workspaces, &*workspace), ("NO_COLOR", "1")];
    variables.extend(environment);
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nthreshold = 4.0\ninitial = 15.0\n\
         request = \"/image -> /people_detect/found\"\n{settings}\n",
        cable.server
    );
    site.stub_among(&variables, &toml, of.package, of.executable, of.argv)
}

/// The same with a stub as its archive comes.
pub fn installed_stub(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    (service, robot): (&str, &str),
    settings: &str,
) -> anyhow::Result<Running> {
    let of = detector(site.system.version());
    let settings = format!("robot = \"{robot}\"\n{settings}\n");
    let overlay = site.installs(daemon, service, &settings)?;
    let original = (of.package, of.executable);
    let workspace = site.installs_original(daemon, service, original, of.program)?;
    let server = format!("ws://{}", cable.server);
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let variables = [
        (of.workspaces, prefixes.as_str()),
        ("CLOUDROID_SERVER", server.as_str()),
        ("NO_COLOR", "1"),
    ];
    site.runs_among(&variables, &overlay, of.package, of.executable, of.argv)
}

/// Starts the original of ROS 1 alone.
pub fn original(site: &Site, daemon: &Daemon, service: &str) -> anyhow::Result<Running> {
    site.original(daemon, service, DEBIANS.program, DEBIANS.argv)
}

/// The robot's camera, and who listens to what was found.
pub struct Camera {
    // In the order in which they end.
    /// What people_detect says.
    pub found: Subscription,
    /// Pictures.
    pub image: Box<dyn Publisher>,
    /// Their node.
    pub node: Arc<dyn Bus>,
}

impl Camera {
    /// Before a node that was started, and that it waits for; so many pictures may wait for it.
    pub fn new(site: &Site, queue: usize) -> anyhow::Result<Self> {
        let node = site.joins("/camera")?;
        let found = site.hears(&node, "/people_detect/found")?;
        let of = image_type_of(site.system.version())?;
        let image = node.advertise("/image", of, Qos::keep_last(queue));
        let image = site.runtime.block_on(image)?;
        site.connected(&*image, 1)?;
        Ok(Self { found, image, node })
    }
}

/// Of `sensor_msgs/Image`.
pub fn image_type() -> WireType {
    WireType::new(
        "sensor_msgs/Image",
        "060021388200f6f0f447d0fcd9c64743",
        format!("{IMAGE}{HEADER}"),
    )
}

/// The same in either ROS.
pub fn image_type_of(version: RosVersion) -> anyhow::Result<WireType> {
    type_of(version, "sensor_msgs/Image", IMAGE)
}

/// A type whose first definition is `text`, and that contains a header and nothing else of others.
pub fn type_of(version: RosVersion, name: &str, text: &str) -> anyhow::Result<WireType> {
    let (name, header) = match version {
        RosVersion::One => (name.to_owned(), HEADER),
        RosVersion::Two => (name.replacen('/', "/msg/", 1), HEADER_TWO),
    };
    let of = MessageType::of_full_text(version, &name, &format!("{text}{header}"))?;
    Ok(WireType::of(&of))
}

/// A `sensor_msgs/Image` of ROS 1 in bgr8, stamped with its number.
pub fn picture(number: u32, size: (u32, u32), pixels: &[u8]) -> Bytes {
    picture_of(RosVersion::One, number, size, pixels)
}

/// The same of either ROS.
pub fn picture_of(
    version: RosVersion,
    number: u32,
    (width, height): (u32, u32),
    pixels: &[u8],
) -> Bytes {
    let mut out = Layout::of(version);
    out.header(number, "camera").u32(height).u32(width);
    out.text("bgr8").u8(0).u32(width * 3).bytes(pixels).finish()
}

/// The number of the picture that a message answers: of ROS 1 the stamp stands behind a number of four bytes, of ROS 2 behind
/// CDR's header of as many.
pub fn number(message: &Message) -> Option<u32> {
    let word = message.bytes.get(4..8)?.try_into().ok()?;
    Some(u32::from_le_bytes(word))
}

const IMAGE: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
    uint32 step\nuint8[] data\n";
const HEADER: &str = "\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n";
const HEADER_TWO: &str = "\
    ================================================================================\n\
    MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
