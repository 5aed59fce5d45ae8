//! The link's codecs and common general-purpose ones on the same messages, in turns, on one core.

use crate::columns::ColumnLayout;
use crate::peers::{PEERS, Peer};
use crate::zlib;
use anyhow::{Context, Result, ensure};
use bench_report::{BenchReport, Race, Target};
use codec::{Codec, Decoder, Encoder, Schema};
use std::hint::black_box;

/// zstd levels. Those from [`SLOW`] on, and zlib, take seconds per round, so they run twice.
const LEVELS: [i32; 3] = [1, 3, 19];
const SLOW: i32 = 10;
/// Bytes that every codec encodes at least, within the limits of [`ROUNDS`].
const WORK: usize = 40_000_000;
const ROUNDS: (usize, usize) = (5, 40);
/// Megabytes per second of a slow link, of 10 Mbit/s.
const SLOW_LINK: f64 = 1.25;

/// Encodes or decodes the message with this number; replaces the content of the buffer.
type Work<'a> = Box<dyn FnMut(usize, &[u8], &mut Vec<u8>) -> Result<()> + 'a>;

struct Contestant<'a> {
    name: String,
    slow: bool,
    encode: Work<'a>,
    decode: Work<'a>,
}

/// Result of one codec for all messages.
#[derive(Clone, Debug)]
struct CodecResult {
    name: String,
    /// Space saved, in percent: mean over the messages.
    saved: f64,
    /// Megabytes of messages per second.
    encode: f64,
    decode: f64,
}

impl CodecResult {
    /// Returns the seconds in which a megabyte of messages is encoded, sent over a slow link and decoded.
    fn link_time(&self) -> f64 {
        (1.0 - self.saved / 100.0) / SLOW_LINK + 1.0 / self.encode + 1.0 / self.decode
    }
}

/// A figure of our codec beside a peer's.
#[derive(Clone, Copy, Debug)]
pub enum Comparison {
    Saved(&'static str, Target),
    Encoding(&'static str, Option<Target>),
    Decoding(&'static str),
}

/// Runs our codec for messages of this type and the general-purpose ones, and reports the comparisons.
pub fn compare(
    report: &mut BenchReport,
    title: &str,
    schema: Schema,
    messages: &[Vec<u8>],
    comparisons: &[Comparison],
) -> Result<()> {
    let codec = Codec::for_schema(schema);
    let results = run(schema, codec, messages)?;
    println!("{title}");
    for CodecResult { name, saved, encode, decode } in &results {
        println!("    {name:<16} saved {saved:6.2}%   encode {encode:8.1} MB/s   decode {decode:8.1} MB/s");
    }
    let find = |name: &str| {
        let found = results.iter().find(|result| result.name == name);
        found.with_context(|| format!("{name} did not take part"))
    };
    let ours = find(codec.name())?;
    report_columns(report, title, &results, ours)?;
    for comparison in comparisons {
        type Measure = fn(&CodecResult) -> f64;
        let (what, unit, measure, peer, target): (_, _, Measure, _, _) = match *comparison {
            Comparison::Saved(peer, target) => ("saved", "%", |result| result.saved, peer, Some(target)),
            Comparison::Encoding(peer, target) => ("encoding", "MB/s", |result| result.encode, peer, target),
            Comparison::Decoding(peer) => ("decoding", "MB/s", |result| result.decode, peer, None),
        };
        let figure = report.figure(format!("{title}: {what}"), unit, measure(ours));
        figure.relative_to(peer, measure(find(peer)?));
        if let Some(target) = target {
            figure.require(target);
        }
    }
    Ok(())
}

/// Reports the bytes that `ours` leaves and its time over a slow link, each relative to the best of pco's levels and to
/// the best filter in front of zstd. More than a tenth is to be won: see docs/adr/123.
fn report_columns(report: &mut BenchReport, title: &str, all: &[CodecResult], ours: &CodecResult) -> Result<()> {
    type Measure = fn(&CodecResult) -> f64;
    const MEASURES: [(&str, &str, Measure); 2] = [
        ("bytes left", "%", |result| 100.0 - result.saved),
        ("at 10 Mbit/s", "ms/MB", |result| 1e3 * result.link_time()),
    ];
    for (what, unit, measure) in MEASURES {
        for kind in ["pco", "+ zstd"] {
            let peers = all.iter().filter(|result| result.name.contains(kind));
            let peer = peers.min_by(|a, b| measure(a).total_cmp(&measure(b))).context("no peer took part")?;
            let (encode, decode) = (ours.encode / peer.encode, ours.decode / peer.decode);
            let figure = report.figure(format!("{title}: {what}"), unit, measure(ours));
            figure.relative_to(&peer.name, measure(peer)).require(Target::RatioAtMost(0.9));
            figure.note(format!("encoding {encode:.2} times as fast, decoding {decode:.2}"));
        }
    }
    Ok(())
}

fn run(schema: Schema, codec: Codec, messages: &[Vec<u8>]) -> Result<Vec<CodecResult>> {
    let largest = messages.iter().map(Vec::len).max().unwrap_or(0);
    let bytes: usize = messages.iter().map(Vec::len).sum();
    let layouts = messages.iter().map(|message| ColumnLayout::read(schema, message)).collect::<Result<Vec<_>>>()?;
    let mut contestants = vec![memcpy(), ours(schema, codec, largest)];
    for level in LEVELS {
        contestants.push(zstd(level)?);
    }
    contestants.push(zlib(largest));
    for peer in PEERS {
        contestants.push(column_peer(schema, peer, &layouts)?);
    }
    let rounds = (WORK / bytes.max(1)).clamp(ROUNDS.0, ROUNDS.1);
    let (mut encoding, mut decoding) = (Race::new(rounds), Race::new(rounds));
    let mut entered = Vec::new();
    for Contestant { name, slow, mut encode, mut decode } in contestants {
        let mut buffer = Vec::with_capacity(largest * 2 + 4096);
        let frames = encode_all(&mut encode, &mut decode, messages, &mut buffer).with_context(|| name.clone())?;
        let saved = frames.iter().zip(messages).map(|(frame, message)| 1.0 - frame.len() as f64 / message.len() as f64);
        let saved = 100.0 * saved.sum::<f64>() / frames.len() as f64;
        let (mut out, mut runs) = (buffer.clone(), 0);
        out.reserve(largest * 2 + 4096);
        encoding.add(name.clone(), move || {
            runs += 1;
            let messages: &[Vec<u8>] = if slow && runs > 2 { &[] } else { messages };
            for (index, message) in messages.iter().enumerate() {
                black_box(encode(index, message, &mut out)).ok();
            }
        });
        decoding.add(name.clone(), move || {
            for (index, frame) in frames.iter().enumerate() {
                black_box(decode(index, frame, &mut buffer)).ok();
            }
        });
        entered.push((name, slow, saved));
    }
    let times = encoding.run().into_iter().zip(decoding.run());
    let results = entered.into_iter().zip(times).map(|((name, slow, saved), (encoding, decoding))| {
        // A slow codec that did some work is timed by its longest run alone.
        let took = if slow { encoding.longest() } else { encoding.best() };
        let encode = bytes as f64 / 1e6 / took.as_secs_f64();
        CodecResult { name, saved, encode, decode: decoding.megabytes_per_second(bytes) }
    });
    Ok(results.collect())
}

/// Returns the frames of all messages, each of which must be decoded to its message.
fn encode_all(
    encode: &mut Work<'_>,
    decode: &mut Work<'_>,
    messages: &[Vec<u8>],
    buffer: &mut Vec<u8>,
) -> Result<Vec<Vec<u8>>> {
    let mut frames = Vec::new();
    for (index, message) in messages.iter().enumerate() {
        encode(index, message, buffer)?;
        frames.push(buffer.clone());
    }
    for (index, (frame, message)) in frames.iter().zip(messages).enumerate() {
        decode(index, frame, buffer)?;
        ensure!(buffer == message, "a message changed");
    }
    Ok(frames)
}

fn memcpy<'a>() -> Contestant<'a> {
    let copy = || -> Work<'a> {
        Box::new(|_, from, to| {
            to.clear();
            to.extend_from_slice(from);
            Ok(())
        })
    };
    Contestant { name: "memcpy".to_owned(), slow: false, encode: copy(), decode: copy() }
}

fn ours<'a>(schema: Schema, codec: Codec, largest: usize) -> Contestant<'a> {
    let (mut encoder, mut decoder) = (Encoder::new(schema), Decoder::new(largest));
    let encode = move |_: usize, message: &[u8], out: &mut Vec<u8>| -> Result<()> {
        out.clear();
        encoder.encode(codec, message, out);
        Ok(())
    };
    let decode = move |_: usize, frame: &[u8], out: &mut Vec<u8>| -> Result<()> {
        out.clear();
        let decoded = decoder.decode(frame, out)?;
        ensure!(decoded.codec.name() == codec.name(), "{codec} fell back to {}", decoded.codec);
        Ok(())
    };
    Contestant { name: codec.to_string(), slow: false, encode: Box::new(encode), decode: Box::new(decode) }
}

fn zstd<'a>(level: i32) -> Result<Contestant<'a>> {
    let (mut packing, mut unpacking) = (zstd::bulk::Compressor::new(level)?, zstd::bulk::Decompressor::new()?);
    let encode = move |_: usize, message: &[u8], out: &mut Vec<u8>| -> Result<()> {
        packing.compress_to_buffer(message, out)?;
        Ok(())
    };
    let decode = move |_: usize, frame: &[u8], out: &mut Vec<u8>| -> Result<()> {
        unpacking.decompress_to_buffer(frame, out)?;
        Ok(())
    };
    let name = format!("zstd {level}");
    Ok(Contestant { name, slow: level >= SLOW, encode: Box::new(encode), decode: Box::new(decode) })
}

fn zlib<'a>(largest: usize) -> Contestant<'a> {
    let encode = |_: usize, message: &[u8], out: &mut Vec<u8>| -> Result<()> {
        *out = zlib::compress(message, 6);
        Ok(())
    };
    let decode = move |_: usize, frame: &[u8], out: &mut Vec<u8>| -> Result<()> {
        out.resize(largest, 0);
        let length = zlib::uncompress(frame, out);
        out.truncate(length);
        Ok(())
    };
    Contestant { name: "zlib 6".to_owned(), slow: true, encode: Box::new(encode), decode: Box::new(decode) }
}

fn column_peer(schema: Schema, peer: Peer, layouts: &[ColumnLayout]) -> Result<Contestant<'_>> {
    let (mut packing, mut unpacking) = (zstd::bulk::Compressor::new(3)?, zstd::bulk::Decompressor::new()?);
    let encode = move |_: usize, message: &[u8], out: &mut Vec<u8>| -> Result<()> {
        *out = peer.encode(&ColumnLayout::read(schema, message)?, message, &mut packing)?;
        Ok(())
    };
    let decode = move |index: usize, frame: &[u8], out: &mut Vec<u8>| -> Result<()> {
        *out = peer.decode(&layouts[index], frame, &mut unpacking)?;
        Ok(())
    };
    Ok(Contestant { name: peer.name(), slow: false, encode: Box::new(encode), decode: Box::new(decode) })
}
