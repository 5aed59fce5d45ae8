//! How fast messages turn into JSON and CBOR and back, beside a plain copy and beside `serde_json::Value`.
//!
//!     cargo run --release -p ros --example codec_speed [PART OF A TITLE]
//!
//! MB/s count the serialized ROS message, whichever way it goes; the fastest of several rounds counts, since
//! everything else on the machine only ever adds.

use std::hint::black_box;
use std::time::{Duration, Instant};

use base64::Engine as _;
use ros::codec::{self, CborOptions, FillOptions, JsonOptions};
use ros::schema::{MessageType, Registry};
use serde_json::{Value, json};

const ROUND: Duration = Duration::from_millis(60);
const ROUNDS: usize = 12;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let only = std::env::args().nth(1);
    let registry = definitions()?;
    println!("{:<44} {:>10} {:>10} {:>9}", "", "ns", "MB/s", "of memcpy");
    for (title, name, bytes) in [
        ("Image 640x480 rgb8", "sensor_msgs/Image", image()),
        ("LaserScan 1080 ranges", "sensor_msgs/LaserScan", scan()),
        ("Path of 500 poses", "nav_msgs/Path", path()),
        ("Twist", "geometry_msgs/Twist", twist()),
        ("String of 20", "std_msgs/String", string()),
    ] {
        if only.as_ref().is_some_and(|only| !title.contains(only)) {
            continue;
        }
        measure(title, &*registry.message(name)?, &bytes)?;
    }
    let image = image();
    println!("\nserde_json::Value and the base64 crate, the plain way");
    let floor = time(&mut || copy(&image, &mut Vec::with_capacity(image.len())));
    let frame = plain_out(&image);
    report(
        "Image 640x480 rgb8, JSON out",
        image.len(),
        floor,
        time(&mut || drop(black_box(plain_out(&image)))),
    );
    report(
        "Image 640x480 rgb8, JSON in",
        image.len(),
        floor,
        time(&mut || drop(black_box(plain_in(&frame)))),
    );
    Ok(())
}

fn measure(title: &str, message: &MessageType, bytes: &[u8]) -> Result<(), codec::CodecError> {
    let (to, fill) = (JsonOptions::default(), FillOptions::default());
    let (mut json, mut cbor) = (Vec::new(), Vec::new());
    codec::to_json(message, bytes, &mut json, &to)?;
    codec::to_cbor(message, bytes, &mut cbor, &CborOptions::default())?;
    // As Python's json.dumps writes it.
    let spaced = spaced(&json);
    let mut out = Vec::with_capacity(json.len().max(bytes.len()) + 1024);

    println!(
        "\n{title}: {} bytes of ROS, {} of JSON, {} of CBOR",
        bytes.len(),
        json.len(),
        cbor.len()
    );
    let floor = time(&mut || copy(bytes, &mut out));
    report("memcpy", bytes.len(), floor, floor);
    let mut case = |what: &str, convert: &dyn Fn(&mut Vec<u8>) -> Result<(), codec::CodecError>| {
        let took = time(&mut || {
            out.clear();
            black_box(convert(black_box(&mut out)))
                .unwrap_or_else(|error| panic!("{what}: {error}"));
        });
        report(what, bytes.len(), floor, took);
    };
    case("JSON out", &|out| {
        codec::to_json(message, black_box(bytes), out, &to)
    });
    case("JSON out, into a new buffer", &|_| {
        codec::to_json(message, black_box(bytes), &mut Vec::new(), &to)
    });
    case("JSON in", &|out| {
        codec::from_json(message, black_box(&json), out, &fill)
    });
    case("JSON in, spaced", &|out| {
        codec::from_json(message, black_box(&spaced), out, &fill)
    });
    case("CBOR out", &|out| {
        codec::to_cbor(message, black_box(bytes), out, &CborOptions::default())
    });
    case("CBOR in", &|out| {
        codec::from_cbor(message, black_box(&cbor), out, &fill)
    });
    case("validate", &|_| codec::validate(message, black_box(bytes)));
    case("JSON value's end", &|_| {
        codec::json_value_len(black_box(&json)).map(drop)
    });
    Ok(())
}

fn copy(bytes: &[u8], out: &mut Vec<u8>) {
    out.clear();
    out.extend_from_slice(black_box(bytes));
    black_box(out);
}

/// Nanoseconds of one run, in the fastest round.
fn time(run: &mut dyn FnMut()) -> f64 {
    let mut fastest = f64::INFINITY;
    for _ in 0..ROUNDS {
        let start = Instant::now();
        let mut runs = 0;
        while start.elapsed() < ROUND / 4 || runs == 0 {
            // Reading the clock costs as much as a small message.
            for _ in 0..16 {
                run();
            }
            runs += 16;
        }
        fastest = fastest.min(start.elapsed().as_nanos() as f64 / f64::from(runs));
    }
    fastest
}

fn report(what: &str, size: usize, floor: f64, took: f64) {
    println!(
        "  {what:<42} {took:>10.0} {:>10.0} {:>8.0}%",
        size as f64 / took * 1e3,
        floor / took * 100.0
    );
}

fn spaced(json: &[u8]) -> Vec<u8> {
    let mut out = Vec::with_capacity(json.len() * 2);
    let mut quoted = false;
    for &byte in json {
        out.push(byte);
        quoted ^= byte == b'"';
        if !quoted && matches!(byte, b',' | b':') {
            out.push(b' ');
        }
    }
    out
}

fn plain_out(bytes: &[u8]) -> Vec<u8> {
    let word =
        |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let frame = 16 + word(12) as usize;
    let encoding = frame + 12 + word(frame + 8) as usize;
    let data = base64::engine::general_purpose::STANDARD.encode(&bytes[encoding + 9..]);
    let value = json!({
        "header": {
            "seq": word(0),
            "stamp": {"secs": word(4), "nsecs": word(8)},
            "frame_id": String::from_utf8_lossy(&bytes[16..frame]),
        },
        "height": word(frame),
        "width": word(frame + 4),
        "encoding": String::from_utf8_lossy(&bytes[frame + 12..encoding]),
        "is_bigendian": bytes[encoding],
        "step": word(encoding + 1),
        "data": data,
    });
    serde_json::to_vec(&value).unwrap_or_default()
}

fn plain_in(json: &[u8]) -> Vec<u8> {
    let value: Value = serde_json::from_slice(json).unwrap_or_default();
    let data = value["data"].as_str().unwrap_or_default();
    let data = base64::engine::general_purpose::STANDARD
        .decode(data)
        .unwrap_or_default();
    let mut out = Vec::with_capacity(data.len() + 100);
    for word in [
        &value["header"]["seq"],
        &value["height"],
        &value["width"],
        &value["step"],
    ] {
        out.extend_from_slice(&(word.as_u64().unwrap_or_default() as u32).to_le_bytes());
    }
    out.extend_from_slice(&data);
    out
}

fn definitions() -> Result<Registry, ros::schema::SchemaError> {
    let registry = Registry::new();
    for (key, text) in [
        ("std_msgs/msg/String", "string data"),
        (
            "geometry_msgs/msg/Vector3",
            "float64 x\nfloat64 y\nfloat64 z",
        ),
        ("geometry_msgs/msg/Twist", "Vector3 linear\nVector3 angular"),
        ("geometry_msgs/msg/Point", "float64 x\nfloat64 y\nfloat64 z"),
        (
            "geometry_msgs/msg/Quaternion",
            "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        ),
        (
            "geometry_msgs/msg/Pose",
            "Point position\nQuaternion orientation",
        ),
        ("geometry_msgs/msg/PoseStamped", "Header header\nPose pose"),
        (
            "nav_msgs/msg/Path",
            "Header header\ngeometry_msgs/PoseStamped[] poses",
        ),
        (
            "sensor_msgs/msg/LaserScan",
            "Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\nfloat32 time_increment\n\
             float32 scan_time\nfloat32 range_min\nfloat32 range_max\nfloat32[] ranges\nfloat32[] intensities",
        ),
        (
            "sensor_msgs/msg/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        ),
    ] {
        registry.insert(key, text)?;
    }
    Ok(registry)
}

fn header() -> Vec<u8> {
    let mut out = Vec::new();
    for word in [7u32, 1_700_000_000, 123_456_789] {
        out.extend_from_slice(&word.to_le_bytes());
    }
    put_text(&mut out, "camera_link");
    out
}

fn put_text(out: &mut Vec<u8>, text: &str) {
    out.extend_from_slice(&(text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

fn image() -> Vec<u8> {
    let mut out = header();
    out.extend_from_slice(&480u32.to_le_bytes());
    out.extend_from_slice(&640u32.to_le_bytes());
    put_text(&mut out, "rgb8");
    out.push(0);
    out.extend_from_slice(&1920u32.to_le_bytes());
    out.extend_from_slice(&921_600u32.to_le_bytes());
    // Pixels of no pattern that a cache or a predictor could learn.
    let mut state = 1u32;
    out.extend(
        std::iter::repeat_with(|| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        })
        .take(921_600),
    );
    out
}

fn scan() -> Vec<u8> {
    let mut out = header();
    for value in [-2.35619f32, 2.35619, 0.00436, 0.0000173, 0.025, 0.02, 30.0] {
        out.extend_from_slice(&value.to_le_bytes());
    }
    out.extend_from_slice(&1080u32.to_le_bytes());
    for index in 0..1080 {
        let range = 5.0 + (index as f32 * 0.37).sin() * 4.3;
        out.extend_from_slice(&range.to_le_bytes());
    }
    out.extend_from_slice(&0u32.to_le_bytes());
    out
}

fn path() -> Vec<u8> {
    let mut out = header();
    out.extend_from_slice(&500u32.to_le_bytes());
    for index in 0..500 {
        out.extend_from_slice(&header());
        let turn = f64::from(index) * 0.013;
        for value in [
            turn * 3.7,
            turn.sin() * 10.0,
            0.0,
            0.0,
            0.0,
            (turn / 2.0).sin(),
            (turn / 2.0).cos(),
        ] {
            out.extend_from_slice(&value.to_le_bytes());
        }
    }
    out
}

fn twist() -> Vec<u8> {
    [0.5f64, 0.0, 0.0, 0.0, 0.0, -0.123_456_789]
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

fn string() -> Vec<u8> {
    let mut out = Vec::new();
    put_text(&mut out, "hello, cloud servant");
    out
}
