//! The bytes beside the colours of a picture, kept exact where the colours are lossy: the padding between rows, and
//! alpha.

use crate::Error;
use crate::column::{put_packed, take_packed};
use crate::layout::ImageLayout;
use crate::wire::FrameCursor;

/// Appends the last `step - row` bytes of every `step` bytes of `data`.
pub(crate) fn put_padding(data: &[u8], row: usize, step: usize, out: &mut Vec<u8>) {
    if row == step {
        return;
    }
    let padding: Vec<u8> = data.chunks_exact(step).flat_map(|line| &line[row..]).copied().collect();
    if padding.iter().all(|&byte| byte == 0) {
        out.push(0);
    } else {
        out.push(1);
        put_packed(&padding, out);
    }
}

/// Reads what [`put_padding`] wrote into `data`.
pub(crate) fn take_padding(input: &mut FrameCursor<'_>, data: &mut [u8], row: usize, step: usize) -> Result<(), Error> {
    if row == step {
        return Ok(());
    }
    match input.byte()? {
        0 => data.chunks_exact_mut(step).for_each(|line| line[row..].fill(0)),
        1 => {
            let size = (step - row) * (data.len() / step);
            let padding = take_packed(input, size)?;
            if padding.len() != size {
                return Err(Error::Corrupt("padding of another size"));
            }
            for (line, padding) in data.chunks_exact_mut(step).zip(padding.chunks_exact(step - row)) {
                line[row..].copy_from_slice(padding);
            }
        }
        _ => return Err(Error::Corrupt("padding of an unknown kind")),
    }
    Ok(())
}

/// Appends the last of every four channels.
pub(crate) fn put_alpha(data: &[u8], layout: &ImageLayout, out: &mut Vec<u8>) {
    let rows = data.chunks_exact(layout.step);
    let alpha: Vec<u8> = rows.flat_map(|line| line[..layout.row_bytes()].iter().skip(3).step_by(4)).copied().collect();
    put_packed(&alpha, out);
}

/// Reads what [`put_alpha`] wrote into `data`.
pub(crate) fn take_alpha(input: &mut FrameCursor<'_>, data: &mut [u8], layout: &ImageLayout) -> Result<(), Error> {
    let count = layout.width * layout.height;
    let alpha = take_packed(input, count)?;
    if alpha.len() != count {
        return Err(Error::Corrupt("alpha of another size"));
    }
    for (line, alpha) in data.chunks_exact_mut(layout.step).zip(alpha.chunks_exact(layout.width)) {
        for (pixel, &alpha) in line[..layout.row_bytes()].chunks_exact_mut(4).zip(alpha) {
            pixel[3] = alpha;
        }
    }
    Ok(())
}
