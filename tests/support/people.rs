//! A robot whose camera sends images to people_detect, wherever that runs: in the cloud behind a cable, or on the
//! robot. For ROS 1 it is Debian's node; for ROS 2 a package of ours does the same with images and stamps.

use std::sync::Arc;

use bytes::Bytes;
use ros::bus::{Bus, Publisher, QosProfile, RosVersion, SerializedMessage, Subscription, WireType};
use ros::schema::MessageType;

use crate::cable::Cable;
use crate::daemon::Daemon;
use crate::layout::MessageLayout;
use crate::site::{NodeProcess, Site};
use crate::world::{PEOPLE, SEER, StoryService};

/// The package that detects people in one version of ROS.
struct Detector {
    service: StoryService,
    package: &'static str,
    executable: &'static str,
    program: &'static str,
    argv: &'static [&'static str],
    /// Environment variable that lists workspaces.
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

/// Returns the service of people_detect for this version of ROS.
pub fn service(version: RosVersion) -> StoryService {
    detector(version).service
}

/// Starts the stub of a people_detect service, with the original installed on the robot; `settings` are lines of
/// `stub.toml`.
pub fn stub(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    (service, robot): (&str, &str),
    settings: &str,
    environment: &[(&str, &str)],
) -> anyhow::Result<NodeProcess> {
    let of = detector(site.system.version());
    let original = (of.package, of.executable);
    let workspace = site.install_original(daemon, service, original, of.program)?;
    let workspace = workspace.to_string_lossy();
    let mut variables = vec![(of.workspaces, &*workspace), ("NO_COLOR", "1")];
    variables.extend(environment);
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nthreshold = 4.0\ninitial = 15.0\n\
         request = \"/image -> /people_detect/found\"\n{settings}\n",
        cable.server
    );
    site.start_stub_with_environment(&variables, &toml, of.package, of.executable, of.argv)
}

/// Starts the stub installed from its archive.
pub fn installed_stub(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    (service, robot): (&str, &str),
    settings: &str,
) -> anyhow::Result<NodeProcess> {
    let of = detector(site.system.version());
    let settings = format!("robot = \"{robot}\"\n{settings}\n");
    let overlay = site.install_stub(daemon, service, &settings)?;
    let original = (of.package, of.executable);
    let workspace = site.install_original(daemon, service, original, of.program)?;
    let server = format!("ws://{}", cable.server);
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let variables = [(of.workspaces, prefixes.as_str()), ("CLOUDROID_SERVER", server.as_str()), ("NO_COLOR", "1")];
    site.start_installed_with_environment(&variables, &overlay, of.package, of.executable, of.argv)
}

/// Starts only the original, of ROS 1.
pub fn original(site: &Site, daemon: &Daemon, service: &str) -> anyhow::Result<NodeProcess> {
    site.start_original(daemon, service, DEBIANS.program, DEBIANS.argv)
}

/// The robot's camera, and the subscriber to the results.
pub struct PeopleCamera {
    // Fields are in the order in which they must be dropped.
    /// Results of people_detect.
    pub found: Subscription,
    /// Publisher of the images.
    pub image: Box<dyn Publisher>,
    /// Node of both.
    pub node: Arc<dyn Bus>,
}

impl PeopleCamera {
    /// Waits for a node that was started before; `queue` is the number of images that may be queued for it.
    pub fn new(site: &Site, queue: usize) -> anyhow::Result<Self> {
        let node = site.join("/camera")?;
        let found = site.subscribe(&node, "/people_detect/found")?;
        let of = image_type_of(site.system.version())?;
        let image = node.advertise("/image", of, QosProfile::keep_last(queue));
        let image = site.runtime.block_on(image)?;
        site.wait_for_subscribers(&*image, 1)?;
        Ok(Self { found, image, node })
    }
}

/// Returns the type `sensor_msgs/Image`.
pub fn image_type() -> WireType {
    WireType::new("sensor_msgs/Image", "060021388200f6f0f447d0fcd9c64743", format!("{IMAGE}{HEADER}"))
}

/// Returns the type `sensor_msgs/Image` for either version of ROS.
pub fn image_type_of(version: RosVersion) -> anyhow::Result<WireType> {
    type_of(version, "sensor_msgs/Image", IMAGE)
}

/// Returns a type with the definition `text`, which may contain a header and no other types.
pub fn type_of(version: RosVersion, name: &str, text: &str) -> anyhow::Result<WireType> {
    let (name, header) = match version {
        RosVersion::One => (name.to_owned(), HEADER),
        RosVersion::Two => (name.replacen('/', "/msg/", 1), HEADER_TWO),
    };
    let of = MessageType::parse_full_text(version, &name, &format!("{text}{header}"))?;
    Ok(WireType::from_message(&of))
}

/// Serializes a `sensor_msgs/Image` of ROS 1 in bgr8, whose stamp is its number.
pub fn picture(number: u32, size: (u32, u32), pixels: &[u8]) -> Bytes {
    picture_of(RosVersion::One, number, size, pixels)
}

/// Serializes a `sensor_msgs/Image` for either version of ROS.
pub fn picture_of(version: RosVersion, number: u32, (width, height): (u32, u32), pixels: &[u8]) -> Bytes {
    let mut out = MessageLayout::new(version);
    out.header(number, "camera").u32(height).u32(width);
    out.text("bgr8").u8(0).u32(width * 3).bytes(pixels).finish()
}

/// Returns the number of the image that a message answers: the stamp follows a sequence number of four bytes in ROS 1,
/// and the CDR header of four bytes in ROS 2.
pub fn number(message: &SerializedMessage) -> Option<u32> {
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
