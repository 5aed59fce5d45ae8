//! Parser of a single definition: text → constants and fields with unresolved references. The grammar depends on the
//! ROS version: this module has ROS 1's, [`ros2`] has ROS 2's.

mod ros2;

use crate::RosVersion;
use crate::schema::initial::Initial;
use crate::schema::limits::{MAX_FIELDS, MAX_NAME_BYTES};
use crate::schema::primitive::Primitive;
use crate::schema::types::{Arity, Constant, FieldBounds};
use crate::schema::{ExceededLimit, MAX_MESSAGE_BYTES, SchemaError, SyntaxError};

/// A parsed definition, line by line.
#[derive(Debug, Default)]
pub(crate) struct Parsed {
    pub(crate) constants: Vec<Constant>,
    pub(crate) fields: Vec<ParsedField>,
}

/// A field whose type is not resolved yet.
#[derive(Debug)]
pub(crate) struct ParsedField {
    pub(crate) name: String,
    /// Name of a built-in type, or of a message as in [`MessageType::name`](crate::schema::MessageType::name).
    pub(crate) type_name: String,
    pub(crate) arity: Arity,
    pub(crate) bounds: FieldBounds,
    pub(crate) initial: Option<Initial>,
}

impl Parsed {
    fn add_field(&mut self, field: ParsedField) -> Result<(), SyntaxError> {
        if self.fields.iter().any(|other| other.name == field.name) {
            return Err(SyntaxError::RepeatedField(field.name));
        }
        self.fields.push(field);
        Ok(())
    }
}

/// Parses the text of message `name`; relative references are relative to its package.
pub(crate) fn parse(version: RosVersion, name: &str, text: &str) -> Result<Parsed, SchemaError> {
    let parse_line = match version {
        RosVersion::One => parse_line,
        RosVersion::Two => ros2::parse_line,
    };
    let package = name.split('/').next().unwrap_or_default();
    let mut parsed = Parsed::default();
    for (index, line) in text.lines().enumerate() {
        parse_line(package, line, &mut parsed).map_err(|reason| SchemaError::Syntax {
            name: name.to_owned(),
            line: index + 1,
            reason: Box::new(reason),
        })?;
        if parsed.fields.len() + parsed.constants.len() > MAX_FIELDS {
            return Err(SchemaError::TooLarge { name: name.to_owned(), reason: ExceededLimit::Fields });
        }
    }
    Ok(parsed)
}

fn parse_line(package: &str, line: &str, parsed: &mut Parsed) -> Result<(), SyntaxError> {
    let code = line.split('#').next().unwrap_or_default().trim();
    if code.is_empty() {
        return Ok(());
    }
    if code.contains('=') {
        parsed.constants.push(parse_constant(line, code)?);
        return Ok(());
    }
    parsed.add_field(parse_field(package, code)?)
}

/// Parses `TYPE NAME=VALUE`; the value of a string extends to the end of the line and may include `#`.
fn parse_constant(line: &str, code: &str) -> Result<Constant, SyntaxError> {
    let (type_name, _) = code.split_once([' ', '\t', '=']).unwrap_or((code, ""));
    let source = if type_name == "string" { line.trim() } else { code };
    let rest = source.strip_prefix(type_name).unwrap_or_default();
    let (name, value) = rest.split_once('=').unwrap_or((rest, ""));
    let (name, value) = (name.trim(), value.trim());
    check_identifier(name)?;
    check_constant(type_name, value)?;
    Ok(Constant { name: name.to_owned(), type_name: type_name.to_owned(), value: value.to_owned() })
}

fn check_constant(type_name: &str, value: &str) -> Result<(), SyntaxError> {
    let fits = |low: i128, high: i128| value.parse::<i128>().is_ok_and(|number| (low..=high).contains(&number));
    let valid = match Primitive::from_name(type_name) {
        Some(Primitive::Bool) => matches!(value, "true" | "false" | "True" | "False") || value.parse::<i64>().is_ok(),
        Some(Primitive::Int8) => fits(i8::MIN.into(), i8::MAX.into()),
        Some(Primitive::Uint8) => fits(0, u8::MAX.into()),
        Some(Primitive::Int16) => fits(i16::MIN.into(), i16::MAX.into()),
        Some(Primitive::Uint16) => fits(0, u16::MAX.into()),
        Some(Primitive::Int32) => fits(i32::MIN.into(), i32::MAX.into()),
        Some(Primitive::Uint32) => fits(0, u32::MAX.into()),
        Some(Primitive::Int64) => fits(i64::MIN.into(), i64::MAX.into()),
        Some(Primitive::Uint64) => fits(0, u64::MAX.into()),
        Some(Primitive::Float32 | Primitive::Float64) => value.parse::<f64>().is_ok(),
        Some(Primitive::String) => true,
        Some(Primitive::Time | Primitive::Duration | Primitive::Wstring) | None => {
            return Err(SyntaxError::BadConstantType(type_name.to_owned()));
        }
    };
    if valid { Ok(()) } else { Err(SyntaxError::BadValue { value: value.to_owned(), type_name: type_name.to_owned() }) }
}

fn parse_field(package: &str, code: &str) -> Result<ParsedField, SyntaxError> {
    let mut words = code.split_ascii_whitespace();
    let (Some(written), Some(name), None) = (words.next(), words.next(), words.next()) else {
        return Err(SyntaxError::NotAField(code.to_owned()));
    };
    check_identifier(name)?;
    let (bare, brackets) = written.split_at(written.find('[').unwrap_or(written.len()));
    Ok(ParsedField {
        name: name.to_owned(),
        type_name: resolve_name(package, bare, brackets)?,
        arity: parse_brackets(brackets)?,
        bounds: FieldBounds::default(),
        initial: None,
    })
}

fn parse_brackets(brackets: &str) -> Result<Arity, SyntaxError> {
    let Some(inside) = brackets.strip_prefix('[') else {
        return Ok(Arity::One);
    };
    let inside = inside.strip_suffix(']').ok_or_else(|| SyntaxError::BadArraySuffix(brackets.to_owned()))?;
    if inside.is_empty() {
        return Ok(Arity::Variable);
    }
    let digits = inside.bytes().all(|byte| byte.is_ascii_digit());
    match inside.parse::<u32>() {
        Ok(count) if digits && count as usize <= MAX_MESSAGE_BYTES => Ok(Arity::Fixed(count)),
        _ => Err(SyntaxError::BadArrayLength(inside.to_owned())),
    }
}

/// Resolves a type name. A bare `Header` means std_msgs' in every package; other bare names are the package's own.
fn resolve_name(package: &str, bare: &str, brackets: &str) -> Result<String, SyntaxError> {
    if Primitive::from_name(bare).is_some() {
        return Ok(bare.to_owned());
    }
    if bare == "Header" && brackets.is_empty() {
        return Ok("std_msgs/Header".to_owned());
    }
    match bare.split_once('/') {
        None => {
            check_identifier(bare)?;
            Ok(format!("{package}/{bare}"))
        }
        Some((other, short)) => {
            check_identifier(other)?;
            check_identifier(short)?;
            Ok(bare.to_owned())
        }
    }
}

/// Checks that `name` is a letter followed by letters, digits and underscores.
pub(crate) fn check_identifier(name: &str) -> Result<(), SyntaxError> {
    let mut bytes = name.bytes();
    let legal = bytes.next().is_some_and(|first| first.is_ascii_alphabetic())
        && bytes.all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
    if !legal {
        return Err(SyntaxError::BadIdentifier(name.to_owned()));
    }
    if name.len() > MAX_NAME_BYTES {
        return Err(SyntaxError::LongName);
    }
    Ok(())
}
