//! The link's codecs and common general-purpose ones on the same messages, in turns, on one core.

use crate::zlib;
use anyhow::{Result, ensure};
use bench_report::Race;
use codec::{Codec, Decoder, Encoder, Schema};
use std::cell::RefCell;
use std::hint::black_box;

/// zstd levels from here on take seconds per round and only serve as a lower bound for the size: they, and zlib, run
/// once.
const SLOW: i32 = 10;

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
        let saved = sizes
            .iter()
            .zip(self.messages)
            .map(|(&size, message)| 1.0 - size as f64 / message.len() as f64);
        100.0 * saved.sum::<f64>() / sizes.len() as f64
    }

    /// Runs our codecs `codecs` and the general-purpose ones; the first result is that of `memcpy`.
    pub fn run(&self, codecs: &[Codec], levels: &[i32]) -> Result<Vec<CodecResult>> {
        let mut outcomes = vec![CodecResult {
            name: "memcpy".into(),
            saved: 0.0,
            encode: 0.0,
            decode: 0.0,
        }];
        let mut frames = Vec::new();
        for &codec in codecs {
            let encoded = self.encode_all(codec);
            self.verify(codec, &encoded)?;
            let sizes: Vec<usize> = encoded.iter().map(Vec::len).collect();
            outcomes.push(CodecResult {
                name: codec.to_string(),
                saved: self.space_saved(&sizes),
                encode: 0.0,
                decode: 0.0,
            });
            frames.push(encoded);
        }
        let mut zstd_frames = Vec::new();
        for &level in levels {
            let encoded: Vec<Vec<u8>> = self
                .messages
                .iter()
                .map(|message| zstd::bulk::compress(message, level))
                .collect::<Result<_, _>>()?;
            let sizes: Vec<usize> = encoded.iter().map(Vec::len).collect();
            outcomes.push(CodecResult {
                name: format!("zstd {level}"),
                saved: self.space_saved(&sizes),
                encode: 0.0,
                decode: 0.0,
            });
            zstd_frames.push(encoded);
        }
        let zlib_frames: Vec<Vec<u8>> = self
            .messages
            .iter()
            .map(|message| zlib::compress(message, 6))
            .collect();
        let sizes: Vec<usize> = zlib_frames.iter().map(Vec::len).collect();
        outcomes.push(CodecResult {
            name: "zlib 6".into(),
            saved: self.space_saved(&sizes),
            encode: 0.0,
            decode: 0.0,
        });

        let largest = self.messages.iter().map(Vec::len).max().unwrap_or(0);
        let buffer = RefCell::new(vec![0u8; largest * 2 + 4096]);
        let mut race = Race::new(self.rounds);
        race.add("memcpy", || {
            for message in self.messages {
                black_box(&mut buffer.borrow_mut()[..message.len()]).copy_from_slice(message);
            }
        });
        for &codec in codecs {
            let mut encoder = Encoder::new(self.schema);
            let mut out = Vec::new();
            race.add(codec.to_string(), move || {
                for message in self.messages {
                    out.clear();
                    encoder.encode(codec, message, &mut out);
                    black_box(&out);
                }
            });
        }
        for &level in levels {
            let mut context = zstd::bulk::Compressor::new(level)?;
            let buffer = &buffer;
            let mut runs = 0;
            race.add(format!("zstd {level}"), move || {
                runs += 1;
                // High levels take seconds per round and only serve as a lower bound for the size, so two rounds
                // suffice.
                for message in if level < 10 || runs <= 2 {
                    self.messages
                } else {
                    &[]
                } {
                    black_box(
                        context
                            .compress_to_buffer(message, &mut buffer.borrow_mut()[..])
                            .unwrap_or(0),
                    );
                }
            });
        }
        let mut runs = 0;
        race.add("zlib 6", move || {
            runs += 1;
            for message in if runs <= 2 { self.messages } else { &[] } {
                black_box(zlib::compress(message, 6));
            }
        });
        for (outcome, times) in outcomes.iter_mut().zip(race.run()) {
            let slow = outcome.name == "zlib 6"
                || levels
                    .iter()
                    .any(|&level| level >= SLOW && outcome.name == format!("zstd {level}"));
            // A slow codec that did some work is timed by its longest run alone.
            let took = if slow {
                times.quantile(1.0)
            } else {
                times.best()
            };
            outcome.encode = self.total_bytes() as f64 / 1e6 / took.as_secs_f64();
        }

        let mut race = Race::new(self.rounds);
        race.add("memcpy", || {
            for message in self.messages {
                black_box(&mut buffer.borrow_mut()[..message.len()]).copy_from_slice(message);
            }
        });
        for frames in &frames {
            let mut decoder = Decoder::new(largest);
            let mut out = Vec::new();
            race.add("", move || {
                for frame in frames {
                    out.clear();
                    black_box(decoder.decode(frame, &mut out)).ok();
                }
            });
        }
        for frames in &zstd_frames {
            let mut context = zstd::bulk::Decompressor::new()?;
            let buffer = &buffer;
            race.add("", move || {
                for frame in frames {
                    black_box(
                        context
                            .decompress_to_buffer(frame, &mut buffer.borrow_mut()[..])
                            .unwrap_or(0),
                    );
                }
            });
        }
        race.add("", || {
            for frame in &zlib_frames {
                black_box(zlib::uncompress(frame, &mut buffer.borrow_mut()));
            }
        });
        for (outcome, times) in outcomes.iter_mut().zip(race.run()) {
            outcome.decode = times.megabytes_per_second(self.total_bytes());
        }
        Ok(outcomes)
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
            ensure!(
                decoded.codec.name() == codec.name(),
                "{codec} fell back to {}",
                decoded.codec
            );
        }
        Ok(())
    }
}

/// Returns the result of the codec `name`.
pub fn find_result<'a>(outcomes: &'a [CodecResult], name: &str) -> Result<&'a CodecResult> {
    let found = outcomes.iter().find(|outcome| outcome.name == name);
    found.ok_or_else(|| anyhow::anyhow!("{name} did not take part"))
}

/// Prints all results, for readers who want more than the figures.
pub fn print_results(title: &str, outcomes: &[CodecResult]) {
    println!("{title}");
    for outcome in outcomes {
        println!(
            "    {:<12} saved {:6.2}%   encode {:8.1} MB/s   decode {:8.1} MB/s",
            outcome.name, outcome.saved, outcome.encode, outcome.decode
        );
    }
}
