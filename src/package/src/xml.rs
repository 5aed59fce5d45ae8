//! XML of strangers, which is looked at before it is parsed: a parser compares each attribute of an element with the
//! others, and each namespace with those of all elements around. Nested declarations of namespaces in 64 KiB would keep
//! it busy for half a minute, in 1 MiB for a day.

use roxmltree::Document;

/// Maximum number of attributes of an element; those of packages and launch files have a dozen.
const MAX_ATTRIBUTES: usize = 256;
/// Maximum number of declarations of namespaces.
const MAX_NAMESPACES: usize = 32;

/// Parts of XML in which no tag begins, from their first to their last characters.
const NO_TAGS: [(&str, &str); 3] = [("<!--", "-->"), ("<![CDATA[", "]]>"), ("<?", "?>")];

/// A text that is not XML, or XML that is not parsed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{problem}")]
pub struct XmlError {
    /// Line, from 1.
    pub line: u32,
    /// Column, from 1.
    pub column: u32,
    /// The problem.
    pub problem: String,
}

/// Parses a text.
///
/// # Errors
/// If it is no XML, or has elements with very many attributes, or very many namespaces.
pub fn parse(text: &str) -> Result<Document<'_>, XmlError> {
    let refused = |at: usize, most: usize, what: &str| {
        let before = &text[..at];
        let line = before.rfind('\n').map_or(0, |end| end + 1);
        let count = |number: usize| u32::try_from(number).unwrap_or(u32::MAX).saturating_add(1);
        XmlError {
            line: count(before.matches('\n').count()),
            column: count(before[line..].chars().count()),
            problem: format!("more than {most} {what}"),
        }
    };
    if let Some((at, _)) = text.match_indices("xmlns").nth(MAX_NAMESPACES) {
        return Err(refused(at, MAX_NAMESPACES, "declarations of namespaces (xmlns)"));
    }
    if let Some(at) = find_laden_tag(text) {
        return Err(refused(at, MAX_ATTRIBUTES, "attributes of an element"));
    }
    Document::parse(text).map_err(|error| {
        let position = error.pos();
        let told = error.to_string();
        // The position is already part of the error.
        let problem = told.strip_suffix(&format!(" at {position}")).unwrap_or(&told);
        XmlError { line: position.row, column: position.col, problem: format!("malformed XML: {problem}") }
    })
}

/// Returns the place of a tag with too many attributes. What is no XML is left to the parser, which stops at its first
/// mistake.
fn find_laden_tag(text: &str) -> Option<usize> {
    let mut at = 0;
    while let Some(begin) = text[at..].find('<') {
        at += begin;
        let rest = &text[at..];
        if let Some((opening, closing)) = NO_TAGS.iter().find(|(opening, _)| rest.starts_with(opening)) {
            at += opening.len() + rest[opening.len()..].find(closing)? + closing.len();
            continue;
        }
        let (attributes, length) = measure_tag(rest);
        if attributes > MAX_ATTRIBUTES {
            return Some(at);
        }
        at += length;
    }
    None
}

/// Returns the number of quoted values in the tag at the beginning of a text, and the length of the tag.
fn measure_tag(text: &str) -> (usize, usize) {
    let (mut quote, mut values) = (None, 0);
    for (at, byte) in text.bytes().enumerate() {
        match (quote, byte) {
            (Some(open), _) if open == byte => quote = None,
            (Some(_), _) => {}
            (None, b'"' | b'\'') => {
                quote = Some(byte);
                values += 1;
            }
            (None, b'>') => return (values, at + 1),
            (None, _) => {}
        }
    }
    (values, text.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn attributes(count: usize) -> String {
        (0..count).map(|number| format!(" a{number}='>'")).collect()
    }

    #[test]
    fn usual_files_are_parsed() {
        let text = format!(
            "<?xml version='1.0'?>\n<!-- <a {} -->\n<package xmlns:xsi='u'><a{}/><![CDATA[<b]]></package>",
            attributes(300),
            attributes(MAX_ATTRIBUTES)
        );
        assert_eq!(parse(&text).expect("it is XML").root_element().tag_name().name(), "package");
        let wrong = parse("<a>\n<b></a>").expect_err("it is none");
        assert_eq!((wrong.line, wrong.column), (2, 4));
        assert!(wrong.problem.starts_with("malformed XML: "), "{wrong}");
    }

    #[test]
    fn what_would_keep_a_parser_busy_is_refused() {
        let laden = format!("<a>\n  <b{}/></a>", attributes(MAX_ATTRIBUTES + 1));
        let refused = parse(&laden).expect_err("too many");
        assert_eq!((refused.line, refused.column), (2, 3));
        assert_eq!(refused.to_string(), "more than 256 attributes of an element");
        let nested: String = (0..50_000).map(|number| format!("<a xmlns:b{number}='u'>")).collect();
        let refused = parse(&nested).expect_err("too many");
        assert_eq!(refused.to_string(), "more than 32 declarations of namespaces (xmlns)");
    }
}
