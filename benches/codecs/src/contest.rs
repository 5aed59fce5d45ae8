//! The link's codecs and common general-purpose ones on the same messages, in turns, on one core.

use crate::columns::ColumnLayout;
use crate::peers::{PEERS, Peer};
use crate::zlib;
use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Race, Target, Times};
use codec::{Codec, Decoder, Encoder, Schema};
use std::cell::RefCell;
use std::hint::black_box;

/// zstd levels from here on take seconds per round and only serve as a lower bound for the size: they, and zlib, run
/// twice.
const SLOW: i32 = 10;

/// A codec with the sizes of its frames; the functions encode all messages and decode all frames.
struct Contestant<'a> {
    name: String,
    slow: bool,
    sizes: Vec<usize>,
    encode: Box<dyn FnMut() + 'a>,
    decode: Box<dyn FnMut() + 'a>,
}

/// Result of one codec for all messages.
#[derive(Clone, Debug)]
pub struct CodecResult {
    pub name: String,
    /// Space saved, in percent: mean over the messages.
    pub saved: f64,
    /// Megabytes of messages per second.
    pub encode: f64,
    /// Megabytes of messages per second; zero if not measured.
    pub decode: f64,
}

/// A comparison of codecs on messages of one type.
pub struct CodecComparison<'a> {
    pub schema: Schema,
    pub messages: &'a [Vec<u8>],
    pub rounds: usize,
}

impl CodecComparison<'_> {
    fn total_bytes(&self) -> usize {
        self.messages.iter().map(Vec::len).sum()
    }

    fn space_saved(&self, sizes: &[usize]) -> f64 {
        let saved = sizes.iter().zip(self.messages).map(|(&size, message)| 1.0 - size as f64 / message.len() as f64);
        100.0 * saved.sum::<f64>() / sizes.len() as f64
    }

    /// Runs our codecs `codecs` and the general-purpose ones; the first result is that of `memcpy`.
    pub fn run(&self, codecs: &[Codec], levels: &[i32]) -> Result<Vec<CodecResult>> {
        let largest = self.messages.iter().map(Vec::len).max().unwrap_or(0);
        let buffer = RefCell::new(vec![0u8; largest * 2 + 4096]);
        let mut contestants = vec![self.memcpy(&buffer)];
        for &codec in codecs {
            contestants.push(self.ours(codec, largest)?);
        }
        for &level in levels {
            contestants.push(self.zstd(level, &buffer)?);
        }
        contestants.push(self.zlib(&buffer));
        for peer in PEERS {
            contestants.push(self.peer(peer).with_context(|| peer.name())?);
        }
        let (mut encoding, mut decoding) = (Race::new(self.rounds), Race::new(self.rounds));
        let mut entered = Vec::new();
        for one in contestants {
            encoding.add(one.name.clone(), one.encode);
            decoding.add(one.name.clone(), one.decode);
            entered.push((one.name, one.slow, self.space_saved(&one.sizes)));
        }
        let bytes = self.total_bytes();
        let times = encoding.run().into_iter().zip(decoding.run());
        let result = |((name, slow, saved), (encoding, decoding)): ((String, bool, f64), (Times, Times))| {
            // A slow codec that did some work is timed by its longest run alone.
            let took = if slow { encoding.longest() } else { encoding.best() };
            CodecResult {
                name,
                saved,
                encode: bytes as f64 / 1e6 / took.as_secs_f64(),
                decode: decoding.megabytes_per_second(bytes),
            }
        };
        Ok(entered.into_iter().zip(times).map(result).collect())
    }

    fn memcpy<'a>(&'a self, buffer: &'a RefCell<Vec<u8>>) -> Contestant<'a> {
        let copy = move || {
            for message in self.messages {
                black_box(&mut buffer.borrow_mut()[..message.len()]).copy_from_slice(message);
            }
        };
        Contestant {
            name: "memcpy".to_owned(),
            slow: false,
            sizes: self.messages.iter().map(Vec::len).collect(),
            encode: Box::new(copy),
            decode: Box::new(copy),
        }
    }

    fn ours(&self, codec: Codec, largest: usize) -> Result<Contestant<'_>> {
        let frames = self.encode_all(codec);
        self.verify(codec, &frames)?;
        let sizes = frames.iter().map(Vec::len).collect();
        let (mut encoder, mut out) = (Encoder::new(self.schema), Vec::new());
        let encode = move || {
            for message in self.messages {
                out.clear();
                encoder.encode(codec, message, &mut out);
                black_box(&out);
            }
        };
        let (mut decoder, mut back) = (Decoder::new(largest), Vec::new());
        let decode = move || {
            for frame in &frames {
                back.clear();
                black_box(decoder.decode(frame, &mut back)).ok();
            }
        };
        Ok(Contestant {
            name: codec.to_string(),
            slow: false,
            sizes,
            encode: Box::new(encode),
            decode: Box::new(decode),
        })
    }

    fn zstd<'a>(&'a self, level: i32, buffer: &'a RefCell<Vec<u8>>) -> Result<Contestant<'a>> {
        let frames = self.messages.iter().map(|message| zstd::bulk::compress(message, level));
        let frames: Vec<Vec<u8>> = frames.collect::<Result<_, _>>()?;
        let slow = level >= SLOW;
        let (mut context, mut runs) = (zstd::bulk::Compressor::new(level)?, 0);
        let encode = move || {
            runs += 1;
            for message in self.messages_of_run(slow, runs) {
                let mut frame = buffer.borrow_mut();
                black_box(context.compress_to_buffer(message, &mut frame[..]).unwrap_or(0));
            }
        };
        let mut context = zstd::bulk::Decompressor::new()?;
        let sizes = frames.iter().map(Vec::len).collect();
        let decode = move || {
            for frame in &frames {
                let mut message = buffer.borrow_mut();
                black_box(context.decompress_to_buffer(frame, &mut message[..]).unwrap_or(0));
            }
        };
        Ok(Contestant {
            name: format!("zstd {level}"),
            slow,
            sizes,
            encode: Box::new(encode),
            decode: Box::new(decode),
        })
    }

    fn zlib<'a>(&'a self, buffer: &'a RefCell<Vec<u8>>) -> Contestant<'a> {
        let frames = self.messages.iter().map(|message| zlib::compress(message, 6));
        let frames: Vec<Vec<u8>> = frames.collect();
        let sizes = frames.iter().map(Vec::len).collect();
        let mut runs = 0;
        let encode = move || {
            runs += 1;
            for message in self.messages_of_run(true, runs) {
                black_box(zlib::compress(message, 6));
            }
        };
        let decode = move || {
            for frame in &frames {
                black_box(zlib::uncompress(frame, &mut buffer.borrow_mut()));
            }
        };
        Contestant { name: "zlib 6".to_owned(), slow: true, sizes, encode: Box::new(encode), decode: Box::new(decode) }
    }

    fn peer(&self, peer: Peer) -> Result<Contestant<'_>> {
        let layouts = self.messages.iter().map(|message| ColumnLayout::read(self.schema, message));
        let layouts = layouts.collect::<Result<Vec<_>>>()?;
        let (mut packing, mut unpacking) = (zstd::bulk::Compressor::new(3)?, zstd::bulk::Decompressor::new()?);
        let mut frames = Vec::new();
        for (layout, message) in layouts.iter().zip(self.messages) {
            let frame = peer.encode(layout, message, &mut packing)?;
            ensure!(peer.decode(layout, &frame, &mut unpacking)? == *message, "a message changed");
            frames.push(frame);
        }
        let sizes = frames.iter().map(Vec::len).collect();
        let schema = self.schema;
        let encode = move || {
            for message in self.messages {
                let frame =
                    ColumnLayout::read(schema, message).map(|layout| peer.encode(&layout, message, &mut packing));
                black_box(frame).ok();
            }
        };
        let decode = move || {
            for (layout, frame) in layouts.iter().zip(&frames) {
                black_box(peer.decode(layout, frame, &mut unpacking)).ok();
            }
        };
        Ok(Contestant { name: peer.name(), slow: false, sizes, encode: Box::new(encode), decode: Box::new(decode) })
    }

    /// Returns the messages that a codec encodes in its run with this number: slow ones encode none after the second.
    fn messages_of_run(&self, slow: bool, runs: usize) -> &[Vec<u8>] {
        if slow && runs > 2 { &[] } else { self.messages }
    }

    fn encode_all(&self, codec: Codec) -> Vec<Vec<u8>> {
        let mut encoder = Encoder::new(self.schema);
        self.messages
            .iter()
            .map(|message| {
                let mut frame = Vec::new();
                encoder.encode(codec, message, &mut frame);
                frame
            })
            .collect()
    }

    /// Checks that decoding `frames` gives back the messages bit by bit.
    fn verify(&self, codec: Codec, frames: &[Vec<u8>]) -> Result<()> {
        let mut decoder = Decoder::new(usize::MAX);
        for (frame, message) in frames.iter().zip(self.messages) {
            let mut back = Vec::new();
            let decoded = decoder.decode(frame, &mut back)?;
            ensure!(back == *message, "{codec} changed a message");
            ensure!(decoded.codec.name() == codec.name(), "{codec} fell back to {}", decoded.codec);
        }
        Ok(())
    }
}

/// Returns the result of the codec `name`.
pub fn find_result<'a>(outcomes: &'a [CodecResult], name: &str) -> Result<&'a CodecResult> {
    let found = outcomes.iter().find(|outcome| outcome.name == name);
    found.ok_or_else(|| anyhow::anyhow!("{name} did not take part"))
}

/// Megabytes per second of a slow link, of 10 Mbit/s.
const SLOW_LINK: f64 = 1.25;

impl CodecResult {
    /// Returns the seconds in which a megabyte of messages is encoded, sent over a slow link and decoded.
    fn link_time(&self) -> f64 {
        (1.0 - self.saved / 100.0) / SLOW_LINK + 1.0 / self.encode + 1.0 / self.decode
    }
}

/// Reports the bytes that `ours` leaves and its time over a slow link, each relative to the best of pco's levels and to
/// the best filter in front of zstd. More than a tenth is to be won: see docs/adr/123.
pub fn report_columns(report: &mut BenchReport, title: &str, outcomes: &[CodecResult], ours: &str) -> Result<()> {
    type Measure = fn(&CodecResult) -> f64;
    const MEASURES: [(&str, &str, Measure); 2] = [
        ("bytes left", "%", |result| 100.0 - result.saved),
        ("at 10 Mbit/s", "ms/MB", |result| 1e3 * result.link_time()),
    ];
    let ours = find_result(outcomes, ours)?;
    for (what, unit, measure) in MEASURES {
        for kind in ["pco", "+ zstd"] {
            let peers = outcomes.iter().filter(|outcome| outcome.name.contains(kind));
            let peer = peers.min_by(|a, b| measure(a).total_cmp(&measure(b))).context("no peer took part")?;
            let (encode, decode) = (ours.encode / peer.encode, ours.decode / peer.decode);
            let figure = report.figure(format!("{title}: {what}"), unit, measure(ours));
            figure.relative_to(&peer.name, measure(peer)).require(Target::RatioAtMost(0.9));
            figure.note(format!("encoding {encode:.2} times as fast, decoding {decode:.2}"));
        }
    }
    Ok(())
}

/// Prints all results, for readers who want more than the figures.
pub fn print_results(title: &str, outcomes: &[CodecResult]) {
    println!("{title}");
    for outcome in outcomes {
        println!(
            "    {:<16} saved {:6.2}%   encode {:8.1} MB/s   decode {:8.1} MB/s",
            outcome.name, outcome.saved, outcome.encode, outcome.decode
        );
    }
}
