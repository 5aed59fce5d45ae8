//! Estimates of the memory that JSON takes when it is parsed into a tree of values.

/// Bytes of one value in the list that holds it. Lists grow by doubling, and hold both the old and the new allocation
/// while they do.
const VALUE: usize = 96;
/// Bytes of a list that is not empty: its first allocation has room for four values.
const LIST: usize = 320;
/// Bytes of a map that is not empty: its first node has room for eleven members.
const MAP: usize = 1024;
/// Bytes of a member: its name, and its share of a node that is half full.
const MEMBER: usize = 192;
/// Bytes for each byte of text: a string is collected in a buffer that doubles, and is copied from there.
const TEXT: usize = 4;

/// Upper bound of the memory that parsing a JSON text into a tree of values takes.
///
/// It is computed before the text is parsed, from its brackets, commas and colons alone, so that a permit can be taken
/// first. It holds for trees whose values take up to 32 bytes, and for the records of this project's own protocols; the
/// tests of the crate `fuzz` compare it with what the allocator is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct JsonWeight {
    /// Bytes in memory, during parsing and afterwards.
    pub bytes: usize,
    /// Nesting depth of lists and maps.
    pub depth: usize,
}

impl JsonWeight {
    /// Largest ratio of the bytes of a tree to the bytes of its text.
    pub const MOST_TIMES: usize = 512;

    /// Returns the bytes needed by a reader that copies the rest of a value at each level, as serde does for an
    /// untagged enum that contains itself.
    pub fn bytes_if_copied(&self) -> usize {
        self.bytes.saturating_mul(self.depth + 1)
    }

    /// Estimates a text, valid JSON or not. Allocates nothing.
    pub fn estimate(text: &[u8]) -> Self {
        let mut weight = Self { bytes: VALUE + TEXT * text.len(), depth: 0 };
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

/// Advances past the closing quote of a string.
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
        let one = JsonWeight::estimate(b"1");
        assert_eq!(one.depth, 0);
        let text = JsonWeight::estimate(br#""[[{{,,::\"[[""#);
        assert_eq!(text.depth, 0, "what stands in a string is text");
        assert!(text.bytes < one.bytes + 100);
        let list = JsonWeight::estimate(b"[1,[2,3],4]");
        assert_eq!(list.depth, 2);
        assert_eq!(list.bytes, one.bytes + 4 * 10 + 5 * VALUE + 2 * LIST);
        let map = JsonWeight::estimate(br#"{"a":1}"#);
        assert!(map.bytes > list.bytes / 2 && map.depth == 1);
    }

    #[test]
    fn what_is_no_json_is_weighed_too() {
        for text in ["", "]]]]", "\"", "\"\\", "[[[[", "{\"a", "\u{fffd}"] {
            let weight = JsonWeight::estimate(text.as_bytes());
            assert!(weight.bytes <= VALUE + JsonWeight::MOST_TIMES * text.len());
        }
        let deep = "[".repeat(1_000_000);
        let weight = JsonWeight::estimate(deep.as_bytes());
        assert_eq!(weight.depth, 1_000_000);
        assert!(weight.bytes <= JsonWeight::MOST_TIMES * deep.len());
    }
}
