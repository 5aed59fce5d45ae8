//! Width and height of serialized messages: taken from the integer fields of these names in the message or in a message
//! that it contains (images, point clouds, grids), or from the image itself if it is a JPEG or PNG file
//! (`sensor_msgs/CompressedImage`).

use crate::RosVersion;
use crate::codec::cursor::MessageCursor;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// Maximum number of steps to the fields; types that need more are ignored.
const MOST_STEPS: usize = 256;
/// Maximum number of strings and segments scanned in one message.
const MOST_PARTS: usize = 1024;
/// Values from here on are not accepted as a size.
const LARGEST: u64 = 1 << 31;

/// Steps to the width and height in messages of one type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Extent {
    version: RosVersion,
    steps: Vec<ExtentStep>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ExtentStep {
    /// (count, size, alignment): fixed number of items, aligned where numbers are.
    Items(usize, usize, usize),
    /// (size, alignment): items preceded by their count.
    CountedItems(usize, usize),
    /// (count, wide): length-prefixed strings.
    Strings(usize, bool),
    /// (wide): strings preceded by their count.
    CountedStrings(bool),
    Width(Primitive),
    Height(Primitive),
    /// A JPEG or PNG file preceded by its length.
    File,
}

impl Extent {
    /// Compiles the steps for messages of this type; `None` if it has no width and height.
    pub fn for_type(message: &MessageType) -> Option<Extent> {
        let mut steps = Vec::new();
        let file = matches!(message.name(), "sensor_msgs/CompressedImage" | "sensor_msgs/msg/CompressedImage");
        let found = if file {
            push_file_steps(message, &mut steps)
        } else if has_sides(message) {
            push_side_steps(message, &mut steps)
        } else {
            push_nested_steps(message, &mut steps)
        };
        found.map(|()| Extent { version: message.version(), steps })
    }

    /// Returns width and height of a message; `None` if it has none.
    pub fn find(&self, message: &[u8]) -> Option<(u64, u64)> {
        let mut walk = Walk { cursor: MessageCursor::new(self.version, message)?, parts: 0 };
        let (mut width, mut height) = (None, None);
        for step in &self.steps {
            match *step {
                ExtentStep::Items(count, size, alignment) => {
                    walk.cursor.skip(count, size, alignment)?;
                }
                ExtentStep::CountedItems(size, alignment) => {
                    let count = walk.cursor.length()?;
                    walk.cursor.skip(count, size, alignment)?;
                }
                ExtentStep::Strings(count, wide) => walk.skip_strings(count, wide)?,
                ExtentStep::CountedStrings(wide) => {
                    let count = walk.cursor.length()?;
                    walk.skip_strings(count, wide)?;
                }
                ExtentStep::Width(primitive) => width = Some(walk.read_side(primitive)?),
                ExtentStep::Height(primitive) => height = Some(walk.read_side(primitive)?),
                ExtentStep::File => {
                    let bytes = walk.cursor.length()?;
                    return image_file_size(walk.cursor.take(bytes, 1)?);
                }
            }
        }
        let sane = |side: &u64| (1..LARGEST).contains(side);
        Some((width.filter(sane)?, height.filter(sane)?))
    }
}

fn side_field(field: &Field) -> Option<(&str, Primitive)> {
    use Primitive::{Int8, Int16, Int32, Int64, Uint8, Uint16, Uint32, Uint64};
    match (&field.base, field.arity) {
        (Base::Primitive(primitive), Arity::One) => {
            let whole = [Int8, Int16, Int32, Int64, Uint8, Uint16, Uint32, Uint64];
            let is_side = matches!(&*field.name, "width" | "height") && whole.contains(primitive);
            is_side.then_some((&*field.name, *primitive))
        }
        _ => None,
    }
}

fn has_sides(message: &MessageType) -> bool {
    let sides = message.fields().iter().filter_map(side_field);
    sides.count() == 2
}

/// Pushes the steps up to the second of the two fields.
fn push_side_steps(message: &MessageType, steps: &mut Vec<ExtentStep>) -> Option<()> {
    let mut left = 2;
    for field in message.fields() {
        match side_field(field) {
            Some(("width", primitive)) => steps.push(ExtentStep::Width(primitive)),
            Some((_, primitive)) => steps.push(ExtentStep::Height(primitive)),
            None => {
                push_skip_steps(field, steps)?;
                continue;
            }
        }
        left -= 1;
        if left == 0 {
            return Some(());
        }
    }
    None
}

/// Pushes the steps to the first contained message that has both fields, such as a grid's `info`.
fn push_nested_steps(message: &MessageType, steps: &mut Vec<ExtentStep>) -> Option<()> {
    for field in message.fields() {
        match (&field.base, field.arity) {
            (Base::Message(inner), Arity::One) if has_sides(inner) => {
                return push_side_steps(inner, steps);
            }
            _ => push_skip_steps(field, steps)?,
        }
    }
    None
}

fn push_file_steps(message: &MessageType, steps: &mut Vec<ExtentStep>) -> Option<()> {
    for field in message.fields() {
        let bytes = matches!(field.base, Base::Primitive(Primitive::Uint8));
        if field.name == "data" && bytes && field.arity == Arity::Variable {
            steps.push(ExtentStep::File);
            return Some(());
        }
        push_skip_steps(field, steps)?;
    }
    None
}

/// Pushes the steps that skip a field; `None` if there are too many.
fn push_skip_steps(field: &Field, steps: &mut Vec<ExtentStep>) -> Option<()> {
    let times = match field.arity {
        Arity::One => Some(1),
        Arity::Fixed(count) => Some(count as usize),
        Arity::Variable => None,
    };
    let message = match &field.base {
        Base::Message(message) => message,
        Base::Primitive(primitive) => {
            let (size, wide) = (primitive.size(), *primitive == Primitive::Wstring);
            let is_text = wide || *primitive == Primitive::String;
            // Times of ROS 1 are not aligned.
            steps.push(match (is_text, times) {
                (false, Some(times)) => ExtentStep::Items(times, size, size),
                (false, None) => ExtentStep::CountedItems(size, size),
                (true, Some(times)) => ExtentStep::Strings(times, wide),
                (true, None) => ExtentStep::CountedStrings(wide),
            });
            return (steps.len() <= MOST_STEPS).then_some(());
        }
    };
    let one_size = match message.plan.scalar {
        Some(scalar) => Some((scalar.size(), scalar.alignment())),
        None => {
            let packed = message.version() == RosVersion::One && message.is_fixed_size();
            packed.then(|| (message.min_size(), 1))
        }
    };
    match (one_size, times) {
        (Some((size, alignment)), Some(times)) => steps.push(ExtentStep::Items(times, size, alignment)),
        (Some((size, alignment)), None) => steps.push(ExtentStep::CountedItems(size, alignment)),
        (None, Some(1)) => {
            for field in message.fields() {
                push_skip_steps(field, steps)?;
            }
            if message.plan.placeholder {
                steps.push(ExtentStep::Items(1, 1, 1));
            }
        }
        // Messages in an array may differ in size.
        (None, _) => return None,
    }
    (steps.len() <= MOST_STEPS).then_some(())
}

struct Walk<'a> {
    cursor: MessageCursor<'a>,
    parts: usize,
}

impl Walk<'_> {
    fn skip_strings(&mut self, count: usize, wide: bool) -> Option<()> {
        for _ in 0..count {
            self.parts += 1;
            if self.parts > MOST_PARTS {
                return None;
            }
            self.cursor.string(wide)?;
        }
        Some(())
    }

    /// Reads an integer. Negative values become larger than any valid size.
    fn read_side(&mut self, primitive: Primitive) -> Option<u64> {
        let size = primitive.size();
        let bytes = self.cursor.take(size, size)?;
        let mut all = [0; 8];
        all.get_mut(..size)?.copy_from_slice(bytes);
        if self.cursor.is_big_endian() {
            all[..size].reverse();
        }
        let number = u64::from_le_bytes(all);
        let below_zero = match primitive {
            Primitive::Int8 => number > i8::MAX as u64,
            Primitive::Int16 => number > i16::MAX as u64,
            _ => false,
        };
        Some(if below_zero { u64::MAX } else { number })
    }
}

/// Returns width and height of a PNG (from `IHDR`; ISO/IEC 15948, 11.2.2) or a JPEG (from its frame header; ITU-T T.81,
/// B.2.2).
fn image_file_size(file: &[u8]) -> Option<(u64, u64)> {
    let word = |at: usize, bytes: usize| -> Option<u64> {
        let end = at.checked_add(bytes)?;
        let number = file.get(at..end)?.iter();
        Some(number.fold(0, |number, byte| number << 8 | u64::from(*byte)))
    };
    let (width, height) = if file.starts_with(b"\x89PNG\r\n\x1a\n") {
        (word(16, 4)?, word(20, 4)?)
    } else if file.starts_with(&[0xff, 0xd8]) {
        let mut at = 2;
        let mut segments = 0;
        loop {
            segments += 1;
            if word(at, 1)? != 0xff || segments > MOST_PARTS {
                return None;
            }
            match word(at + 1, 1)? {
                // Fill bytes.
                0xff => at += 1,
                // Frame headers (SOF); DHT, JPG and DAC in between are other segments.
                0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                    break (word(at + 7, 2)?, word(at + 5, 2)?);
                }
                // The image begins or ends before any frame header.
                0xd9 | 0xda => return None,
                // Segments without a length.
                0x01 | 0xd0..=0xd8 => at += 2,
                _ => at += 2 + usize::try_from(word(at + 2, 2)?).ok()?.max(2),
            }
        }
    } else {
        return None;
    };
    let sane = |side: u64| (1..LARGEST).contains(&side);
    (sane(width) && sane(height)).then_some((width, height))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::codec::from_json;
    use crate::schema::Registry;

    #[test]
    fn messages_of_ros_2_say_it_too() {
        let registry = Registry::for_version(RosVersion::Two);
        for (key, text) in [
            ("a/Picture", "std_msgs/Header header\nwstring more\nuint16 height\nint64 width\nuint8[] data"),
            ("a/Info", "builtin_interfaces/Time load\nfloat32 resolution\nuint32 width\nuint32 height"),
            ("a/Grid", "std_msgs/Header header\nEmpty[2] none\nuint8 odd\nInfo info\nint8[] data"),
            ("a/Plain", "std_msgs/Header header\nEmpty none\nfloat64[] skipped\nInfo info"),
            ("a/Empty", ""),
            ("sensor_msgs/CompressedImage", "std_msgs/Header header\nstring format\nuint8[] data"),
        ] {
            registry.insert(key, text).unwrap();
        }
        let find = |name: &str, json: &str| {
            let message = registry.message(name).unwrap();
            let mut bytes = Vec::new();
            from_json(&message, json.as_bytes(), &mut bytes, &Default::default()).unwrap();
            Extent::for_type(&message)?.find(&bytes)
        };
        let picture = r#"{"header": {"frame_id": "abc"}, "more": "é", "height": 48, "width": 64}"#;
        assert_eq!(find("a/Picture", picture), Some((64, 48)));
        let info = r#""info": {"width": 7, "height": 9}"#;
        let plain = format!(r#"{{"header": {{"frame_id": "ab"}}, "skipped": [1, 2], {info}}}"#);
        assert_eq!(find("a/Plain", &plain), Some((7, 9)));
        // Fields beyond an array of messages are not found.
        assert_eq!(find("a/Grid", &format!("{{{info}}}")), None);
        let png = "iVBORw0KGgoAAAANSUhEUgAAAAUAAAAG";
        let compressed = format!(r#"{{"format": "png", "data": "{png}"}}"#);
        assert_eq!(find("sensor_msgs/CompressedImage", &compressed), Some((5, 6)));
        // Big endian.
        let info = registry.message("a/Info").unwrap();
        let bytes = [0u32, 1, 2, 3, 640, 480].map(u32::to_be_bytes).concat();
        assert_eq!(Extent::for_type(&info).unwrap().find(&bytes), Some((640, 480)));
    }

    const HEADER: &str = "uint32 seq\ntime stamp\nstring frame_id";
    const DEFINITIONS: [(&str, &str); 9] = [
        ("std_msgs/Header", HEADER),
        (
            "sensor_msgs/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] \
             data",
        ),
        ("sensor_msgs/CompressedImage", "Header header\nstring format\nuint8[] data"),
        ("nav_msgs/MapMetaData", "time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height"),
        ("nav_msgs/OccupancyGrid", "Header header\nMapMetaData info\nint8[] data"),
        ("a/Float", "float32 width\nfloat32 height"),
        ("a/One", "uint32 width"),
        ("a/Late", "string[2] names\nstring[] more\nint64[] numbers\nint8 width\nint64 height"),
        ("a/Listed", "Float[] all\nOne[3] some\nText[] texts\nuint8 width\nuint8 height"),
    ];

    fn extent(name: &str) -> Option<Extent> {
        let registry = Registry::new();
        for (key, text) in DEFINITIONS {
            registry.insert(key, text).expect("valid");
        }
        registry.insert("a/Text", "string text").expect("valid");
        Extent::for_type(&registry.message(name).expect("known"))
    }

    fn text(text: &str) -> Vec<u8> {
        let mut bytes = (text.len() as u32).to_le_bytes().to_vec();
        bytes.extend(text.as_bytes());
        bytes
    }

    fn header() -> Vec<u8> {
        [vec![1; 12], text("camera")].concat()
    }

    fn numbers(numbers: &[u32]) -> Vec<u8> {
        numbers.iter().flat_map(|n| n.to_le_bytes()).collect()
    }

    fn compressed_image(file: &[u8]) -> Vec<u8> {
        let bytes = numbers(&[file.len() as u32]);
        [header(), text("jpeg"), bytes, file.to_vec()].concat()
    }

    #[test]
    fn types_that_say_it_are_found_and_others_are_not() {
        for name in ["a/Float", "a/One", "a/Listed", "std_msgs/Header"] {
            assert_eq!(extent(name), None, "{name}");
        }
        let image = [header(), numbers(&[480, 640])].concat();
        let grid = [header(), vec![0; 12], numbers(&[30, 20])].concat();
        let late = [
            text("a"),
            text("bc"),
            numbers(&[1]),
            text("d"),
            numbers(&[1, 9, 9]),
            vec![7],
            8i64.to_le_bytes().to_vec(),
        ]
        .concat();
        let png = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\x02\x80\0\0\x01\xe0\x08\x02".as_slice();
        let jpeg = [
            b"\xff\xd8\xff\xe0\0\x04ab\xff\xff\xdb\0\x02".as_slice(),
            b"\xff\xc4\0\x03x\xff\xc2\0\x0b\x08\x01\xe0\x02\x80\x03",
        ]
        .concat();
        for (name, message, found) in [
            ("sensor_msgs/Image", image, (640, 480)),
            ("nav_msgs/OccupancyGrid", grid, (30, 20)),
            ("a/Late", late, (7, 8)),
            ("sensor_msgs/CompressedImage", compressed_image(png), (640, 480)),
            ("sensor_msgs/CompressedImage", compressed_image(&jpeg), (640, 480)),
        ] {
            let extent = extent(name).expect(name);
            assert_eq!(extent.find(&message), Some(found), "{name}");
            for end in 0..message.len() - 3 {
                assert_eq!(extent.find(&message[..end]), None, "{name} {end}");
            }
        }
    }

    #[test]
    fn what_is_no_size_is_none() {
        let image = extent("sensor_msgs/Image").expect("it says it");
        for (height, width) in [(0, 640), (480, 0), (u32::MAX, 640)] {
            let message = [header(), numbers(&[height, width])].concat();
            assert_eq!(image.find(&message), None, "{width} {height}");
        }
        let late = extent("a/Late").expect("it says it");
        let message = |width: u8, height: i64| {
            let strings = [text(""), text(""), numbers(&[0]), numbers(&[0])].concat();
            [strings, vec![width], height.to_le_bytes().to_vec()].concat()
        };
        assert_eq!(late.find(&message(127, 1)), Some((127, 1)));
        assert_eq!(late.find(&message(128, 1)), None, "below zero");
        assert_eq!(late.find(&message(1, -1)), None);
        // More strings than are scanned.
        let many = [text(""), text(""), numbers(&[1 << 20]), vec![0; 4 << 20]].concat();
        assert_eq!(late.find(&many), None);
        let file = extent("sensor_msgs/CompressedImage").expect("it says it");
        for bytes in [
            b"".as_slice(),
            b"GIF89a",
            b"\xff\xd8\xff\xda\0\x02",
            b"\xff\xd8\xff\xe0\0\0\xff",
            b"\xff\xd8xx",
            &[0xff; 9000],
        ] {
            assert_eq!(file.find(&compressed_image(bytes)), None, "{bytes:?}");
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_borne(bytes in prop::collection::vec(any::<u8>(), 0..200), jpeg in any::<bool>()) {
            let mut file = if jpeg { vec![0xff, 0xd8, 0xff] } else { Vec::new() };
            file.extend(&bytes);
            for name in ["sensor_msgs/Image", "a/Late", "sensor_msgs/CompressedImage"] {
                let extent = extent(name).expect(name);
                let _ = extent.find(&bytes);
                let _ = extent.find(&compressed_image(&file));
            }
        }
    }
}
