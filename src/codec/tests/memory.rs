//! Memory bounds of decoders: memory in proportion to the declared message, whatever the frame says.

use codec::{Codec, Decoder, Encoder, Error, JpegOptions, Schema};
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;

thread_local! {
    static NOW: Cell<usize> = const { Cell::new(0) };
    static PEAK: Cell<usize> = const { Cell::new(0) };
}

/// The system's allocator, counting the bytes that each thread holds.
struct Counting;

fn count(taken: usize, given: usize) {
    NOW.with(|now| {
        now.set((now.get() + taken).saturating_sub(given));
        PEAK.with(|peak| peak.set(peak.get().max(now.get())));
    });
}

// SAFETY: every call goes to the system's allocator as it is; counting neither allocates nor unwinds.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size(), 0);
        // SAFETY: the caller's promises are passed on.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(0, layout.size());
        // SAFETY: the caller's promises are passed on.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        count(size, layout.size());
        // SAFETY: the caller's promises are passed on.
        unsafe { System.realloc(pointer, layout, size) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// Returns the result of `work`, and the additional memory held at its peak.
fn peak<T>(work: impl FnOnce() -> T) -> (T, usize) {
    let before = NOW.with(Cell::get);
    PEAK.with(|peak| peak.set(before));
    let result = work();
    (result, PEAK.with(Cell::get) - before)
}

/// Bytes for tables and contexts, independent of the message's size.
const TABLES: usize = 2 << 20;
/// Peak bytes per byte of message: samples of one byte are processed as numbers of two and four.
const FACTOR: usize = 16;

fn message(head: &[&[u8]], data: usize, tail: &[u8]) -> Vec<u8> {
    let mut message = vec![0; 16];
    head.iter().for_each(|part| message.extend_from_slice(part));
    message.extend_from_slice(&(data as u32).to_le_bytes());
    message.extend((0..data).map(|at| (at / 7 + at * 7919 % 5) as u8));
    message.extend_from_slice(tail);
    message
}

/// Large messages of every kind.
fn messages() -> Vec<(Schema, Vec<u8>)> {
    let size = |width: u32, height: u32| [height.to_le_bytes(), width.to_le_bytes()].concat();
    let image = |encoding: &str, bytes: u32| {
        let encoding = [&(encoding.len() as u32).to_le_bytes(), encoding.as_bytes()].concat();
        let step = [&[0], &(1000 * bytes).to_le_bytes()[..]].concat();
        let data = 1000 * bytes as usize * 800;
        message(&[&size(1000, 800), &encoding, &step], data, &[])
    };
    let grid = {
        let info = [[0; 8].as_slice(), &0.5f32.to_le_bytes()].concat();
        let size = [1000u32.to_le_bytes(), 900u32.to_le_bytes()].concat();
        message(&[&info, &size, &[0; 56]], 900_000, &[])
    };
    let scan = message(&[&[0; 28]], 0, &[])[..44].to_vec();
    let floats = |count: u32| {
        let values = (0..count).flat_map(|at| (at as f32 * 0.001).to_le_bytes());
        [&count.to_le_bytes()[..], &values.collect::<Vec<u8>>()].concat()
    };
    let scan = [scan, floats(200_000), floats(200_000)].concat();
    let cloud = |fields: &[(&str, u32, u8)], step: u32, width: u32, height: u32| {
        let mut head = size(width, height);
        head.extend_from_slice(&(fields.len() as u32).to_le_bytes());
        for (name, offset, number) in fields {
            head.extend_from_slice(&(name.len() as u32).to_le_bytes());
            head.extend_from_slice(name.as_bytes());
            head.extend_from_slice(&offset.to_le_bytes());
            head.push(*number);
            head.extend_from_slice(&1u32.to_le_bytes());
        }
        head.push(0);
        head.extend_from_slice(&step.to_le_bytes());
        head.extend_from_slice(&(step * width).to_le_bytes());
        message(&[&head], (step * width * height) as usize, &[1])
    };
    let xyz = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("ring", 12, 2)];
    vec![
        (Schema::Image, image("rgb8", 3)),
        (Schema::Image, image("mono8", 1)),
        (Schema::Image, image("bayer_rggb8", 1)),
        (Schema::Image, image("16UC1", 2)),
        (Schema::Image, image("32FC1", 4)),
        (Schema::OccupancyGrid, grid),
        (Schema::LaserScan, scan),
        (Schema::PointCloud2, cloud(&xyz, 16, 300, 200)),
        (Schema::PointCloud2, cloud(&xyz, 16, 60_000, 1)),
        (Schema::PointCloud2, cloud(&[("i", 0, 2)], 1, 1_000_000, 1)),
        (Schema::PointCloud2, cloud(&[("r", 0, 4)], 2, 1000, 500)),
        (Schema::PointCloud2, cloud(&[("t", 0, 8)], 8, 1000, 100)),
        (Schema::PointCloud2, cloud(&[("rgb", 0, 7)], 4, 1000, 200)),
        (Schema::PointCloud2, cloud(&[], 3, 1000, 200)),
        // Margins are relatively largest with columns of width one.
        (Schema::PointCloud2, cloud(&[("i", 0, 2)], 1, 1, 300_000)),
        (Schema::PointCloud2, cloud(&[("r", 0, 4)], 2, 1, 200_000)),
        (Schema::PointCloud2, cloud(&[("x", 0, 7)], 4, 1, 100_000)),
    ]
}

#[test]
fn decoding_takes_memory_in_proportion_to_the_message() {
    for (schema, message) in messages() {
        for codec in [Codec::for_schema(schema), Codec::Zlib(1), Codec::Zstd(1), Codec::Raw] {
            let mut frame = Vec::new();
            let encoded = Encoder::new(schema).encode(codec, &message, &mut frame);
            let (back, taken) = peak(|| {
                let mut out = Vec::new();
                Decoder::new(message.len()).decode(&frame, &mut out).unwrap();
                out
            });
            assert_eq!(back, message);
            assert!(
                taken <= FACTOR * message.len() + TABLES,
                "{schema:?} of {} bytes by {}: {taken}",
                message.len(),
                encoded.codec
            );
        }
    }
}

#[test]
fn a_frame_that_lies_takes_no_more() {
    for (schema, message) in messages() {
        let mut frame = Vec::new();
        Encoder::new(schema).encode(Codec::for_schema(schema), &message, &mut frame);
        // Cut short at many places, and with one byte changed.
        for part in (1..40).step_by(3) {
            let at = if part < 20 { part * 8 } else { frame.len() * part / 40 };
            let at = at.min(frame.len() - 1);
            let mut damaged = frame.clone();
            damaged[at] ^= 0x55;
            for frame in [&frame[..at], &damaged] {
                let (_, taken) = peak(|| Decoder::new(message.len()).decode(frame, &mut Vec::new()));
                assert!(
                    taken <= FACTOR * message.len() + TABLES,
                    "{schema:?} of {} bytes at {at}: {taken}",
                    message.len()
                );
            }
        }
    }
}

#[test]
fn a_jpeg_takes_no_more_than_its_picture_and_one_that_lies_neither() {
    for (schema, message) in messages() {
        let mut frame = Vec::new();
        let mut encoder = Encoder::new(schema).allow_jpeg(JpegOptions { quality: 95 });
        if encoder.encode(Codec::Jpeg, &message, &mut frame).codec != Codec::Jpeg {
            continue;
        }
        for part in 0..100 {
            let at = frame.len() * part / 100;
            let mut damaged = frame.clone();
            damaged[at] ^= [0, 0x55][usize::from(part > 0)];
            for frame in [&frame[..at], &damaged] {
                let (_, taken) = peak(|| Decoder::new(message.len()).decode(frame, &mut Vec::new()));
                assert!(taken <= FACTOR * message.len() + TABLES, "{} bytes at {at}: {taken}", message.len());
            }
        }
    }
}

#[test]
fn what_is_too_large_takes_nothing() {
    for codec in ["raw", "zlib", "deflate", "zstd", "image", "grid", "scan", "cloud", "video", "jpeg"] {
        let parsed = codec.parse::<Codec>().unwrap();
        let (tag, version) = (parsed.tag(), parsed.version());
        // A message of 2^56 bytes, and one of a byte more than allowed.
        for declared in [&[0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 0x80, 1][..], &[0x81, 8]] {
            let frame = [&[tag, version, 1], declared, &[0; 100]].concat();
            let (result, taken) = peak(|| Decoder::new(1024).decode(&frame, &mut Vec::new()));
            assert!(matches!(result, Err(Error::TooLarge { limit: 1024, .. })), "{codec}");
            assert_eq!(taken, 0, "{codec}");
        }
    }
}
