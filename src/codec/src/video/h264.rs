//! Binding to Cisco's OpenH264: constant quality, no delay, one thread.

use super::VideoOptions;
use super::colour::{self, ChannelOrder, Planes};
use super::guard;
use crate::Error;
use crate::layout::{ImageLayout, Pixel};
use crate::rows::{put_alpha, put_padding, take_alpha, take_padding};
use crate::wire::{FrameCursor, MessageEnds, put_varint};
use openh264::OpenH264API;
use openh264::decoder::{Decoder, DecoderConfig};
use openh264::encoder::{
    BitRate, Complexity, Encoder, EncoderConfig, FrameRate, FrameType, Profile, QpRange, RateControlMode, UsageType,
};
use openh264::formats::{YUVSlices, YUVSource};
use std::fmt;

/// Maximum picture size of the library, pixels.
const LONG_SIDE: usize = 3840;
const SHORT_SIDE: usize = 2160;
/// Minimum width and height of the library, pixels.
const SMALLEST: usize = 16;

/// Returns the channel order, if the layout is a colour picture that the library accepts.
fn channel_order(layout: &ImageLayout) -> Option<ChannelOrder> {
    let Pixel::Bytes(channels @ 3..=4) = layout.pixel else {
        return None;
    };
    let (width, height) = (layout.width.next_multiple_of(2), layout.height.next_multiple_of(2));
    let fits = width.max(height) <= LONG_SIDE && width.min(height) <= SHORT_SIDE && width.min(height) >= SMALLEST;
    fits.then_some(ChannelOrder { channels, red_first: layout.red_first })
}

pub(super) struct VideoEncoder {
    options: VideoOptions,
    encoder: Option<Encoder>,
    size: (usize, usize),
    planes: Planes,
    number: u64,
}

impl VideoEncoder {
    pub(super) fn new(options: VideoOptions) -> Self {
        Self { options, encoder: None, size: (0, 0), planes: Planes::default(), number: 0 }
    }

    pub(super) fn request_keyframe(&mut self) {
        if let Some(encoder) = &mut self.encoder {
            encoder.force_intra_frame();
        }
    }

    pub(super) fn encode(&mut self, message: &[u8], layout: &ImageLayout, out: &mut Vec<u8>) -> Option<()> {
        let order = channel_order(layout)?;
        let data = layout.data(message);
        let rows = || data.chunks_exact(layout.step).map(|line| &line[..layout.row_bytes()]);
        self.planes.fill(layout.width, layout.height, order, rows());
        if self.size != (self.planes.width, self.planes.height) {
            self.size = (self.planes.width, self.planes.height);
            self.encoder = None;
        }
        let encoder = match &mut self.encoder {
            Some(encoder) => encoder,
            none => none.insert(open_encoder(self.options)?),
        };
        let half = self.planes.width / 2;
        let source = YUVSlices::new(
            (&self.planes.luma, &self.planes.blue, &self.planes.red),
            self.size,
            (self.planes.width, half, half),
        );
        let Ok(stream) = encoder.encode(&source) else {
            self.encoder = None;
            return None;
        };
        let key = match stream.frame_type() {
            FrameType::IDR => true,
            FrameType::I | FrameType::P => false,
            FrameType::IPMixed | FrameType::Skip | FrameType::Invalid => return None,
        };
        self.number += 1;
        MessageEnds::from_message(message, layout.head, layout.tail).put(out);
        put_padding(data, layout.row_bytes(), layout.step, out);
        put_varint(out, self.number);
        out.push(key.into());
        if order.channels == 4 {
            put_alpha(data, layout, out);
        }
        stream.write_vec(out);
        Some(())
    }
}

fn open_encoder(options: VideoOptions) -> Option<Encoder> {
    let quantiser = options.quantiser.min(51);
    let config = EncoderConfig::new()
        .profile(Profile::Baseline)
        .usage_type(UsageType::CameraVideoRealTime)
        .complexity(Complexity::Medium)
        // The quantiser is fixed, so the rate control has nothing to do; frames are skipped only beyond this rate.
        .rate_control_mode(RateControlMode::Quality)
        .qp(QpRange::new(quantiser, quantiser))
        .bitrate(BitRate::from_bps(240_000_000))
        .max_frame_rate(FrameRate::from_hz(30.0))
        .adaptive_quantization(false)
        .scene_change_detect(false)
        .num_threads(1);
    Encoder::with_api_config(OpenH264API::from_source(), config).ok()
}

impl fmt::Debug for VideoEncoder {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("VideoEncoder").field("size", &self.size).field("number", &self.number).finish()
    }
}

#[derive(Default)]
pub(super) struct VideoDecoder {
    decoder: Option<Decoder>,
    /// Number of the frame that the next one may refer to.
    last: Option<u64>,
    size: (usize, usize),
}

impl VideoDecoder {
    pub(super) fn decode(&mut self, input: &mut FrameCursor<'_>, total: usize, out: &mut Vec<u8>) -> Result<(), Error> {
        let (layout, ends) = ImageLayout::take(input, total)?;
        let order = channel_order(&layout).ok_or(Error::Corrupt("a video of pictures that are none"))?;
        let data = ends.restore(layout.step * layout.height, out);
        take_padding(input, data, layout.row_bytes(), layout.step)?;
        let number = input.varint()?;
        let key = input.byte()? == 1;
        if order.channels == 4 {
            take_alpha(input, data, &layout)?;
        }
        let stream = input.take_rest();
        let size = (layout.width.next_multiple_of(2), layout.height.next_multiple_of(2));
        guard::check(stream, size.0, size.1)?;
        if key {
            // Every keyframe starts afresh: nothing that a lost or hostile frame left behind can matter.
            self.decoder = None;
        } else if self.last != number.checked_sub(1) || self.size != size || self.decoder.is_none() {
            return Err(Error::KeyframeNeeded(number));
        }
        self.last = None;
        self.size = size;
        let decoder = match &mut self.decoder {
            Some(decoder) => decoder,
            none => {
                let config = DecoderConfig::new();
                let made = Decoder::with_api_config(OpenH264API::from_source(), config);
                none.insert(made.map_err(|error| Error::Video(error.to_string()))?)
            }
        };
        let picture = decoder
            .decode(stream)
            .map_err(|error| Error::Video(error.to_string()))?
            .ok_or(Error::KeyframeNeeded(number))?;
        if picture.dimensions() != size {
            return Err(Error::Corrupt("a video frame of another size"));
        }
        let (strides, half) = (picture.strides(), size.0 / 2);
        for (y, line) in data.chunks_exact_mut(layout.step).enumerate() {
            colour::join_row_pair(
                &picture.y()[y * strides.0..][..layout.width],
                &picture.u()[y / 2 * strides.1..][..half],
                &picture.v()[y / 2 * strides.2..][..half],
                order,
                &mut line[..layout.row_bytes()],
            );
        }
        self.last = Some(number);
        Ok(())
    }
}

impl fmt::Debug for VideoDecoder {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.debug_struct("VideoDecoder").field("size", &self.size).field("last", &self.last).finish()
    }
}
