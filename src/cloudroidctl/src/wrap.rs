//! Breaks lines at spaces, to fit a terminal.

use foreign::terminal;

/// Returns the number of characters that a terminal shows of `text`: colours (`ESC [ … m`) take no room.
pub fn visible_width(text: &str) -> usize {
    terminal::strip_colours(text).chars().count()
}

/// Breaks a line at spaces so that no part is wider than `width`, where its words allow; the parts after the first are
/// indented by `hanging` spaces.
pub fn wrap(line: &str, width: usize, hanging: usize) -> Vec<String> {
    let mut parts = Vec::new();
    let (mut part, mut used) = (String::new(), 0);
    // An indentation alone is no part.
    let mut has_words = false;
    for (number, word) in line.split(' ').enumerate() {
        let length = visible_width(word);
        if has_words && length > 0 && used + 1 + length > width {
            parts.push(std::mem::take(&mut part).trim_end().to_owned());
            part = " ".repeat(hanging);
            used = hanging;
        } else if number > 0 {
            part.push(' ');
            used += 1;
        }
        part.push_str(word);
        used += length;
        has_words |= length > 0;
    }
    parts.push(part.trim_end().to_owned());
    parts
}

/// Breaks the text of a table's cell: at spaces, or within words that are wider than `width`.
pub fn fold(text: &str, width: usize) -> Vec<String> {
    let mut parts = Vec::new();
    for part in wrap(text, width, 0) {
        let characters: Vec<char> = part.chars().collect();
        if characters.len() <= width {
            parts.push(part);
        } else {
            parts.extend(characters.chunks(width.max(1)).map(|piece| piece.iter().collect::<String>()));
        }
    }
    parts
}

/// Wraps the text of a help page. Continuation lines are indented like the text of their line: in a line with two
/// columns, as far as the second one.
pub fn wrap_help(text: &str, width: usize) -> String {
    let lines: Vec<String> = text.lines().flat_map(|line| wrap(line, width, hanging_of(line, width))).collect();
    let mut wrapped = lines.join("\n");
    if text.ends_with('\n') {
        wrapped.push('\n');
    }
    wrapped
}

/// Returns the indentation of the continuation lines of a line.
fn hanging_of(line: &str, width: usize) -> usize {
    let indent = line.len() - line.trim_start_matches(' ').len();
    let words = line[indent..].trim_end();
    let second = words.find("  ").map(|gap| {
        let column = words[gap..].len() - words[gap..].trim_start_matches(' ').len();
        indent + visible_width(&words[..gap]) + column
    });
    second.filter(|column| *column <= width / 2).unwrap_or(indent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_broken_at_spaces() {
        assert_eq!(wrap("one two three", 7, 2), ["one two", "  three"]);
        assert_eq!(wrap("    one two", 7, 4), ["    one", "    two"]);
        assert_eq!(wrap("abcdefghij k", 4, 0), ["abcdefghij", "k"], "a long word stays whole");
        assert_eq!(wrap("", 4, 0), [""]);
        assert_eq!(wrap("\x1b[1mone\x1b[0m two", 7, 0), ["\x1b[1mone\x1b[0m two"], "colours take no room");
        assert_eq!(fold("abcdefghij k", 4), ["abcd", "efgh", "ij", "k"]);
    }

    #[test]
    fn help_hangs_below_its_column() {
        let help = "  -q, --quiet  Print only names\n      Print one two\nend\n";
        let wrapped = "  -q, --quiet  Print only\n               names\n      Print one two\nend\n";
        assert_eq!(wrap_help(help, 30), wrapped);
    }
}
