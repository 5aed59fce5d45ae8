//! Answers that are lists of boxes: the threads of a node find them in any order, so that equal answers may differ in
//! their order.

use std::hash::{DefaultHasher, Hash, Hasher};

use ros::bus::SerializedMessage;

use crate::recording::read_header;

/// A header and an array of boxes.
const LIST: &str = "opencv_apps/RectArrayStamped";
/// Bytes of a box: x, y, width and height as float64.
const BOX: usize = 32;

/// Hashes the header without its sequence number and the sorted boxes; `None` for other answers.
pub fn digest_sorted(message: &SerializedMessage) -> Option<u64> {
    (message.wire_type.name == LIST).then(|| digest_boxes(&message.bytes)).flatten()
}

fn digest_boxes(bytes: &[u8]) -> Option<u64> {
    let from = read_header(bytes)?.end;
    let count = u32::from_le_bytes(bytes.get(from..from + 4)?.try_into().ok()?);
    let rest = &bytes[from + 4..];
    if rest.len() != count as usize * BOX {
        return None;
    }
    let mut boxes: Vec<&[u8]> = rest.chunks_exact(BOX).collect();
    boxes.sort_unstable();
    let mut hasher = DefaultHasher::new();
    bytes[4..from].hash(&mut hasher);
    boxes.hash(&mut hasher);
    Some(hasher.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(boxes: &[[f64; 4]]) -> Vec<u8> {
        let mut bytes = Vec::new();
        for word in [7_u32, 1001, 0, 0, boxes.len() as u32] {
            bytes.extend(word.to_le_bytes());
        }
        let numbers = boxes.as_flattened().iter();
        numbers.for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes
    }

    #[test]
    fn boxes_are_equal_in_any_order() {
        let (one, other) = ([1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]);
        let told = digest_boxes(&list(&[one, other]));
        assert!(told.is_some());
        assert_eq!(told, digest_boxes(&list(&[other, one])));
        assert_ne!(told, digest_boxes(&list(&[one, one])));
        assert_ne!(told, digest_boxes(&list(&[one])));
    }

    #[test]
    fn what_is_no_list_is_not_taken_for_one() {
        let mut bytes = list(&[[1.0; 4]]);
        bytes.pop();
        assert_eq!(digest_boxes(&bytes), None);
        assert_eq!(digest_boxes(b"short"), None);
    }
}
