//! Messages as values accessible by name, for the few messages that are examined here rather than forwarded.

use std::borrow::Cow;

use crate::RosVersion;
use crate::codec::Time;
use crate::codec::cdr::units_to_utf8;
use crate::codec::cursor::MessageCursor;
use crate::schema::{Arity, Base, Field, MessageType, Primitive};

/// A value in a serialized message.
#[derive(Debug, Clone, PartialEq)]
pub enum Value<'a> {
    /// Any number, and `bool` as 0 or 1. Integers beyond 2^53 are rounded.
    Number(f64),
    /// Bytes of a string; a wide string is converted to UTF-8.
    Text(Cow<'a, [u8]>),
    /// A time, or the bits of a duration.
    Time(Time),
    /// An array.
    List(Vec<Value<'a>>),
    /// A message: its fields by name.
    Message(Vec<(&'a str, Value<'a>)>),
}

impl<'a> Value<'a> {
    /// Reads one message; `None` if the bytes are no such message.
    pub fn read(of: &'a MessageType, bytes: &'a [u8]) -> Option<Self> {
        let mut reader = ValueDecoder {
            cursor: MessageCursor::new(of.version(), bytes)?,
            version: of.version(),
            left: bytes.len().saturating_add(WITHOUT_BYTES),
        };
        let read = reader.message(of)?;
        // Senders that serialize ROS 2 messages into a buffer of estimated size leave bytes behind them.
        let ended = reader.cursor.remaining() == 0 || reader.version == RosVersion::Two;
        ended.then_some(read)
    }

    /// Returns a field of a message.
    pub fn field(&self, name: &str) -> Option<&Value<'a>> {
        match self {
            Value::Message(fields) => fields.iter().find(|(field, _)| *field == name).map(|(_, value)| value),
            _ => None,
        }
    }

    /// Returns the number.
    pub fn number(&self) -> Option<f64> {
        match self {
            Value::Number(number) => Some(*number),
            _ => None,
        }
    }

    /// Returns the string; invalid UTF-8 is replaced.
    pub fn text(&self) -> Option<String> {
        match self {
            Value::Text(bytes) => Some(String::from_utf8_lossy(bytes).into_owned()),
            _ => None,
        }
    }

    /// Returns the time.
    pub fn time(&self) -> Option<Time> {
        match self {
            Value::Time(time) => Some(*time),
            _ => None,
        }
    }

    /// Returns the items of an array; empty for any other value.
    pub fn items(&self) -> &[Value<'a>] {
        match self {
            Value::List(items) => items,
            _ => &[],
        }
    }
}

/// Maximum number of values without bytes: fields and items of types without fields.
const WITHOUT_BYTES: usize = 1000;

struct ValueDecoder<'a> {
    cursor: MessageCursor<'a>,
    version: RosVersion,
    /// Remaining number of values.
    left: usize,
}

impl<'a> ValueDecoder<'a> {
    fn message(&mut self, of: &'a MessageType) -> Option<Value<'a>> {
        let fields = of.fields().iter();
        let values = fields.map(|field| Some((field.name.as_str(), self.field(field)?)));
        let message = values.collect::<Option<_>>().map(Value::Message)?;
        if of.plan.placeholder {
            self.cursor.take(1, 1)?;
        }
        Some(message)
    }

    fn field(&mut self, field: &'a Field) -> Option<Value<'a>> {
        let count = match field.arity {
            Arity::One => return self.read_value(&field.base),
            Arity::Fixed(count) => count as usize,
            Arity::Variable => self.cursor.length()?,
        };
        // Items without bytes cost nothing, so their number is bounded.
        if count > self.cursor.remaining() {
            return None;
        }
        let items = (0..count).map(|_| self.read_value(&field.base));
        items.collect::<Option<_>>().map(Value::List)
    }

    fn read_value(&mut self, base: &'a Base) -> Option<Value<'a>> {
        self.left = self.left.checked_sub(1)?;
        let primitive = match base {
            Base::Message(message) if message.plan.scalar.is_some() => return self.time(),
            Base::Message(message) => return self.message(message),
            Base::Primitive(primitive) => primitive,
        };
        let cursor = &mut self.cursor;
        Some(Value::Number(match primitive {
            Primitive::Bool | Primitive::Uint8 => u8::from_le_bytes(cursor.number()?).into(),
            Primitive::Int8 => i8::from_le_bytes(cursor.number()?).into(),
            Primitive::Uint16 => u16::from_le_bytes(cursor.number()?).into(),
            Primitive::Int16 => i16::from_le_bytes(cursor.number()?).into(),
            Primitive::Uint32 => u32::from_le_bytes(cursor.number()?).into(),
            Primitive::Int32 => i32::from_le_bytes(cursor.number()?).into(),
            Primitive::Uint64 => u64::from_le_bytes(cursor.number()?) as f64,
            Primitive::Int64 => i64::from_le_bytes(cursor.number()?) as f64,
            Primitive::Float32 => f32::from_le_bytes(cursor.number()?).into(),
            Primitive::Float64 => f64::from_le_bytes(cursor.number()?),
            Primitive::String => {
                let text = cursor.string(false)?;
                let terminated = self.version == RosVersion::Two;
                let bare = text.strip_suffix(&[0]).filter(|_| terminated);
                return Some(Value::Text(bare.unwrap_or(text).into()));
            }
            Primitive::Wstring => {
                let units = cursor.string(true)?;
                let text =
                    if cursor.is_big_endian() { units_to_utf8::<true>(units) } else { units_to_utf8::<false>(units) };
                return Some(Value::Text(text.into()));
            }
            Primitive::Time | Primitive::Duration => return self.time(),
        }))
    }

    fn time(&mut self) -> Option<Value<'a>> {
        Some(Value::Time(Time {
            secs: u32::from_le_bytes(self.cursor.number()?),
            nsecs: u32::from_le_bytes(self.cursor.number()?),
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::from_json;
    use crate::schema::Registry;

    #[test]
    fn values_are_found_by_name_and_torn_messages_are_none() {
        let registry = Registry::new();
        let definitions = [
            ("x/msg/Pair", "Header header\nInner[] more\nint8[2] both\nbool ok\n"),
            ("x/msg/Inner", "float64 wide\nstring name\n"),
        ];
        for (key, text) in definitions {
            registry.insert(key, text).unwrap();
        }
        let pair = registry.message("x/Pair").unwrap();
        let json = br#"{"header": {"stamp": {"secs": 7, "nsecs": 8}, "frame_id": "map"},
            "more": [{"wide": 0.1, "name": "a"}, {"wide": -2.5, "name": ""}], "both": [-1, 2], "ok": true}"#;
        let mut bytes = Vec::new();
        from_json(&pair, json, &mut bytes, &Default::default()).unwrap();
        let read = Value::read(&pair, &bytes).unwrap();
        let header = read.field("header").unwrap();
        let stamp = header.field("stamp").and_then(Value::time);
        assert_eq!(stamp, Some(Time { secs: 7, nsecs: 8 }));
        assert_eq!(header.field("frame_id").and_then(Value::text).unwrap(), "map");
        let more = read.field("more").unwrap().items();
        let wide: Vec<_> = more.iter().map(|it| it.field("wide")?.number()).collect();
        assert_eq!(wide, [Some(0.1), Some(-2.5)]);
        let both = read.field("both").unwrap().items();
        assert_eq!(both, [Value::Number(-1.0), Value::Number(2.0)]);
        assert_eq!(read.field("ok"), Some(&Value::Number(1.0)));
        assert_eq!(read.field("nothing"), None);
        for end in 0..bytes.len() {
            assert_eq!(Value::read(&pair, &bytes[..end]), None, "{end}");
        }
        bytes.push(0);
        assert_eq!(Value::read(&pair, &bytes), None, "more than one message");
    }
    #[test]
    fn values_without_bytes_are_bounded_in_number() {
        let registry = Registry::new();
        let fields: String = (0..100).map(|n| format!("Nothing f{n}\n")).collect();
        for (key, text) in
            [("x/msg/Nothing", ""), ("x/msg/Fields", fields.as_str()), ("x/msg/Many", "Fields[] items\nuint8[] rest\n")]
        {
            registry.insert(key, text).unwrap();
        }
        let many = registry.message("x/Many").unwrap();
        let of = |items: u32, rest: u32| {
            let lengths = [items.to_le_bytes(), rest.to_le_bytes()].concat();
            [lengths, vec![0; rest as usize]].concat()
        };
        assert!(Value::read(&many, &of(9, 100)).is_some());
        // A million values in a message of ten thousand bytes.
        assert_eq!(Value::read(&many, &of(9_999, 10_000)), None);
    }
}
