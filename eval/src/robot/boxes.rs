//! Answers that are lists of boxes: threads of a node find them in whatever order, so that two equal answers may differ in it.

use std::hash::{DefaultHasher, Hash, Hasher};

use ros::bus::Message;

use crate::recording::header;

/// A header and an array of boxes.
const LIST: &str = "opencv_apps/RectArrayStamped";
/// Of a box: x, y, width and height as float64.
const BOX: usize = 32;

/// Of the header without its sequence number and of the boxes in order of size; none of other answers.
pub fn digest(message: &Message) -> Option<u64> {
    (message.wire_type.name == LIST)
        .then(|| of(&message.bytes))
        .flatten()
}

fn of(bytes: &[u8]) -> Option<u64> {
    let from = header(bytes)?.end;
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
        let told = of(&list(&[one, other]));
        assert!(told.is_some());
        assert_eq!(told, of(&list(&[other, one])));
        assert_ne!(told, of(&list(&[one, one])));
        assert_ne!(told, of(&list(&[one])));
    }

    #[test]
    fn what_is_no_list_is_not_taken_for_one() {
        let mut bytes = list(&[[1.0; 4]]);
        bytes.pop();
        assert_eq!(of(&bytes), None);
        assert_eq!(of(b"short"), None);
    }
}
