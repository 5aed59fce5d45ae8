//! Values in ROS 2 definitions: default values of fields (`int32 x 5`) and constants.

use crate::schema::SyntaxError;
use crate::schema::primitive::Primitive;

/// Default value of a field: one value, or those of an array.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Initial(pub(crate) Box<[InitialItem]>);

/// A single value.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum InitialItem {
    /// Little-endian bytes; only as many count as the type has.
    Scalar([u8; 8]),
    Text(Box<str>),
}

impl Initial {
    /// Parses the value of a single field or of an array (`[1, 2]`).
    pub(crate) fn parse(primitive: Primitive, is_array: bool, written: &str) -> Result<Initial, SyntaxError> {
        if !is_array {
            return Ok(Initial([parse_item(primitive, written)?].into()));
        }
        let inside = written
            .strip_prefix('[')
            .and_then(|rest| rest.strip_suffix(']'))
            .ok_or_else(|| SyntaxError::NotAList(written.to_owned()))?;
        let items = elements(inside)?.into_iter().map(|element| parse_item(primitive, element));
        Ok(Initial(items.collect::<Result<_, _>>()?))
    }
}

/// Splits at commas outside quotes.
fn elements(inside: &str) -> Result<Vec<&str>, SyntaxError> {
    let mut found = Vec::new();
    let mut rest = inside.trim();
    while !rest.is_empty() {
        let end = match quoted_end(rest) {
            Some(end) => end,
            None if rest.starts_with(['"', '\'']) => {
                return Err(SyntaxError::UnclosedQuote(rest.to_owned()));
            }
            None => rest.find(',').unwrap_or(rest.len()),
        };
        let (element, after) = rest.split_at(end);
        found.push(element.trim());
        let after = after.trim_start();
        rest = match after.strip_prefix(',') {
            Some(more) => more.trim_start(),
            None if after.is_empty() => after,
            None => return Err(SyntaxError::MissingComma(after.to_owned())),
        };
    }
    Ok(found)
}

/// Returns the end of the quoted text at the beginning of `written`: the offset after its closing quote.
pub(crate) fn quoted_end(written: &str) -> Option<usize> {
    let mut bytes = written.bytes().enumerate();
    let (_, quote) = bytes.next().filter(|(_, first)| b"\"'".contains(first))?;
    let mut escaped = false;
    for (at, byte) in bytes {
        match byte {
            _ if escaped => escaped = false,
            b'\\' => escaped = true,
            byte if byte == quote => return Some(at + 1),
            _ => {}
        }
    }
    None
}

/// Removes the quotes around a text, if any.
pub(crate) fn unquote(written: &str) -> String {
    match (quoted_end(written), written.chars().next()) {
        (Some(end), Some(quote)) if end == written.len() => {
            written[1..end - 1].replace(&format!("\\{quote}"), &quote.to_string())
        }
        _ => written.to_owned(),
    }
}

/// Parses a value of this type.
pub(crate) fn parse_item(primitive: Primitive, written: &str) -> Result<InitialItem, SyntaxError> {
    let signed = |bits: u32| integer(written).filter(|it| fits_signed(*it, bits));
    let unsigned = |bits: u32| integer(written).filter(|it| (0..1 << bits).contains(it));
    let bits = match primitive {
        Primitive::String | Primitive::Wstring => {
            return Ok(InitialItem::Text(unquote(written).into()));
        }
        Primitive::Bool => boolean(written).map(u64::from),
        Primitive::Int8 => signed(8).map(|it| it as u64),
        Primitive::Int16 => signed(16).map(|it| it as u64),
        Primitive::Int32 => signed(32).map(|it| it as u64),
        Primitive::Int64 => signed(64).map(|it| it as u64),
        Primitive::Uint8 => unsigned(8).map(|it| it as u64),
        Primitive::Uint16 => unsigned(16).map(|it| it as u64),
        Primitive::Uint32 => unsigned(32).map(|it| it as u64),
        Primitive::Uint64 => unsigned(64).map(|it| it as u64),
        Primitive::Float32 => float::<f32>(written).map(|it| it.to_bits().into()),
        Primitive::Float64 => float::<f64>(written).map(f64::to_bits),
        Primitive::Time | Primitive::Duration => None,
    };
    let bits = bits
        .ok_or_else(|| SyntaxError::BadValue { value: written.to_owned(), type_name: primitive.name().to_owned() })?;
    Ok(InitialItem::Scalar(bits.to_le_bytes()))
}

fn boolean(written: &str) -> Option<bool> {
    match &*written.to_ascii_lowercase() {
        "true" | "1" => Some(true),
        "false" | "0" => Some(false),
        _ => None,
    }
}

fn float<T: std::str::FromStr>(written: &str) -> Option<T> {
    written.parse().ok()
}

fn fits_signed(value: i128, bits: u32) -> bool {
    (-(1i128 << (bits - 1))..1i128 << (bits - 1)).contains(&value)
}

/// Parses an integer in Python's notation: decimal, or with `0x`, `0o`, `0b`.
fn integer(written: &str) -> Option<i128> {
    let (negative, digits) = match written.strip_prefix('-') {
        Some(digits) => (true, digits),
        None => (false, written.strip_prefix('+').unwrap_or(written)),
    };
    let (digits, radix) = match digits.as_bytes() {
        [b'0', b'x' | b'X', ..] => (&digits[2..], 16),
        [b'0', b'o' | b'O', ..] => (&digits[2..], 8),
        [b'0', b'b' | b'B', ..] => (&digits[2..], 2),
        _ => (digits, 10),
    };
    // The standard library would accept another sign.
    if !digits.starts_with(|digit: char| digit.is_ascii_hexdigit()) {
        return None;
    }
    let magnitude = i128::from_str_radix(digits, radix).ok()?;
    Some(if negative { -magnitude } else { magnitude })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_read_as_python_writes_them() {
        for (primitive, written, value) in [
            (Primitive::Bool, "True", 1),
            (Primitive::Bool, "0", 0),
            (Primitive::Uint8, "0xff", 255),
            (Primitive::Int8, "-128", 0x80),
            (Primitive::Int16, "-0b11", 0xfffd),
            (Primitive::Uint32, "+0o17", 15),
            (Primitive::Uint64, "18446744073709551615", u64::MAX),
            (Primitive::Int64, "-9223372036854775808", 1 << 63),
            (Primitive::Float32, "-1.5", 0xbfc0_0000),
            (Primitive::Float64, "1e3", 1000f64.to_bits()),
        ] {
            let Ok(InitialItem::Scalar(bytes)) = parse_item(primitive, written) else {
                panic!("{written}");
            };
            let size = primitive.size();
            assert_eq!(bytes[..size], value.to_le_bytes()[..size], "{written}");
        }
        for (primitive, written) in [
            (Primitive::Bool, "yes"),
            (Primitive::Uint8, "256"),
            (Primitive::Uint8, "-1"),
            (Primitive::Int8, "128"),
            (Primitive::Int32, "1.0"),
            (Primitive::Int32, "--1"),
            (Primitive::Int32, "0x-1"),
            (Primitive::Uint64, "99999999999999999999999999999999999999999999"),
            (Primitive::Float64, "one"),
        ] {
            assert!(parse_item(primitive, written).is_err(), "{written}");
        }
    }

    #[test]
    fn lists_are_divided_at_commas_outside_of_quotes() {
        let texts = |written| {
            let Initial(items) = Initial::parse(Primitive::String, true, written)?;
            let text = |item: &InitialItem| match item {
                InitialItem::Text(text) => text.to_string(),
                InitialItem::Scalar(_) => unreachable!(),
            };
            Ok::<Vec<_>, SyntaxError>(items.iter().map(text).collect())
        };
        assert_eq!(texts("[]").unwrap(), [""; 0]);
        assert_eq!(texts(r#"["a, b" , 'it\'s', plain word,"" ]"#).unwrap(), ["a, b", "it's", "plain word", ""]);
        for (written, reason) in [
            ("[\"a]", "\"a has no closing quote"),
            ("[\"a\" b]", "\"b\" follows a value, write a comma"),
            ("a", "a is not a list, write [VALUE, VALUE]"),
        ] {
            assert_eq!(texts(written).unwrap_err().to_string(), reason);
        }
    }
}
