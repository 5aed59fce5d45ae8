//! Section of the report on codecs.

use anyhow::Result;

use super::findings::findings;
use super::{CLASS, CodecRuns, HURRY, Kind, Setting, StreamResult, StreamSpec, stream_title};
use crate::cells::CachedResult;
use crate::place::NetworkProfile;
use crate::plots::{self, Bar};
use crate::section::{AGAIN, MissingMeasurement, Section, Table};
use crate::statistics::quantile;
use crate::words::{self, milliseconds, or_dash};

/// A message counts as encoded if it takes less than this fraction of the bytes without a codec.
const SMALLER: f64 = 0.9;

/// Creates the section of the report.
pub fn section(runs: &CodecRuns) -> Result<Section> {
    let mut section = Section::new(8, "codecs", "Bytes that codecs save");
    section.published = "Table I of the publication: video by libav saves 75.4 %, images by deflate 96.1 %, grid maps \
        by zlib 99.9 %; how much libav loses is not published."
        .to_owned();
    section.differs = differences();
    if runs.quick {
        let left_out = "A quick evaluation sends the video alone, over the LAN: make eval ONLY=8 has photographs, \
            maps, H.264 and the other networks.";
        section.differs.push(left_out.to_owned());
    }
    section.tables = vec![savings_table(runs), times_table(runs), offline_table(runs)];
    let mut bars = Vec::new();
    for (what, sent) in lan_streams(runs) {
        if let Some(saved) = saving(runs, what, sent).filter(|_| what.setting != Setting::None) {
            bars.push(bar(what.kind, what.setting.name(), saved));
        }
    }
    let mut kinds: Vec<Kind> = lan_streams(runs).map(|(what, _)| what.kind).collect();
    kinds.dedup();
    bars.extend(kinds.iter().map(|kind| bar(*kind, "published", kind.published_saving().1)));
    section.add_drawing(
        "codecs-saved",
        "Share of the bytes on the cable that each codec saves over the LAN, beside the published one",
        plots::bars("Saved bytes", "saved bytes (%)", &bars, false)?,
    );
    let responses: Vec<Bar> = measured_streams(runs)
        .filter(|(what, _)| what.kind == Kind::Video)
        .filter_map(|(what, sent)| {
            let at = |share| quantile(&sent.responses, share).map(|seconds| seconds * 1e3);
            Some(Bar {
                group: what.network.name().to_owned(),
                name: what.setting.name().to_owned(),
                value: at(0.5)?,
                spread: at(0.05).zip(at(0.95)),
            })
        })
        .collect();
    section.add_drawing(
        "codecs-response",
        "Response time of one picture of the video by codec and network: median, 5 % and 95 %",
        plots::bars("From picture to receipt", "response time (ms)", &responses, true)?,
    );
    section.findings = findings(runs);
    add_missing(&mut section, runs);
    Ok(section)
}

fn differences() -> Vec<String> {
    vec![
        "Bytes are those of packets on the robot's cable, with the heads of TCP, IP and WebSocket; what is sent \
         without a codec is the base of each saving."
            .to_owned(),
        format!(
            "A robot of the class {} sends one message after the other's receipt; the node in the servant answers with \
             the header alone. The first messages are not counted: by then the link has measured itself and chosen.",
            CLASS.name()
        ),
        format!(
            "The codec is the key `codec` of stub.toml: none; auto (without loss: the best of several); jpeg (quality \
             80) and video (H.264, quantiser 22), which are taken where no codec without loss is quick enough: here \
             T_max is {} s, so that they are.",
            HURRY.1
        ),
        "The publication's video, image and map are not published: the video is vtest.avi of Debian's opencv-doc, \
         images are photographs of the same package, scaled to 640x480, bgr8, the map is what laser_slam makes of a \
         recorded drive, alone and in the middle of 4000 x 4000 cells, as gmapping publishes it."
            .to_owned(),
        "What deflate and zlib, which lose nothing, make of the same messages in one process is in the last table, \
         beside what they saved in the publication."
            .to_owned(),
        "Photographs and the large map are sent over the LAN alone; no codec but those of stub.toml can be had on the \
         cable."
            .to_owned(),
    ]
}

pub(super) fn measured_streams(runs: &CodecRuns) -> impl Iterator<Item = (&StreamSpec, &StreamResult)> {
    let streams = runs.streams.iter();
    let done = streams.filter_map(|(what, sent)| Some((what, sent.value()?)));
    // Streams whose codec is not built in do not count as measured.
    done.filter(|(_, sent)| sent.warning.is_none())
}

pub(super) fn lan_streams(runs: &CodecRuns) -> impl Iterator<Item = (&StreamSpec, &StreamResult)> {
    measured_streams(runs).filter(|(what, _)| what.network == NetworkProfile::Lan)
}

/// Percentage of the bytes to the servant that a codec saves on a network.
pub(super) fn saving(runs: &CodecRuns, what: &StreamSpec, sent: &StreamResult) -> Option<f64> {
    let (_, base) = find_base(runs, what)?;
    Some(100.0 * (1.0 - sent.carried?[0] / base.carried?[0]))
}

/// Percentage of the bytes to the servant that a codec saves on the median message that was encoded; messages that the
/// link sends unencoded do not lower it.
fn saving_where_encoded(runs: &CodecRuns, what: &StreamSpec, sent: &StreamResult) -> Option<f64> {
    let (_, base) = find_base(runs, what).filter(|_| what.setting != Setting::None)?;
    let whole = base.carried?[0];
    let each = sent.each.iter().map(|bytes| *bytes as f64);
    let smaller: Vec<f64> = each.filter(|bytes| *bytes < SMALLER * whole).collect();
    Some(100.0 * (1.0 - quantile(&smaller, 0.5)? / whole))
}

/// Number of messages that took clearly fewer bytes than without a codec.
pub(super) fn count_encoded(runs: &CodecRuns, what: &StreamSpec, sent: &StreamResult) -> Option<usize> {
    let (_, base) = find_base(runs, what).filter(|_| what.setting != Setting::None)?;
    let whole = base.carried?[0];
    let smaller = sent.each.iter().filter(|bytes| (**bytes as f64) < SMALLER * whole);
    Some(smaller.count())
}

/// Returns the stream of the same kind on the same network without a codec.
pub(super) fn find_base<'a>(runs: &'a CodecRuns, what: &StreamSpec) -> Option<(&'a StreamSpec, &'a StreamResult)> {
    measured_streams(runs)
        .find(|(base, _)| base.setting == Setting::None && base.kind == what.kind && base.network == what.network)
}

/// Formats a value that is a percentage already.
fn format_percent(value: Option<f64>) -> String {
    words::percent(value.map(|value| value / 100.0))
}

fn format_bytes(value: Option<f64>) -> String {
    or_dash(value, |value| format!("{value:.0}"))
}

fn savings_table(runs: &CodecRuns) -> Table {
    let mut table = Table::new(
        "Over the LAN, for each message",
        "what is sent | codec | published row | published: saved | saved here | \
         of the median message that is a tenth smaller | bytes to the servant | bytes back | \
         messages at least a tenth smaller | PSNR, median, and least in brackets (dB) | pictures that changed",
    );
    for (what, sent) in lan_streams(runs) {
        let (row, published) = what.kind.published_saving();
        let base = what.setting == Setting::None;
        let (noise, changed) = noise_cells(runs, what);
        table.push([
            what.kind.name().to_owned(),
            what.setting.name().to_owned(),
            row.to_owned(),
            format_percent(Some(published)),
            if base { "the base".to_owned() } else { format_percent(saving(runs, what, sent)) },
            format_percent(saving_where_encoded(runs, what, sent)),
            format_bytes(sent.carried.map(|ways| ways[0])),
            format_bytes(sent.carried.map(|ways| ways[1])),
            or_dash(count_encoded(runs, what, sent), |encoded| format!("{encoded} of {}", sent.each.len())),
            noise,
            changed,
        ]);
    }
    table
}

/// Returns the peak signal-to-noise ratio, and how many images have changed.
fn noise_cells(runs: &CodecRuns, what: &StreamSpec) -> (String, String) {
    if !what.setting.is_lossy() {
        return ("lossless".to_owned(), "–".to_owned());
    }
    let received = runs.received.iter().find(|(of, _)| of == what);
    let Some(received) = received.and_then(|(_, received)| received.value()) else {
        return ("–".to_owned(), "–".to_owned());
    };
    let changed = received.psnr.len();
    let all = changed + received.exact;
    let (median, least) = (quantile(&received.psnr, 0.5), quantile(&received.psnr, 0.0));
    let both = median.zip(least);
    let noise = both.map(|(median, least)| format!("{median:.1} ({least:.1})"));
    (noise.unwrap_or_else(|| "lossless".to_owned()), format!("{changed} of {all}"))
}

fn times_table(runs: &CodecRuns) -> Table {
    let mut table = Table::new(
        "From publishing a message to its receipt, milliseconds (the publication has no such figure)",
        "what is sent | codec | network | messages | lost | median | 95 % | bytes to the servant | saved | \
         messages at least a tenth smaller",
    );
    for (what, sent) in measured_streams(runs) {
        table.push([
            what.kind.name().to_owned(),
            what.setting.name().to_owned(),
            what.network.name().to_owned(),
            (sent.responses.len() + sent.lost).to_string(),
            sent.lost.to_string(),
            milliseconds(quantile(&sent.responses, 0.5)),
            milliseconds(quantile(&sent.responses, 0.95)),
            format_bytes(sent.carried.map(|ways| ways[0])),
            match what.setting {
                Setting::None => "the base".to_owned(),
                _ => format_percent(saving(runs, what, sent)),
            },
            or_dash(count_encoded(runs, what, sent), |encoded| format!("{encoded} of {}", sent.each.len())),
        ]);
    }
    table
}

fn offline_table(runs: &CodecRuns) -> Table {
    let mut table = Table::new(
        "The same messages by one codec in one process, not on the cable",
        "what | codec | published row | published: saved | saved here",
    );
    for (kind, alone) in &runs.alone {
        let (row, published) = kind.published_saving();
        for one in alone.value().iter().flat_map(|alone| &alone.codecs) {
            let saved = 100.0 * (1.0 - one.bytes[1] as f64 / one.bytes[0] as f64);
            table.push([
                kind.name().to_owned(),
                one.codec.clone(),
                row.to_owned(),
                format_percent(Some(published)),
                format!("{saved:.2} %"),
            ]);
        }
    }
    table
}

fn bar(kind: Kind, name: &str, value: f64) -> Bar {
    Bar { group: kind.name().to_owned(), name: name.to_owned(), value, spread: None }
}

fn add_missing(section: &mut Section, runs: &CodecRuns) {
    let mut add = |what: String, why: &str, next: &str| {
        section.missing.push(MissingMeasurement::new(what, why, next));
    };
    for (what, sent) in &runs.streams {
        match sent {
            CachedResult::Missing(why) => add(stream_title(what), why, AGAIN),
            CachedResult::Done(StreamResult { warning: Some(why), .. }) => add(
                stream_title(what),
                why,
                "build cloudroidd and cloudroid-stub with the feature video (docs/codecs.md)",
            ),
            CachedResult::Done(sent) if sent.carried.is_none() => add(
                format!("{}: bytes on the cable", stream_title(what)),
                "the robot has no counters of its network, or nothing was answered",
                AGAIN,
            ),
            CachedResult::Done(_) => {}
        }
    }
    for (what, received) in &runs.received {
        if let CachedResult::Missing(why) = received {
            add(format!("{}: signal to noise", stream_title(what)), why, AGAIN);
        }
    }
    for (kind, alone) in &runs.alone {
        if let CachedResult::Missing(why) = alone {
            add(format!("{}: codecs alone", kind.name()), why, AGAIN);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::StreamLength;
    use super::super::received::ReceivedPictures;
    use super::super::sources::{CodecOutput, OfflineResult};
    use super::*;
    use crate::words::assert_tells;

    fn spec(setting: Setting) -> StreamSpec {
        StreamSpec {
            kind: Kind::Video,
            setting,
            network: NetworkProfile::Lan,
            length: StreamLength { settle: 1, counted: 2 },
        }
    }

    fn measured_stream(bytes: f64, response: f64) -> CachedResult<StreamResult> {
        CachedResult::Done(StreamResult {
            responses: vec![response; 2],
            carried: Some([bytes, 10.0]),
            each: vec![bytes as u64, 1000],
            ..StreamResult::default()
        })
    }

    fn test_runs() -> CodecRuns {
        let received = ReceivedPictures { psnr: vec![36.0, 38.0], exact: 1 };
        let made = |codec: &str, bytes: u64| CodecOutput {
            codec: codec.to_owned(),
            ours: codec == "image",
            bytes: [200, bytes],
        };
        let alone = OfflineResult { codecs: vec![made("deflate", 150), made("image", 160)], known: None };
        CodecRuns {
            streams: vec![
                (spec(Setting::None), measured_stream(1000.0, 0.08)),
                (spec(Setting::Auto), measured_stream(500.0, 0.09)),
                (spec(Setting::Jpeg), measured_stream(50.0, 0.02)),
            ],
            received: vec![(spec(Setting::Jpeg), CachedResult::Done(received))],
            alone: vec![(Kind::Video, CachedResult::Done(alone))],
            quick: false,
        }
    }

    #[test]
    fn savings_are_beside_the_published_ones() {
        let section = section(&test_runs()).expect("a section");
        let rows = &section.tables[0].rows;
        assert_eq!(rows[0][4], "the base");
        assert_eq!(rows[1][3..5], ["75.4 %", "50.0 %"].map(str::to_owned));
        assert_eq!(rows[2][4..6], ["95.0 %", "95.0 %"].map(str::to_owned));
        assert_eq!(rows[2][8..], ["1 of 2", "37.0 (36.0)", "2 of 3"].map(str::to_owned));
        assert_eq!(section.tables[2].rows[0][4], "25.00 %");
        let told = section.findings.join(" ");
        assert_tells(
            &told,
            "saves 50.0 % of the bytes and loses nothing: 25.4 percentage points less than the \
            publication's row \u{201c}video, libav\u{201d} (75.4 %).",
        );
        assert_tells(&told, "saves 95.0 % of the bytes: at least as many as the publication's");
        assert_tells(&told, "takes longer with the codec (90.0 ms)");
        assert_tells(&told, "1 of 2 messages took nine tenths");
        assert_tells(
            &told,
            "of the same 200 bytes the codec image makes 160 and deflate 150 (1.1 times as many by ours: \
                worse than hoped).",
        );
        assert!(section.missing.is_empty(), "{:?}", section.missing);
    }

    #[test]
    fn a_codec_that_is_not_built_in_is_missing() {
        let lacks = StreamResult {
            warning: Some("codec = \"video\" is not built into this stub".to_owned()),
            carried: Some([1.0, 1.0]),
            ..StreamResult::default()
        };
        let mut runs = test_runs();
        let what = spec(Setting::Video);
        runs.streams.push((what, CachedResult::Done(lacks)));
        let section = section(&runs).expect("a section");
        assert_eq!(section.tables[0].rows.len(), 3);
        assert!(section.missing[0].why.contains("not built"));
        assert!(section.missing[0].next.contains("feature video"));
    }

    #[test]
    fn a_stream_without_its_base_saves_nothing_known() {
        let mut runs = test_runs();
        runs.streams[0].1 = CachedResult::Missing("the place was killed".to_owned());
        let section = section(&runs).expect("a section");
        assert_eq!(section.tables[0].rows[0][4], "–");
        assert!(section.missing[0].why.contains("killed"));
    }
}
