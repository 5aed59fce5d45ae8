//! A robot whose camera asks people_detect, wherever that runs: in the cloud behind a cable, or on the robot.

use std::sync::Arc;

use bytes::{BufMut, Bytes, BytesMut};
use ros::bus::{Bus, Message, Publisher, Qos, Subscription, WireType};
use ros::ros1::Ros1Bus;

use crate::cable::Cable;
use crate::daemon::Daemon;
use crate::site::{Running, Site};

/// Package and executable.
const PEOPLE: (&str, &str) = ("opencv_apps", "people_detect");
const PROGRAM: &str = "/usr/lib/opencv_apps/people_detect";
const ARGUMENTS: [&str; 2] = ["__name:=people_detect", "_debug_view:=false"];

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
    let workspace = site.installs_original(daemon, service, PEOPLE, PROGRAM)?;
    let workspace = workspace.to_string_lossy();
    let mut variables = vec![("CMAKE_PREFIX_PATH", &*workspace), ("NO_COLOR", "1")];
    variables.extend(environment);
    let toml = format!(
        "server = \"ws://{}\"\nservice = \"{service}\"\nrobot = \"{robot}\"\nthreshold = 4.0\ninitial = 15.0\n{settings}\n",
        cable.server
    );
    site.stub_among(&variables, &toml, PEOPLE.0, PEOPLE.1, &ARGUMENTS)
}

/// The same with a stub as its archive comes.
pub fn installed_stub(
    site: &Site,
    daemon: &Daemon,
    cable: &Cable,
    (service, robot): (&str, &str),
    settings: &str,
) -> anyhow::Result<Running> {
    let settings = format!("robot = \"{robot}\"\n{settings}\n");
    let overlay = site.installs(daemon, service, &settings)?;
    let workspace = site.installs_original(daemon, service, PEOPLE, PROGRAM)?;
    let server = format!("ws://{}", cable.server);
    let prefixes = format!("{}:{}", overlay.display(), workspace.display());
    let variables = [
        ("CMAKE_PREFIX_PATH", prefixes.as_str()),
        ("CLOUDROID_SERVER", server.as_str()),
        ("NO_COLOR", "1"),
    ];
    site.runs_among(&variables, &overlay, PEOPLE.0, PEOPLE.1, &ARGUMENTS)
}

/// Starts the original alone.
pub fn original(site: &Site, daemon: &Daemon, service: &str) -> anyhow::Result<Running> {
    site.original(daemon, service, PROGRAM, &ARGUMENTS)
}

/// The robot's camera, and who listens to what was found.
pub struct Camera {
    // In the order in which they end.
    /// What people_detect says.
    pub found: Subscription,
    /// Pictures.
    pub image: Box<dyn Publisher>,
    /// Their node.
    pub node: Arc<Ros1Bus>,
}

impl Camera {
    /// Before a node that was started, and that it waits for; so many pictures may wait for it.
    pub fn new(site: &Site, queue: usize) -> anyhow::Result<Self> {
        let node = site.node("/camera")?;
        let found = site.hears(&node, "/people_detect/found")?;
        let image = node.advertise("/image", image_type(), Qos::keep_last(queue));
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
        IMAGE,
    )
}

/// A `sensor_msgs/Image` in bgr8, stamped with its number.
pub fn picture(number: u32, (width, height): (u32, u32), pixels: &[u8]) -> Bytes {
    let mut out = BytesMut::with_capacity(pixels.len() + 64);
    let text = |out: &mut BytesMut, text: &str| {
        out.put_u32_le(text.len() as u32);
        out.put_slice(text.as_bytes());
    };
    for word in [number, number, 0] {
        out.put_u32_le(word);
    }
    text(&mut out, "camera");
    out.put_u32_le(height);
    out.put_u32_le(width);
    text(&mut out, "bgr8");
    out.put_u8(0);
    out.put_u32_le(width * 3);
    out.put_u32_le(pixels.len() as u32);
    out.put_slice(pixels);
    out.freeze()
}

/// The number of the picture that a message answers.
pub fn number(message: &Message) -> Option<u32> {
    let word = message.bytes.get(4..8)?.try_into().ok()?;
    Some(u32::from_le_bytes(word))
}

const IMAGE: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n\
    uint32 step\nuint8[] data\n\
    ================================================================================\n\
    MSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n";
