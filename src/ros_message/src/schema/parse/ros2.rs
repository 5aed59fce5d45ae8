//! Parser of a line of a ROS 2 definition (<https://docs.ros.org/en/jazzy/Concepts/Basic/About-Interfaces.html>):
//! bounds (`string<=8`, `int32[<=3]`), `wstring`, and default values.

use crate::RosVersion;
use crate::schema::initial::{Initial, InitialItem, parse_item, quoted_end};
use crate::schema::parse::{Parsed, ParsedField, check_identifier};
use crate::schema::primitive::Primitive;
use crate::schema::types::{Arity, Constant, FieldBounds};
use crate::schema::{MAX_MESSAGE_BYTES, SyntaxError};

/// Parses a line and adds it to `parsed`. References are relative to `package`.
pub(super) fn parse_line(package: &str, line: &str, parsed: &mut Parsed) -> Result<(), SyntaxError> {
    let line = line.trim();
    if line.is_empty() || line.starts_with('#') {
        return Ok(());
    }
    let (written, rest) = line
        .split_once([' ', '\t'])
        .filter(|(written, _)| !written.contains('#'))
        .ok_or_else(|| SyntaxError::NotAField(line.to_owned()))?;
    let rest = rest.trim_start();
    let name_ends = |byte: char| !byte.is_ascii_alphanumeric() && byte != '_';
    let (name, rest) = rest.split_at(rest.find(name_ends).unwrap_or(rest.len()));
    check_identifier(name)?;
    let rest = rest.trim_start();
    match rest.strip_prefix('=') {
        Some(value) => {
            let constant = constant(written, name, strip_comment(value)?)?;
            parsed.constants.push(constant);
            Ok(())
        }
        None => parsed.add_field(field(package, written, name, strip_comment(rest)?)?),
    }
}

/// Returns the value without a comment that follows it.
fn strip_comment(rest: &str) -> Result<&str, SyntaxError> {
    let rest = rest.trim();
    let Some(end) = quoted_end(rest) else {
        let listed = rest.starts_with('[').then(|| list_end(rest)).flatten();
        let end = listed.or_else(|| rest.find('#'));
        return Ok(rest[..end.unwrap_or(rest.len())].trim_end());
    };
    let (value, after) = rest.split_at(end);
    match after.trim_start() {
        "" => Ok(value),
        comment if comment.starts_with('#') => Ok(value),
        more => Err(SyntaxError::TextAfterQuote(more.to_owned())),
    }
}

/// Returns the end of a list: the offset after the closing bracket that is not quoted.
fn list_end(rest: &str) -> Option<usize> {
    let mut at = 1;
    loop {
        let more = &rest[at..];
        match more.chars().next()? {
            ']' => return Some(at + 1),
            // A number sign before the bracket begins a comment.
            '#' => return None,
            '"' | '\'' => at += quoted_end(more)?,
            other => at += other.len_utf8(),
        }
    }
}

fn constant(written: &str, name: &str, value: &str) -> Result<Constant, SyntaxError> {
    let primitive = Primitive::from_versioned_name(RosVersion::Two, written)
        .ok_or_else(|| SyntaxError::BadConstantType(written.to_owned()))?;
    let value = match parse_item(primitive, value)? {
        InitialItem::Text(text) => text.into(),
        InitialItem::Scalar(_) => value.to_owned(),
    };
    Ok(Constant { name: name.to_owned(), type_name: written.to_owned(), value })
}

fn field(package: &str, written: &str, name: &str, value: &str) -> Result<ParsedField, SyntaxError> {
    let (bare, brackets) = written.split_at(written.find('[').unwrap_or(written.len()));
    let (bare, text_bound) = match bare.split_once("<=") {
        Some((text, bound)) if matches!(text, "string" | "wstring") => (text, Some(size(bound)?)),
        Some((text, _)) => return Err(SyntaxError::Unboundable(text.to_owned())),
        None => (bare, None),
    };
    let (arity, most) = parse_brackets(brackets)?;
    let bounds = FieldBounds { text: text_bound, elements: most };
    let primitive = Primitive::from_versioned_name(RosVersion::Two, bare);
    let initial = match primitive {
        _ if value.is_empty() => None,
        None => {
            return Err(SyntaxError::NoValueAllowed { type_name: bare.to_owned(), value: value.to_owned() });
        }
        Some(primitive) => {
            let initial = Initial::parse(primitive, arity != Arity::One, value)?;
            check_initial(&initial, arity, bounds)?;
            Some(initial)
        }
    };
    Ok(ParsedField {
        name: name.to_owned(),
        type_name: match primitive {
            Some(_) => bare.to_owned(),
            None => resolve_name(package, bare)?,
        },
        arity,
        bounds,
        initial,
    })
}

fn parse_brackets(brackets: &str) -> Result<(Arity, Option<u32>), SyntaxError> {
    let Some(inside) = brackets.strip_prefix('[') else {
        return Ok((Arity::One, None));
    };
    let inside = inside.strip_suffix(']').ok_or_else(|| SyntaxError::BadArraySuffix(brackets.to_owned()))?;
    Ok(match inside.strip_prefix("<=") {
        Some(most) => (Arity::Variable, Some(size(most)?)),
        None if inside.is_empty() => (Arity::Variable, None),
        None => (Arity::Fixed(size(inside)?), None),
    })
}

fn size(written: &str) -> Result<u32, SyntaxError> {
    let digits = written.bytes().all(|byte| byte.is_ascii_digit());
    match written.parse::<u32>() {
        Ok(size) if digits && (1..=MAX_MESSAGE_BYTES).contains(&(size as usize)) => Ok(size),
        _ => Err(SyntaxError::BadSize(written.to_owned())),
    }
}

fn check_initial(initial: &Initial, arity: Arity, bounds: FieldBounds) -> Result<(), SyntaxError> {
    let found = initial.0.len();
    match (arity, bounds.elements) {
        (Arity::Fixed(count), _) if found != count as usize => {
            return Err(SyntaxError::WrongValueCount { expected: count, found });
        }
        (Arity::Variable, Some(most)) if found > most as usize => {
            return Err(SyntaxError::TooManyValues { most, found });
        }
        _ => {}
    }
    for item in &initial.0 {
        if let (InitialItem::Text(text), Some(most)) = (item, bounds.text) {
            let found = text.chars().count();
            if found > most as usize {
                return Err(SyntaxError::TooManyCharacters { most, found });
            }
        }
    }
    Ok(())
}

/// Resolves a type name. `package/Type` and bare names are messages; types generated from a service or action have the
/// kind in their name.
fn resolve_name(package: &str, bare: &str) -> Result<String, SyntaxError> {
    if matches!(bare, "time" | "duration") {
        return Err(SyntaxError::TypeOfRos1 {
            written: bare.to_owned(),
            message: if bare == "time" { "Time" } else { "Duration" },
        });
    }
    let parts: Vec<&str> = bare.split('/').collect();
    let (package, kind, short) = match parts[..] {
        [short] => (package, "msg", short),
        [package, short] => (package, "msg", short),
        [package, kind @ ("msg" | "srv" | "action"), short] => (package, kind, short),
        _ => return Err(SyntaxError::BadTypeName(bare.to_owned())),
    };
    check_identifier(package)?;
    check_identifier(short)?;
    Ok(format!("{package}/{kind}/{short}"))
}
