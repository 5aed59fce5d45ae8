//! Error messages of the parser, translated into the terms of the configuration file.

/// Texts in messages of `toml` and `serde` that name types, and their replacements.
const REPLACEMENTS: [(&str, &str); 14] = [
    ("expected usize", "expected a whole number, 0 or greater"),
    ("expected u64", "expected a whole number, 0 or greater"),
    ("expected u32", "expected a whole number, 0 or greater"),
    ("expected u16", "expected a whole number, 0 or greater"),
    ("expected i32", "expected a whole number"),
    ("expected i64", "expected a whole number"),
    ("expected f64", "expected a number"),
    ("expected a boolean", "expected true or false"),
    ("expected a sequence", "expected a list, such as [\"one\", \"two\"]"),
    ("expected a map", "expected a table, such as [limits]"),
    ("wanted string or table", "expected a string in quotes"),
    ("invalid type: ", ""),
    ("data did not match any variant of untagged enum Written", "expected a number or a string in quotes"),
    ("unit variant", "a plain string"),
];

/// Returns an error message without the names of this program's types.
pub(super) fn plain(message: &str) -> String {
    let mut text = message.to_owned();
    for (theirs, ours) in REPLACEMENTS {
        text = text.replace(theirs, ours);
    }
    // A section's name in the message is its type's name in lower case.
    while let Some(at) = text.find("expected struct ") {
        let rest = &text[at + "expected struct ".len()..];
        let end = rest.find(|c: char| !c.is_alphanumeric());
        let end = end.unwrap_or(rest.len());
        text = format!("{}expected a table{}", &text[..at], &rest[end..]);
    }
    text
}

#[cfg(test)]
mod tests {
    use crate::config::Config;

    #[test]
    fn no_error_names_types_of_this_program() {
        for (text, words) in [
            ("[capacity]\nqueue = \"many\"", "expected a whole number, 0 or greater"),
            ("[capacity]\nqueue = -1", "expected a whole number, 0 or greater"),
            ("[capacity]\ncontroller = true", "expected a string in quotes"),
            ("[capacity]\novercommit = \"two\"", "expected a number"),
            ("[class]\nurgent = 3", "expected a table"),
            ("class = 3", "expected a table"),
            ("limits = 3", "expected a table"),
            ("tokens = 3", "expected a list"),
            ("[servant]\ngrace = true", "expected a number or a string in quotes"),
            ("[class.urgent]\npriority = 1.5", "expected a whole number"),
        ] {
            let error = Config::parse(text).expect_err(text);
            let message = format!("{error:#}");
            assert!(message.contains(words), "{text}: {message}");
            for theirs in ["usize", "u64", "i32", "f64", "struct", "untagged", "variant", "wanted"] {
                assert!(!message.contains(theirs), "{text}: {message}");
            }
            // The message still names the line.
            assert!(message.contains("line "), "{message}");
        }
    }
}
