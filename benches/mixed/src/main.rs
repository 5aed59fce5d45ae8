//! `make bench ONLY=mixed`: what it costs that a robot's ROS is not its service's, beside a copy of the same message.
//! Arguments name the parts to run.

use std::hint::black_box;
use std::sync::Arc;

use anyhow::Result;
use bench_report::{BenchReport, Part, Race, Target, is_full_run, run_parts};
use bytes::Bytes;
use ros::bus::RosVersion;
use ros::codec::{FillOptions, from_json};
use ros::schema::Registry;
use translation::{MessageTwin, TranslationRules, TypeTranslations};

/// All parts, in the order in which they are measured.
const PARTS: [Part; 3] = [("small", measure_small), ("picture", measure_picture), ("path", measure_path)];

/// Definitions of ROS 1.
const DEFINITIONS: [(&str, &str); 9] = [
    ("geometry_msgs/Vector3", "float64 x\nfloat64 y\nfloat64 z"),
    ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
    ("geometry_msgs/Quaternion", "float64 x\nfloat64 y\nfloat64 z\nfloat64 w"),
    ("geometry_msgs/Pose", "Point position\nQuaternion orientation"),
    ("geometry_msgs/PoseStamped", "Header header\nPose pose"),
    ("geometry_msgs/Twist", "Vector3 linear\nVector3 angular"),
    ("geometry_msgs/TwistStamped", "Header header\nTwist twist"),
    ("nav_msgs/Path", "Header header\ngeometry_msgs/PoseStamped[] poses"),
    (
        "sensor_msgs/Image",
        "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
    ),
];

fn main() -> Result<()> {
    run_parts("mixed", &PARTS)
}

/// Returns a type of ROS 1 with its twin.
fn find_twin(name: &str) -> Result<Arc<MessageTwin>> {
    let registry = Registry::for_version(RosVersion::One);
    for (key, text) in DEFINITIONS {
        registry.insert(key, text)?;
    }
    Ok(TypeTranslations::new(TranslationRules::default()).message(&registry.message(name)?)?)
}

/// Returns the message of ROS 1 that this JSON describes.
fn serialize(pair: &MessageTwin, json: &str) -> Result<Bytes> {
    let mut bytes = Vec::new();
    from_json(&pair.original, json.as_bytes(), &mut bytes, &FillOptions::default())?;
    Ok(bytes.into())
}

/// Carries a message both ways, `repeats` times for each measured time.
fn measure(
    report: &mut BenchReport,
    name: &str,
    pair: &MessageTwin,
    one: &Bytes,
    repeats: usize,
    target: impl Fn(f64) -> Target,
) -> Result<()> {
    let two = pair.to_twin.translate(one)?;
    anyhow::ensure!(pair.from_twin.translate(&two)? == one, "{name} does not come back as it was");
    let rounds = if is_full_run() { 2000 } else { 200 };
    for (way, translator, message) in [("1 to 2", &pair.to_twin, one), ("2 to 1", &pair.from_twin, &two)] {
        let mut race = Race::new(rounds);
        race.add("carried", || {
            for _ in 0..repeats {
                black_box(translator.translate(black_box(message)).ok());
            }
        });
        race.add("copied", || {
            for _ in 0..repeats {
                black_box(Bytes::copy_from_slice(black_box(message)));
            }
        });
        let times = race.run();
        let micros = |index: usize| times[index].best_micros() / repeats as f64;
        let figure = report.figure(format!("{name}, {} bytes, {way}", message.len()), "µs", micros(0));
        figure.relative_to("a copy", micros(1)).require(target(micros(1)));
    }
    Ok(())
}

fn measure_small(report: &mut BenchReport) -> Result<()> {
    let pair = find_twin("geometry_msgs/TwistStamped")?;
    let json = r#"{"header": {"frame_id": "base_link"}, "twist": {"linear": {"x": 0.5}, "angular": {"z": 0.1}}}"#;
    // A hundredth of the 20 µs by which a message through the bus may take longer.
    measure(report, "a command", &pair, &serialize(&pair, json)?, 1000, |copy| Target::AtMost(copy + 0.2))
}

fn measure_picture(report: &mut BenchReport) -> Result<()> {
    let pair = find_twin("sensor_msgs/Image")?;
    let json = r#"{"header": {"frame_id": "camera"}, "height": 480, "width": 640, "encoding": "rgb8", "step": 1920}"#;
    let empty = serialize(&pair, json)?;
    let data: Vec<u8> = (0..640 * 480 * 3u32).map(|index| ((index * 7) >> 3) as u8).collect();
    // The length of the data is the last value of the empty message.
    let (head, _) = empty.split_at(empty.len() - 4);
    let picture = [head, &(data.len() as u32).to_le_bytes(), &data].concat();
    measure(report, "a picture", &pair, &picture.into(), 4, |_| Target::RatioAtMost(1.1))
}

fn measure_path(report: &mut BenchReport) -> Result<()> {
    let pair = find_twin("nav_msgs/Path")?;
    let pose = r#"{"header": {"frame_id": "map"}, "pose": {"position": {"x": 1.5}, "orientation": {"w": 1}}}"#;
    let json = format!(r#"{{"poses": [{}]}}"#, vec![pose; 1000].join(","));
    measure(report, "a path of 1000 poses", &pair, &serialize(&pair, &json)?, 4, |_| Target::AtMost(200.0))
}
