//! Makes text from nodes, compilers and servers safe to print. Terminals interpret control sequences in text: these can
//! rename the window, type on the command line, or make a line look like another one.
//!
//! Control characters are shown as visible text. Colours (SGR, `ESC [ … m`) are kept on a terminal, because compilers'
//! colours are useful, and are reset at the end of their line.

use std::borrow::Cow;

/// Maximum length of a colour's parameters in characters.
const LONGEST_COLOUR: usize = 32;

/// Escapes control sequences in `text`. Line ends and tabs are kept; so are colours if `colours` is set.
pub fn escape(text: &str, colours: bool) -> Cow<'_, str> {
    if !text.contains(is_dangerous) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    let mut coloured = false;
    let mut rest = text;
    while let Some(c) = rest.chars().next() {
        if let Some(colour) = colour(rest).filter(|_| colours) {
            out.push_str(colour);
            coloured = true;
            rest = &rest[colour.len()..];
            continue;
        }
        if c == '\n' && coloured {
            out.push_str("\x1b[0m");
            coloured = false;
        }
        if is_dangerous(c) {
            out.extend(c.escape_default());
        } else {
            out.push(c);
        }
        rest = &rest[c.len_utf8()..];
    }
    if coloured {
        out.push_str("\x1b[0m");
    }
    Cow::Owned(out)
}

/// Removes the colours from `text`.
pub fn strip_colours(text: &str) -> Cow<'_, str> {
    if !text.contains('\x1b') {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(at) = rest.find('\x1b') {
        let length = colour(&rest[at..]).map_or(0, str::len);
        // What is no colour stays.
        out.push_str(&rest[..if length == 0 { at + 1 } else { at }]);
        rest = &rest[at + length.max(1)..];
    }
    out.push_str(rest);
    Cow::Owned(out)
}

/// Escapes control characters that JSON allows in its strings as `\u…`; the meaning is the same.
pub fn escape_json(json: &str) -> Cow<'_, str> {
    if !json.contains(is_dangerous) {
        return Cow::Borrowed(json);
    }
    let mut out = String::with_capacity(json.len() + 16);
    for c in json.chars() {
        if is_dangerous(c) {
            out.push_str(&format!("\\u{:04x}", u32::from(c)));
        } else {
            out.push(c);
        }
    }
    Cow::Owned(out)
}

/// Returns whether `c` is a control character (C0, DEL, C1) other than line end and tab, or changes the direction of
/// text.
fn is_dangerous(c: char) -> bool {
    (c.is_control() && c != '\n' && c != '\t')
        || matches!(c, '\u{202a}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{200e}' | '\u{200f}' | '\u{61c}')
}

/// Returns the colour sequence that `text` starts with.
fn colour(text: &str) -> Option<&str> {
    let parameters = text.strip_prefix("\x1b[")?;
    let end = parameters.find(|c: char| !(c.is_ascii_digit() || c == ';'))?;
    let ends_as_one = parameters[end..].starts_with('m');
    (ends_as_one && end <= LONGEST_COLOUR).then(|| &text[.."\x1b[".len() + end + 1])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_colours_are_stripped() {
        for (text, plain) in [
            ("plain", "plain"),
            ("\x1b[0m[ INFO] a\x1b[1;33mb\x1b[0m", "[ INFO] ab"),
            ("\x1b[2J\x1b[31ma", "\x1b[2Ja"),
            ("a\x1b[31", "a\x1b[31"),
        ] {
            assert_eq!(strip_colours(text), plain);
        }
    }

    #[test]
    fn a_terminal_is_told_nothing_by_a_log() {
        for (text, shown) in [
            ("plain äöü\tand\nlines", "plain äöü\tand\nlines"),
            ("\x1b]0;title\x07", "\\u{1b}]0;title\\u{7}"),
            ("\x1b[2J\x1b[1;1H", "\\u{1b}[2J\\u{1b}[1;1H"),
            ("safe\rEVIL", "safe\\rEVIL"),
            ("\u{9b}31m\u{9d}0;x\u{9c}", "\\u{9b}31m\\u{9d}0;x\\u{9c}"),
            ("a\u{202e}b", "a\\u{202e}b"),
            ("back\x08\x7f", "back\\u{8}\\u{7f}"),
            // Unterminated, or not a colour.
            ("\x1b[31", "\\u{1b}[31"),
            ("\x1b[?25lm", "\\u{1b}[?25lm"),
        ] {
            assert_eq!(escape(text, true), shown);
            assert_eq!(escape(text, false), shown);
        }
    }

    #[test]
    fn colours_stay_on_a_terminal_and_end_with_their_line() {
        let text = "\x1b[01;31merror\x1b[0m: x\nnext \x1b[1mbold\nplain";
        assert_eq!(escape(text, true), "\x1b[01;31merror\x1b[0m: x\x1b[0m\nnext \x1b[1mbold\x1b[0m\nplain");
        assert_eq!(escape("\x1b[31mred", false), "\\u{1b}[31mred", "a file has no colours");
    }

    #[test]
    fn json_means_the_same() {
        let value = serde_json::json!({"line": "a\u{9b}b\u{7f}\u{202e}\x1b[2J", "tab": "\t"});
        let text = serde_json::to_string_pretty(&value).expect("json");
        let printed = escape_json(&text);
        assert!(!printed.contains(is_dangerous), "{printed:?}");
        let read: serde_json::Value = serde_json::from_str(&printed).expect("json");
        assert_eq!(read, value);
    }
}
