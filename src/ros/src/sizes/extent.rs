//! Width and height of serialized messages: from the whole numbers of these names that a message or one in it has (pictures,
//! clouds, grids), and from the picture itself where that is a JPEG or PNG file (`sensor_msgs/CompressedImage`).

use crate::bus::RosVersion;
use crate::codec::cursor::Cursor;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// Steps to the numbers; types with more before them are not looked at.
const MOST_STEPS: usize = 256;
/// Strings and segments that are walked through in one message.
const MOST_PARTS: usize = 1024;
/// Beyond it, it is no size.
const LARGEST: u64 = 1 << 31;

/// The way to the width and height of one type's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Extent {
    version: RosVersion,
    steps: Vec<Step>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    /// So many items of so many bytes, aligned where numbers are.
    Items(usize, usize, usize),
    /// The same, with their number before them.
    CountedItems(usize, usize),
    /// Strings with their lengths before them, wide ones or not.
    Strings(usize, bool),
    /// Strings, with their number before them.
    CountedStrings(bool),
    Width(Primitive),
    Height(Primitive),
    /// A JPEG or PNG file with its length before it.
    File,
}

impl Extent {
    /// For messages of this type; none where it does not say so.
    pub fn of(message: &MessageType) -> Option<Extent> {
        let mut steps = Vec::new();
        let file = matches!(
            message.name(),
            "sensor_msgs/CompressedImage" | "sensor_msgs/msg/CompressedImage"
        );
        let found = if file {
            to_file(message, &mut steps)
        } else if has_sides(message) {
            to_sides(message, &mut steps)
        } else {
            within(message, &mut steps)
        };
        found.map(|()| Extent {
            version: message.version(),
            steps,
        })
    }

    /// Width and height of a message; none where it says none.
    pub fn find(&self, message: &[u8]) -> Option<(u64, u64)> {
        let mut walk = Walk {
            cursor: Cursor::new(self.version, message)?,
            parts: 0,
        };
        let (mut width, mut height) = (None, None);
        for step in &self.steps {
            match *step {
                Step::Items(count, size, alignment) => {
                    walk.cursor.skip(count, size, alignment)?;
                }
                Step::CountedItems(size, alignment) => {
                    let count = walk.cursor.length()?;
                    walk.cursor.skip(count, size, alignment)?;
                }
                Step::Strings(count, wide) => walk.strings(count, wide)?,
                Step::CountedStrings(wide) => {
                    let count = walk.cursor.length()?;
                    walk.strings(count, wide)?;
                }
                Step::Width(primitive) => width = Some(walk.side(primitive)?),
                Step::Height(primitive) => height = Some(walk.side(primitive)?),
                Step::File => {
                    let bytes = walk.cursor.length()?;
                    return of_file(walk.cursor.take(bytes, 1)?);
                }
            }
        }
        let sane = |side: &u64| (1..LARGEST).contains(side);
        Some((width.filter(sane)?, height.filter(sane)?))
    }
}

fn side(field: &Field) -> Option<(&str, Primitive)> {
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
    let sides = message.fields().iter().filter_map(side);
    sides.count() == 2
}

/// Steps up to the second of both numbers.
fn to_sides(message: &MessageType, steps: &mut Vec<Step>) -> Option<()> {
    let mut left = 2;
    for field in message.fields() {
        match side(field) {
            Some(("width", primitive)) => steps.push(Step::Width(primitive)),
            Some((_, primitive)) => steps.push(Step::Height(primitive)),
            None => {
                over(field, steps)?;
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

/// The first message in it that has both, such as a grid's `info`.
fn within(message: &MessageType, steps: &mut Vec<Step>) -> Option<()> {
    for field in message.fields() {
        match (&field.base, field.arity) {
            (Base::Message(inner), Arity::One) if has_sides(inner) => {
                return to_sides(inner, steps);
            }
            _ => over(field, steps)?,
        }
    }
    None
}

fn to_file(message: &MessageType, steps: &mut Vec<Step>) -> Option<()> {
    for field in message.fields() {
        let bytes = matches!(field.base, Base::Primitive(Primitive::Uint8));
        if field.name == "data" && bytes && field.arity == Arity::Variable {
            steps.push(Step::File);
            return Some(());
        }
        over(field, steps)?;
    }
    None
}

/// Steps over a field; none where that is too long a way.
fn over(field: &Field, steps: &mut Vec<Step>) -> Option<()> {
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
            // ROS 1's times are not aligned.
            steps.push(match (is_text, times) {
                (false, Some(times)) => Step::Items(times, size, size),
                (false, None) => Step::CountedItems(size, size),
                (true, Some(times)) => Step::Strings(times, wide),
                (true, None) => Step::CountedStrings(wide),
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
        (Some((size, alignment)), Some(times)) => steps.push(Step::Items(times, size, alignment)),
        (Some((size, alignment)), None) => steps.push(Step::CountedItems(size, alignment)),
        (None, Some(1)) => {
            for field in message.fields() {
                over(field, steps)?;
            }
            if message.plan.placeholder {
                steps.push(Step::Items(1, 1, 1));
            }
        }
        // In an array each one has its own size.
        (None, _) => return None,
    }
    (steps.len() <= MOST_STEPS).then_some(())
}

struct Walk<'a> {
    cursor: Cursor<'a>,
    parts: usize,
}

impl Walk<'_> {
    fn strings(&mut self, count: usize, wide: bool) -> Option<()> {
        for _ in 0..count {
            self.parts += 1;
            if self.parts > MOST_PARTS {
                return None;
            }
            self.cursor.string(wide)?;
        }
        Some(())
    }

    /// A whole number. One below zero is far beyond any size.
    fn side(&mut self, primitive: Primitive) -> Option<u64> {
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

/// Width and height of a PNG (its `IHDR`; ISO/IEC 15948, 11.2.2) or a JPEG (its frame header; ITU-T T.81, B.2.2).
fn of_file(file: &[u8]) -> Option<(u64, u64)> {
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
                // Bytes that fill.
                0xff => at += 1,
                // Frame headers, without those of other segments between them: DHT, JPG and DAC.
                0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                    break (word(at + 7, 2)?, word(at + 5, 2)?);
                }
                // Before any frame header the picture begins or ends.
                0xd9 | 0xda => return None,
                // Without a length.
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
        let registry = Registry::of(RosVersion::Two);
        for (key, text) in [
            (
                "a/Picture",
                "std_msgs/Header header\nwstring more\nuint16 height\nint64 width\nuint8[] data",
            ),
            (
                "a/Info",
                "builtin_interfaces/Time load\nfloat32 resolution\nuint32 width\nuint32 height",
            ),
            (
                "a/Grid",
                "std_msgs/Header header\nEmpty[2] none\nuint8 odd\nInfo info\nint8[] data",
            ),
            (
                "a/Plain",
                "std_msgs/Header header\nEmpty none\nfloat64[] skipped\nInfo info",
            ),
            ("a/Empty", ""),
            (
                "sensor_msgs/CompressedImage",
                "std_msgs/Header header\nstring format\nuint8[] data",
            ),
        ] {
            registry.insert(key, text).unwrap();
        }
        let find = |name: &str, json: &str| {
            let message = registry.message(name).unwrap();
            let mut bytes = Vec::new();
            from_json(&message, json.as_bytes(), &mut bytes, &Default::default()).unwrap();
            Extent::of(&message)?.find(&bytes)
        };
        let picture = r#"{"header": {"frame_id": "abc"}, "more": "é", "height": 48, "width": 64}"#;
        assert_eq!(find("a/Picture", picture), Some((64, 48)));
        let info = r#""info": {"width": 7, "height": 9}"#;
        let plain = format!(r#"{{"header": {{"frame_id": "ab"}}, "skipped": [1, 2], {info}}}"#);
        assert_eq!(find("a/Plain", &plain), Some((7, 9)));
        // Beyond an array of messages it is not looked for.
        assert_eq!(find("a/Grid", &format!("{{{info}}}")), None);
        let png = "iVBORw0KGgoAAAANSUhEUgAAAAUAAAAG";
        let compressed = format!(r#"{{"format": "png", "data": "{png}"}}"#);
        assert_eq!(
            find("sensor_msgs/CompressedImage", &compressed),
            Some((5, 6))
        );
        // Big endian.
        let info = registry.message("a/Info").unwrap();
        let bytes = [0u32, 1, 2, 3, 640, 480].map(u32::to_be_bytes).concat();
        assert_eq!(Extent::of(&info).unwrap().find(&bytes), Some((640, 480)));
    }

    const HEADER: &str = "uint32 seq\ntime stamp\nstring frame_id";
    const DEFINITIONS: [(&str, &str); 9] = [
        ("std_msgs/Header", HEADER),
        (
            "sensor_msgs/Image",
            "Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data",
        ),
        (
            "sensor_msgs/CompressedImage",
            "Header header\nstring format\nuint8[] data",
        ),
        (
            "nav_msgs/MapMetaData",
            "time map_load_time\nfloat32 resolution\nuint32 width\nuint32 height",
        ),
        (
            "nav_msgs/OccupancyGrid",
            "Header header\nMapMetaData info\nint8[] data",
        ),
        ("a/Float", "float32 width\nfloat32 height"),
        ("a/One", "uint32 width"),
        (
            "a/Late",
            "string[2] names\nstring[] more\nint64[] numbers\nint8 width\nint64 height",
        ),
        (
            "a/Listed",
            "Float[] all\nOne[3] some\nText[] texts\nuint8 width\nuint8 height",
        ),
    ];

    fn extent(name: &str) -> Option<Extent> {
        let registry = Registry::new();
        for (key, text) in DEFINITIONS {
            registry.insert(key, text).expect("valid");
        }
        registry.insert("a/Text", "string text").expect("valid");
        Extent::of(&registry.message(name).expect("known"))
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

    fn compressed(file: &[u8]) -> Vec<u8> {
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
            ("sensor_msgs/CompressedImage", compressed(png), (640, 480)),
            ("sensor_msgs/CompressedImage", compressed(&jpeg), (640, 480)),
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
        // More strings than anybody has.
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
            assert_eq!(file.find(&compressed(bytes)), None, "{bytes:?}");
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
                let _ = extent.find(&compressed(&file));
            }
        }
    }
}
