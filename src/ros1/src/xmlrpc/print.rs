//! Values → XML-RPC documents, in the subset that XmlRpcpp reads: every type spelled out, no white space between
//! elements, no numeric character references.

use std::fmt::Write as _;

use super::{Fault, Value};

const PROLOGUE: &str = "<?xml version=\"1.0\"?>\n";

/// Returns the document that calls `method`.
pub fn print_call(method: &str, params: &[Value]) -> String {
    let mut out = String::with_capacity(256);
    out.push_str(PROLOGUE);
    out.push_str("<methodCall><methodName>");
    escape(&mut out, method);
    out.push_str("</methodName><params>");
    for param in params {
        out.push_str("<param>");
        print_value(&mut out, param);
        out.push_str("</param>");
    }
    out.push_str("</params></methodCall>\n");
    out
}

/// Returns the document that answers with `value`.
pub fn print_response(value: &Value) -> String {
    let mut out = String::with_capacity(256);
    out.push_str(PROLOGUE);
    out.push_str("<methodResponse><params><param>");
    print_value(&mut out, value);
    out.push_str("</param></params></methodResponse>\n");
    out
}

/// Returns the document that answers with a fault.
pub fn print_fault(fault: &Fault) -> String {
    let mut out = String::with_capacity(256);
    out.push_str(PROLOGUE);
    out.push_str("<methodResponse><fault>");
    print_value(&mut out, &fault_value(fault));
    out.push_str("</fault></methodResponse>\n");
    out
}

/// Converts a fault to the struct that represents it; also used for entries of a `system.multicall` answer.
pub(crate) fn fault_value(fault: &Fault) -> Value {
    Value::Struct(
        [
            ("faultCode".to_owned(), Value::Int(fault.code)),
            ("faultString".to_owned(), Value::from(fault.text.as_str())),
        ]
        .into(),
    )
}

fn print_value(out: &mut String, value: &Value) {
    out.push_str("<value>");
    match value {
        Value::Int(number) => {
            out.push_str("<int>");
            out.push_str(itoa::Buffer::new().format(*number));
            out.push_str("</int>");
        }
        Value::Bool(truth) => {
            out.push_str(if *truth { "<boolean>1</boolean>" } else { "<boolean>0</boolean>" });
        }
        Value::String(text) => {
            out.push_str("<string>");
            escape(out, text);
            out.push_str("</string>");
        }
        Value::Double(number) => {
            out.push_str("<double>");
            print_double(out, *number);
            out.push_str("</double>");
        }
        Value::Base64(bytes) => {
            out.push_str("<base64>");
            base64_simd::STANDARD.encode_append(bytes, out);
            out.push_str("</base64>");
        }
        Value::DateTime(text) => {
            out.push_str("<dateTime.iso8601>");
            escape(out, text);
            out.push_str("</dateTime.iso8601>");
        }
        Value::Array(elements) => {
            out.push_str("<array><data>");
            for element in elements {
                print_value(out, element);
            }
            out.push_str("</data></array>");
        }
        Value::Struct(members) => {
            out.push_str("<struct>");
            for (name, member) in members {
                out.push_str("<member><name>");
                escape(out, name);
                out.push_str("</name>");
                print_value(out, member);
                out.push_str("</member>");
            }
            out.push_str("</struct>");
        }
        Value::Nil => out.push_str("<nil/>"),
    }
    out.push_str("</value>");
}

/// Writes the shortest text that reads back as the same double; `inf` and `nan` as both `strtod` and Python read them.
fn print_double(out: &mut String, number: f64) {
    if number.is_finite() {
        out.push_str(zmij::Buffer::new().format_finite(number));
    } else if number.is_nan() {
        out.push_str("nan");
    } else {
        let _ = write!(out, "{}inf", if number < 0.0 { "-" } else { "" });
    }
}

/// Escapes text. Characters that XML does not allow become U+FFFD: one bad string must not spoil the whole answer.
fn escape(out: &mut String, text: &str) {
    for character in text.chars() {
        match character {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            '\t' | '\n' | '\r' => out.push(character),
            '\0'..='\u{1f}' | '\u{fffe}' | '\u{ffff}' => out.push('\u{fffd}'),
            _ => out.push(character),
        }
    }
}
