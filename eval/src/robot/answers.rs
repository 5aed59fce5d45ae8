//! Reads answers and maps from their serialized form.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::time::Duration;

use ros::bus::SerializedMessage;
use tokio::time::Instant as At;

use super::boxes;
use super::plan::FIRST;
use crate::recording::{read_floats, read_header, read_pose};
use crate::trace::{MapGrid, RequestSample};

pub(super) fn request_number(message: &SerializedMessage) -> Option<u32> {
    read_header(&message.bytes).map(|header| header.stamp.0)
}

pub(super) fn fill_answer(request: &mut RequestSample, message: &SerializedMessage, after: Duration) {
    request.response = Some(after.as_secs_f64());
    request.digest = Some(digest_message(&message.bytes));
    request.boxes = boxes::digest_sorted(message);
    request.pose = read_pose(&message.bytes);
}

/// Assigns an answer to its request, given the times at which requests were `sent`; the first answer counts.
pub(super) fn record_answer(requests: &mut [RequestSample], sent: &[At], message: &SerializedMessage) {
    let index = request_number(message).and_then(|number| number.checked_sub(FIRST));
    let index = index.map_or(usize::MAX, |index| index as usize);
    if let (Some(request), Some(sent)) = (requests.get_mut(index), sent.get(index)) {
        request.answers += 1;
        if request.response.is_none() {
            fill_answer(request, message, sent.elapsed());
        }
    }
}

/// Hashes a message without its header's sequence number.
pub fn digest_message(bytes: &[u8]) -> u64 {
    let mut hasher = DefaultHasher::new();
    bytes.get(4..).hash(&mut hasher);
    hasher.finish()
}

/// Reads a serialized `nav_msgs/OccupancyGrid`.
pub(super) fn read_grid(bytes: &[u8]) -> Option<MapGrid> {
    let at = read_header(bytes)?.end;
    let word = |at: usize| Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    // map_load_time, resolution, width, height, origin (seven float64), data
    let resolution = f32::from_le_bytes(bytes.get(at + 8..at + 12)?.try_into().ok()?);
    let (width, height) = (word(at + 12)? as usize, word(at + 16)? as usize);
    let origin = read_floats(bytes, at + 20, 2)?;
    let count = word(at + 76)? as usize;
    let cells = bytes.get(at + 80..at + 80 + count)?;
    (count == width * height).then(|| MapGrid {
        width,
        height,
        resolution: resolution.into(),
        origin: [origin[0], origin[1]],
        cells: cells.iter().map(|cell| *cell as i8).collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_is_read_by_rows() {
        let mut bytes = Vec::new();
        [1_u32, 2, 3, 0].iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        bytes.extend([0; 8]);
        bytes.extend(0.05_f32.to_le_bytes());
        [2_u32, 3].iter().for_each(|word| bytes.extend(word.to_le_bytes()));
        [-1.0_f64, -2.0, 0.0, 0.0, 0.0, 0.0, 1.0].iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        bytes.extend(6_u32.to_le_bytes());
        bytes.extend([255, 0, 100, 0, 0, 0]);
        let map = read_grid(&bytes).expect("a map");
        assert_eq!((map.width, map.height, map.origin), (2, 3, [-1.0, -2.0]));
        assert_eq!(map.cells, [-1, 0, 100, 0, 0, 0]);
        assert_eq!(read_grid(&bytes[..bytes.len() - 1]), None);
    }
}
