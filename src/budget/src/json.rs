//! What JSON takes in memory when it is read into a tree of values.

/// What one value takes in the list that holds it: lists grow by doubling, and have their old and their new place while they do.
const VALUE: usize = 96;
/// A list that holds something: it begins with room for four values.
const LIST: usize = 320;
/// A map that holds something: its first node has room for eleven members.
const MAP: usize = 1024;
/// A member's name, and its part of a node that is half full.
const MEMBER: usize = 192;
/// A text is gathered in a buffer that doubles, and copied from there.
const TEXT: usize = 4;

/// What reading a JSON text into a tree of values takes, at most.
///
/// It is known before the text is read, from its brackets, commas and colons alone, so that a permit for it can be taken first. It holds
/// for trees whose values take up to 32 bytes, and for the records of this project's own protocols; the tests of the crate `fuzz` compare
/// it with what an allocator is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JsonWeight {
    /// Bytes in memory, while the text is read and afterwards.
    pub bytes: usize,
    /// Lists and maps within each other.
    pub depth: usize,
}

impl JsonWeight {
    /// A tree takes at most so many times the bytes of its text.
    pub const MOST_TIMES: usize = 512;

    /// What it takes where a reader copies the rest of a value at each of its levels, as serde's does of an untagged enum that holds itself.
    pub fn bytes_if_copied(&self) -> usize {
        self.bytes.saturating_mul(self.depth + 1)
    }

    /// Weighs a text, whether it is JSON or not. Allocates nothing.
    pub fn of(text: &[u8]) -> Self {
        let mut weight = Self {
            bytes: VALUE + TEXT * text.len(),
            depth: 0,
        };
        let mut open: usize = 0;
        let mut rest = text.iter();
        while let Some(byte) = rest.next() {
            match byte {
                b'"' => skip_string(&mut rest),
                b',' => weight.bytes += VALUE,
                b':' => weight.bytes += MEMBER,
                b'[' | b'{' => {
                    weight.bytes += VALUE + if *byte == b'[' { LIST } else { MAP };
                    open += 1;
                    weight.depth = weight.depth.max(open);
                }
                b']' | b'}' => open = open.saturating_sub(1),
                _ => {}
            }
        }
        weight
    }
}

/// Goes on behind the end of a string.
fn skip_string(rest: &mut std::slice::Iter<'_, u8>) {
    while let Some(byte) = rest.next() {
        match byte {
            b'"' => return,
            b'\\' => drop(rest.next()),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_weigh_their_length_and_trees_their_values() {
        let one = JsonWeight::of(b"1");
        assert_eq!(one.depth, 0);
        let text = JsonWeight::of(br#""[[{{,,::\"[[""#);
        assert_eq!(text.depth, 0, "what stands in a string is text");
        assert!(text.bytes < one.bytes + 100);
        let list = JsonWeight::of(b"[1,[2,3],4]");
        assert_eq!(list.depth, 2);
        assert_eq!(list.bytes, one.bytes + 4 * 10 + 5 * VALUE + 2 * LIST);
        let map = JsonWeight::of(br#"{"a":1}"#);
        assert!(map.bytes > list.bytes / 2 && map.depth == 1);
    }

    #[test]
    fn what_is_no_json_is_weighed_too() {
        for text in ["", "]]]]", "\"", "\"\\", "[[[[", "{\"a", "\u{fffd}"] {
            let weight = JsonWeight::of(text.as_bytes());
            assert!(weight.bytes <= VALUE + JsonWeight::MOST_TIMES * text.len());
        }
        let deep = "[".repeat(1_000_000);
        let weight = JsonWeight::of(deep.as_bytes());
        assert_eq!(weight.depth, 1_000_000);
        assert!(weight.bytes <= JsonWeight::MOST_TIMES * deep.len());
    }
}
