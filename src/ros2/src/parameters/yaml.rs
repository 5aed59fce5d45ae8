//! Parameter values, read from YAML as rcl does: the type of a scalar follows from its notation.

mod events;

use ros_bus::ParamValue;
pub use saphyr_parser::Event;
use saphyr_parser::{ScalarStyle, Tag};

pub use self::events::{Problem, YamlEvents};

const TRUE: [&str; 11] = ["Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"];
const FALSE: [&str; 11] = ["N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"];

/// Parses the value of an argument `-p NAME:=VALUE`.
///
/// # Errors
/// The text is not a value, or is several.
pub fn parse_text(text: &str) -> Result<ParamValue, Problem> {
    let mut found = None;
    let mut events = YamlEvents::new(text);
    let mut read = || {
        loop {
            let (event, line) = events.next_event()?;
            match event {
                Event::StreamStart | Event::DocumentStart(_) | Event::DocumentEnd => {}
                Event::StreamEnd => return Ok(()),
                event if found.is_none() => found = Some(parse_event(event, line, &mut events)?),
                _ => return Err(Problem::new(line, "expected a single value")),
            }
        }
    };
    read()?;
    found.ok_or_else(|| Problem::new(1, NO_VALUE))
}

/// Parses a value like [`parse_text`], or returns the text itself if it is none.
pub fn parse_any(text: &str) -> ParamValue {
    parse_text(text).unwrap_or_else(|_| ParamValue::String(text.to_owned()))
}

/// Reason that is reported if the value is missing.
pub const NO_VALUE: &str = "the value is missing; write an empty string as \"\"";

/// Parses the value that begins with this event.
pub fn parse_event(event: Event<'_>, line: usize, events: &mut YamlEvents<'_>) -> Result<ParamValue, Problem> {
    match event {
        Event::Scalar(text, style, _, tag) => scalar(&text, style, tag.as_deref(), line),
        Event::SequenceStart(..) => list(events),
        Event::Alias(_) => Err(Problem::new(line, "ROS 2 does not support aliases: write the value")),
        _ => Err(Problem::new(line, "expected a number, a boolean, a string, or a list of these")),
    }
}

fn list(events: &mut YamlEvents<'_>) -> Result<ParamValue, Problem> {
    let mut items: Vec<ParamValue> = Vec::new();
    loop {
        let (event, line) = events.next_event()?;
        let item = match event {
            Event::SequenceEnd => return Ok(ParamValue::List(items)),
            Event::Scalar(text, style, _, tag) => scalar(&text, style, tag.as_deref(), line)?,
            _ => {
                return Err(Problem::new(line, "a list cannot contain lists or groups"));
            }
        };
        let same = |first: &ParamValue| std::mem::discriminant(first) == std::mem::discriminant(&item);
        if !items.first().is_none_or(same) {
            return Err(Problem::new(
                line,
                "the values of a list must have one type; write 1.0 for a whole number among floating-point numbers",
            ));
        }
        items.push(item);
    }
}

fn scalar(text: &str, style: ScalarStyle, tag: Option<&Tag>, line: usize) -> Result<ParamValue, Problem> {
    let quoted = matches!(style, ScalarStyle::SingleQuoted | ScalarStyle::DoubleQuoted);
    let is_text = tag.is_some_and(|tag| tag.is_yaml_core_schema() && tag.suffix == "str");
    if quoted || is_text {
        return Ok(ParamValue::String(text.to_owned()));
    }
    if text.is_empty() {
        return Err(Problem::new(line, NO_VALUE));
    }
    Ok(plain(text))
}

fn plain(text: &str) -> ParamValue {
    if TRUE.contains(&text) || FALSE.contains(&text) {
        return ParamValue::Bool(TRUE.contains(&text));
    }
    if let Some(whole) = parse_integer(text) {
        return ParamValue::Int(whole);
    }
    parse_double(text).map_or_else(|| ParamValue::String(text.to_owned()), ParamValue::Double)
}

fn split_sign(text: &str) -> (bool, &str) {
    match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    }
}

/// Parses an integer as C does (`strtol` with base 0): `0x10` is 16 and `010` is 8.
fn parse_integer(text: &str) -> Option<i64> {
    let (negative, digits) = split_sign(text);
    let hexadecimal = digits.strip_prefix("0x").or_else(|| digits.strip_prefix("0X"));
    let (digits, base) = match (hexadecimal, digits.strip_prefix('0')) {
        (Some(digits), _) => (digits, 16),
        (None, Some(octal)) if !octal.is_empty() => (octal, 8),
        _ => (digits, 10),
    };
    if digits.starts_with(['+', '-']) {
        return None;
    }
    let value = i128::from_str_radix(digits, base).ok()?;
    i64::try_from(if negative { -value } else { value }).ok()
}

/// Parses a floating-point number as C does (`strtod`), and YAML's infinities.
fn parse_double(text: &str) -> Option<f64> {
    let (negative, rest) = split_sign(text);
    let sign = if negative { -1.0 } else { 1.0 };
    match rest {
        ".inf" | ".Inf" | ".INF" => return Some(sign * f64::INFINITY),
        ".nan" | ".NaN" | ".NAN" if rest == text => return Some(f64::NAN),
        _ => {}
    }
    let hexadecimal = rest.strip_prefix("0x").or_else(|| rest.strip_prefix("0X"));
    if let Some(digits) = hexadecimal {
        return Some(sign * parse_hexadecimal_double(digits)?);
    }
    if rest.starts_with(['+', '-']) {
        return None;
    }
    let value: f64 = rest.parse().ok()?;
    // A number too large for a double is a string for rcl.
    let overflowed = value.is_infinite() && rest.contains(|c: char| c.is_ascii_digit());
    (!overflowed).then_some(sign * value)
}

/// Parses the digits after `0x`: `1.8p3` is 12.
fn parse_hexadecimal_double(text: &str) -> Option<f64> {
    let (mantissa, exponent) = match text.split_once(['p', 'P']) {
        Some((mantissa, exponent)) => (mantissa, exponent.parse().ok()?),
        None => (text, 0),
    };
    let (before, behind) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    if before.is_empty() && behind.is_empty() {
        return None;
    }
    let mut value = 0.0;
    for digit in before.chars().chain(behind.chars()) {
        value = value * 16.0 + f64::from(digit.to_digit(16)?);
    }
    let places = i32::try_from(behind.len()).ok()?.checked_mul(4)?;
    let value = value * 2_f64.powi(i32::checked_sub(exponent, places)?);
    value.is_finite().then_some(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Verified against rclpy 7.1.
    #[test]
    fn scalars_have_the_type_that_rcl_gives_them() {
        use ParamValue::{Bool, Double, Int, String};
        let text = |text: &str| String(text.to_owned());
        for (written, value) in [
            ("yes", Bool(true)),
            ("ON", Bool(true)),
            ("y", Bool(true)),
            ("off", Bool(false)),
            ("\"yes\"", text("yes")),
            ("'1'", text("1")),
            ("!!str 1", text("1")),
            ("yEs", text("yEs")),
            ("1", Int(1)),
            ("+5", Int(5)),
            ("-0x10", Int(-16)),
            ("010", Int(8)),
            ("0b1", text("0b1")),
            ("1_000", text("1_000")),
            ("9223372036854775807", Int(i64::MAX)),
            ("99999999999999999999", Double(1e20)),
            ("1.", Double(1.0)),
            (".5", Double(0.5)),
            ("1e3", Double(1000.0)),
            ("1e400", text("1e400")),
            ("0x1p3", Double(8.0)),
            ("-.inf", Double(f64::NEG_INFINITY)),
            ("inf", Double(f64::INFINITY)),
            ("nan", Double(f64::NAN)),
            ("~", text("~")),
            ("null", text("null")),
            ("hello world", text("hello world")),
            ("\"a: [b]\\n\"", text("a: [b]\n")),
            ("''", text("")),
            ("+-1", text("+-1")),
        ] {
            assert_eq!(parse_text(written), Ok(value), "{written}");
        }
    }

    #[test]
    fn lists_are_of_one_type() {
        let list = parse_text("[1, 0x10]").expect("a list");
        let expected = [ParamValue::Int(1), ParamValue::Int(16)];
        assert_eq!(list, ParamValue::List(expected.into()));
        assert_eq!(parse_text("[]"), Ok(ParamValue::List(vec![])));
        for (text, said) in [
            ("[1, 2.0]", "one type"),
            ("[[1]]", "cannot contain lists"),
            ("{a: 1}", "expected a number"),
            ("", "the value is missing"),
            ("\"", "quote"),
            ("[1, 2", "expected ',' or ']'"),
        ] {
            let reason = parse_text(text).expect_err(text).to_string();
            assert!(reason.contains(said), "{text}: {reason}");
        }
    }
}
