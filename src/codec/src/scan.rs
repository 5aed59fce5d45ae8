//! Codec for `sensor_msgs/LaserScan`: ranges and intensities are columns of floats.
//!
//! Body: `head · ranges · intensities`.

use crate::Error;
use crate::column::{self, Shape};
use crate::layout::ScanLayout;
use crate::wire::{FrameCursor, put_block};

/// Appends the body of `message`; `None` if its lengths do not add up after all.
pub(crate) fn encode(message: &[u8], layout: &ScanLayout, out: &mut Vec<u8>) -> Option<()> {
    let middle = layout.intensity_length_offset();
    let told = message.get(middle..middle + 4)?;
    if told != (layout.intensities as u32).to_le_bytes() {
        return None;
    }
    put_block(out, &message[..layout.head]);
    column::encode_floats(&read_words(&message[layout.head..middle]), Shape::Sequence(layout.ranges), out);
    column::encode_floats(&read_words(&message[middle + 4..]), Shape::Sequence(layout.intensities), out);
    Some(())
}

/// The inverse of [`encode`]: appends a message of `total` bytes to `out`.
pub(crate) fn decode(input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
    let head = input.block()?;
    let layout = ScanLayout::read(head, total)
        .filter(|layout| layout.head == head.len())
        .ok_or(Error::Corrupt("a head that is not a scan's"))?;
    out.extend_from_slice(head);
    let ranges = column::decode_floats(input, Shape::Sequence(layout.ranges))?;
    out.extend(ranges.into_iter().flat_map(u32::to_le_bytes));
    out.extend_from_slice(&(layout.intensities as u32).to_le_bytes());
    let intensities = column::decode_floats(input, Shape::Sequence(layout.intensities))?;
    out.extend(intensities.into_iter().flat_map(u32::to_le_bytes));
    Ok(())
}

pub(crate) fn read_words(bytes: &[u8]) -> Vec<u32> {
    bytes.chunks_exact(4).map(|bytes| u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]])).collect()
}
