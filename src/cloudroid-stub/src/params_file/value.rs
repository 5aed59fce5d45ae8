//! Values of parameters as rcl reads them from YAML: which type a scalar has follows from how it is written.

use ros::bus::ParamValue;
use saphyr_parser::{Event, ScalarStyle, Tag};

use super::events::{Events, Problem};

const TRUE: [&str; 11] = [
    "Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON",
];
const FALSE: [&str; 11] = [
    "N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF",
];

/// The value in an argument `-p NAME:=VALUE`.
///
/// # Errors
/// Why it is none.
pub fn of_text(text: &str) -> Result<ParamValue, String> {
    let mut found = None;
    let mut events = Events::of(text);
    let mut read = || {
        loop {
            let (event, line) = events.next()?;
            match event {
                Event::StreamStart | Event::DocumentStart(_) | Event::DocumentEnd => {}
                Event::StreamEnd => return Ok(()),
                event if found.is_none() => found = Some(of_event(event, line, &mut events)?),
                _ => return Err(Problem::new(line, "it is more than one value")),
            }
        }
    };
    read().map_err(|problem| problem.reason)?;
    found.ok_or_else(|| NO_VALUE.to_owned())
}

/// What is said where nothing stands.
pub const NO_VALUE: &str = "there is no value; an empty text is written \"\"";

/// The value that begins with this event.
pub fn of_event(
    event: Event<'_>,
    line: usize,
    events: &mut Events<'_>,
) -> Result<ParamValue, Problem> {
    match event {
        Event::Scalar(text, style, _, tag) => scalar(&text, style, tag.as_deref(), line),
        Event::SequenceStart(..) => list(events),
        Event::Alias(_) => Err(Problem::new(
            line,
            "ROS 2 reads no aliases: write the value out",
        )),
        _ => Err(Problem::new(
            line,
            "a value is a number, a truth value, a text, or a list of such",
        )),
    }
}

fn list(events: &mut Events<'_>) -> Result<ParamValue, Problem> {
    let mut items: Vec<ParamValue> = Vec::new();
    loop {
        let (event, line) = events.next()?;
        let item = match event {
            Event::SequenceEnd => return Ok(ParamValue::List(items)),
            Event::Scalar(text, style, _, tag) => scalar(&text, style, tag.as_deref(), line)?,
            _ => {
                return Err(Problem::new(
                    line,
                    "a list holds values, and no lists or groups",
                ));
            }
        };
        let same =
            |first: &ParamValue| std::mem::discriminant(first) == std::mem::discriminant(&item);
        if !items.first().is_none_or(same) {
            return Err(Problem::new(
                line,
                "a list holds values of one type; write 1.0 for a whole number among others",
            ));
        }
        items.push(item);
    }
}

fn scalar(
    text: &str,
    style: ScalarStyle,
    tag: Option<&Tag>,
    line: usize,
) -> Result<ParamValue, Problem> {
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
    if let Some(whole) = whole(text) {
        return ParamValue::Int(whole);
    }
    double(text).map_or_else(|| ParamValue::String(text.to_owned()), ParamValue::Double)
}

fn signed(text: &str) -> (bool, &str) {
    match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text.strip_prefix('+').unwrap_or(text)),
    }
}

/// As C reads it (`strtol` with base 0): `0x10` is 16 and `010` is 8.
fn whole(text: &str) -> Option<i64> {
    let (negative, digits) = signed(text);
    let hexadecimal = digits
        .strip_prefix("0x")
        .or_else(|| digits.strip_prefix("0X"));
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

/// As C reads it (`strtod`), and YAML's own infinities.
fn double(text: &str) -> Option<f64> {
    let (negative, rest) = signed(text);
    let sign = if negative { -1.0 } else { 1.0 };
    match rest {
        ".inf" | ".Inf" | ".INF" => return Some(sign * f64::INFINITY),
        ".nan" | ".NaN" | ".NAN" if rest == text => return Some(f64::NAN),
        _ => {}
    }
    let hexadecimal = rest.strip_prefix("0x").or_else(|| rest.strip_prefix("0X"));
    if let Some(digits) = hexadecimal {
        return Some(sign * hexadecimal_double(digits)?);
    }
    if rest.starts_with(['+', '-']) {
        return None;
    }
    let value: f64 = rest.parse().ok()?;
    // What is too large for a double is a text to rcl.
    let overflowed = value.is_infinite() && rest.contains(|c: char| c.is_ascii_digit());
    (!overflowed).then_some(sign * value)
}

/// `1.8p3` is 12.
fn hexadecimal_double(text: &str) -> Option<f64> {
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

    /// All of these were given to rclpy 7.1, which took them for the same.
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
            assert_eq!(of_text(written), Ok(value), "{written}");
        }
    }

    #[test]
    fn lists_are_of_one_type() {
        let list = of_text("[1, 0x10]").expect("a list");
        let expected = [ParamValue::Int(1), ParamValue::Int(16)];
        assert_eq!(list, ParamValue::List(expected.into()));
        assert_eq!(of_text("[]"), Ok(ParamValue::List(vec![])));
        for (text, said) in [
            ("[1, 2.0]", "one type"),
            ("[[1]]", "no lists"),
            ("{a: 1}", "a value is"),
            ("", "no value"),
            ("\"", "quote"),
            ("[1, 2", "expected ',' or ']'"),
        ] {
            let reason = of_text(text).expect_err(text);
            assert!(reason.contains(said), "{text}: {reason}");
        }
    }
}
