//! Section of the report on codecs.

use super::sources::OfflineResult;
use super::{ABOUT, CodecRuns, Kind, Setting, StreamResult, StreamSpec, stream_title};
use crate::cells::Runs;
use crate::place::NetworkProfile;
use crate::plots::{self, Bar};
use crate::section::{AGAIN, Section, Table};
use crate::statistics::{Spread, median};
use crate::words::{count, digits, milliseconds, percent, ratio};

/// A message counts as encoded if it takes less than this fraction of the bytes without a codec.
const SMALLER: f64 = 0.9;

/// A stream that was measured, beside the one of the same kind on the same network without a codec.
struct MeasuredStream<'a> {
    what: &'a StreamSpec,
    sent: &'a Runs<StreamResult>,
    base: Option<&'a Runs<StreamResult>>,
}

impl MeasuredStream<'_> {
    fn is_base(&self) -> bool {
        self.what.setting == Setting::None
    }

    fn name(&self) -> String {
        let StreamSpec { kind, setting, network, .. } = self.what;
        format!("{}, codec {}, {}", kind.name(), setting.name(), network.name())
    }

    /// Returns a figure of each run beside the bytes per message without a codec.
    fn beside_base(&self, find: impl Fn(&StreamResult, f64) -> Option<f64>) -> Option<Spread> {
        self.sent.compare(self.base?, |sent, base| find(sent, base.carried?[0]))
    }

    /// Returns the fraction of the bytes to the servant that the codec saves.
    fn saving(&self) -> Option<Spread> {
        self.beside_base(|sent, whole| Some(1.0 - sent.carried?[0] / whole))
    }

    /// Returns the same for the median message that was encoded; messages that the link sends unencoded do not lower
    /// it.
    fn saving_where_encoded(&self) -> Option<Spread> {
        let figure = self.beside_base(|sent, whole| {
            let each = sent.each.iter().map(|bytes| *bytes as f64);
            let smaller: Vec<f64> = each.filter(|bytes| *bytes < SMALLER * whole).collect();
            Some(1.0 - median(&smaller)? / whole)
        });
        figure.filter(|_| !self.is_base())
    }

    /// Formats how many messages took clearly fewer bytes than without a codec.
    fn encoded_cell(&self) -> String {
        let is_smaller = |bytes: &u64, whole: f64| (*bytes as f64) < SMALLER * whole;
        let encoded = self
            .beside_base(|sent, whole| Some(sent.each.iter().filter(|bytes| is_smaller(bytes, whole)).count() as f64));
        let all = self.sent.first().map_or(0, |sent| sent.each.len());
        if self.is_base() { "–".to_owned() } else { format!("{} of {all}", count(encoded)) }
    }

    fn saving_cell(&self) -> String {
        if self.is_base() { "the base".to_owned() } else { percent(self.saving()) }
    }
}

/// Returns the measured streams; those whose codec is not built in do not count.
fn measured_streams(runs: &CodecRuns) -> Vec<MeasuredStream<'_>> {
    let is_measured = |sent: &Runs<StreamResult>| sent.first().is_some_and(|sent| sent.warning.is_none());
    let done = runs.streams.iter().filter(|(_, sent)| is_measured(sent));
    let base_of = |what: &StreamSpec| {
        let bases = done.clone().filter(|(base, _)| base.setting == Setting::None);
        bases.map(|(base, sent)| (base, sent)).find(|(base, _)| base.kind == what.kind && base.network == what.network)
    };
    done.clone().map(|(what, sent)| MeasuredStream { what, sent, base: base_of(what).map(|(_, sent)| sent) }).collect()
}

pub fn section(runs: &CodecRuns) -> Section {
    let mut section = ABOUT.section();
    if runs.quick {
        let left_out = "A quick evaluation sends the video alone, over the LAN: make eval ONLY=8 has the rest.";
        section.differs.push(left_out.to_owned());
    }
    let all = measured_streams(runs);
    section.tables = vec![savings_table(&all), times_table(&all), offline_table(runs)];
    let on_lan = || all.iter().filter(|one| one.what.network == NetworkProfile::Lan);
    let bar = |group: &str, name: &str, figure: Spread, factor: f64| Bar {
        spread: Some((figure.low * factor, figure.high * factor)),
        ..Bar::new(group, name, figure.median * factor)
    };
    let of_codecs = on_lan().filter(|one| !one.is_base());
    let mut bars: Vec<Bar> = of_codecs
        .filter_map(|one| Some(bar(one.what.kind.name(), one.what.setting.name(), one.saving()?, 100.0)))
        .collect();
    let mut kinds: Vec<Kind> = on_lan().map(|one| one.what.kind).collect();
    kinds.dedup();
    bars.extend(kinds.iter().map(|kind| Bar::new(kind.name(), "published", kind.published_saving().1)));
    section.add_drawing(
        "codecs-saved",
        "Share of the bytes on the cable that each codec saves over the LAN, beside the published one",
        plots::bars("Saved bytes", "saved bytes (%)", &bars, false),
    );
    let of_video = all.iter().filter(|one| one.what.kind == Kind::Video);
    let responses = of_video.filter_map(|one| {
        let [p50, ..] = one.sent.percentiles(|sent| sent.responses.clone());
        Some(bar(one.what.network.name(), one.what.setting.name(), p50?, 1e3))
    });
    section.add_drawing(
        "codecs-response",
        "Response time (p50) of one picture of the video by codec and network",
        plots::bars("From picture to receipt", "response time (ms)", &responses.collect::<Vec<_>>(), true),
    );
    add_findings(&mut section, runs, &all);
    add_missing(&mut section, runs);
    section
}

fn savings_table(all: &[MeasuredStream]) -> Table {
    let mut table = Table::new(
        "Over the LAN, for each message",
        "what is sent | codec | published row | published: saved | saved here | \
         of the median message that is a tenth smaller | bytes to the servant | bytes back | \
         messages at least a tenth smaller",
    );
    for one in all.iter().filter(|one| one.what.network == NetworkProfile::Lan) {
        let (row, published) = one.what.kind.published_saving();
        let mut cells = [one.what.kind.name(), one.what.setting.name(), row].map(str::to_owned).to_vec();
        cells.extend([format!("{published} %"), one.saving_cell(), percent(one.saving_where_encoded())]);
        cells.extend([0, 1].map(|way| count(one.sent.figure(|sent| Some(sent.carried?[way])))));
        cells.push(one.encoded_cell());
        table.push(cells);
    }
    table
}

fn times_table(all: &[MeasuredStream]) -> Table {
    let mut table = Table::new(
        "From publishing a message to its receipt, milliseconds (the publication has no such figure)",
        "what is sent | codec | network | messages | lost | p50 | p95 | p99 | bytes to the servant | saved | \
         messages at least a tenth smaller",
    );
    for one in all {
        let StreamSpec { kind, setting, network, length } = one.what;
        let mut cells = [kind.name(), setting.name(), network.name()].map(str::to_owned).to_vec();
        cells.push(length.counted.to_string());
        cells.push(count(one.sent.figure(|sent| Some(sent.lost as f64))));
        cells.extend(one.sent.percentiles(|sent| sent.responses.clone()).map(milliseconds));
        cells.push(count(one.sent.figure(|sent| Some(sent.carried?[0]))));
        cells.extend([one.saving_cell(), one.encoded_cell()]);
        table.push(cells);
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
        for one in alone.first().iter().flat_map(|alone| &alone.codecs) {
            let saved = 100.0 * (1.0 - one.bytes[1] as f64 / one.bytes[0] as f64);
            let cells = [kind.name(), &one.codec, row].map(str::to_owned);
            table.push(cells.into_iter().chain([format!("{published} %"), format!("{saved:.2} %")]));
        }
    }
    table
}

fn add_findings(section: &mut Section, runs: &CodecRuns, all: &[MeasuredStream]) {
    for one in all.iter().filter(|one| !one.is_base()) {
        if let Some(saved) = one.saving().filter(|_| one.what.network == NetworkProfile::Lan) {
            let (row, published) = one.what.kind.published_saving();
            let beside = if 100.0 * saved.median >= published { "at least" } else { "less than" };
            let lossless = if one.what.setting.is_lossy() { "" } else { " and loses nothing" };
            section.findings.push(format!(
                "{}: saves {} of the bytes{lossless}: {beside} the publication's row \u{201c}{row}\u{201d} \
                 ({published} %).",
                one.name(),
                percent(Some(saved))
            ));
        }
        let p50 = |runs: &Runs<StreamResult>| runs.figure(|sent| median(&sent.responses));
        let both = p50(one.sent).zip(one.base.and_then(p50));
        section.findings.extend(both.filter(|(with, without)| with.is_above(*without)).map(|(with, without)| {
            format!(
                "{}: a message takes longer with the codec ({} ms) than without ({} ms): encoding and decoding take \
                 more time than the network needs for what they save.",
                one.name(),
                milliseconds(Some(with)),
                milliseconds(Some(without))
            )
        }));
    }
    for (kind, alone) in &runs.alone {
        section.findings.extend(alone.first().and_then(|alone| compare_offline(*kind, alone)));
    }
}

fn compare_offline(kind: Kind, alone: &OfflineResult) -> Option<String> {
    let [published, ours] = [false, true].map(|is_ours| alone.codecs.iter().find(|made| made.ours == is_ours));
    let (published, ours) = published.zip(ours)?;
    let times = ours.bytes[1] as f64 / published.bytes[1].max(1) as f64;
    let worse = if times > 1.0 { ": worse than hoped" } else { "" };
    let known = alone.known.map(|known| format!(" Of its cells {} % are known.", digits(100.0 * known)));
    Some(format!(
        "{}: of the same {} bytes the codec {} makes {} and {} {} ({} times as many by ours{worse}).{}",
        kind.name(),
        ours.bytes[0],
        ours.codec,
        ours.bytes[1],
        published.codec,
        published.bytes[1],
        ratio(Spread::from_values(&[times])),
        known.unwrap_or_default()
    ))
}

fn add_missing(section: &mut Section, runs: &CodecRuns) {
    for (what, sent) in &runs.streams {
        let title = stream_title(what);
        let Some(first) = sent.require(section, &title) else {
            continue;
        };
        if let Some(why) = &first.warning {
            let next = "build cloudroidd and cloudroid-stub with the feature video (docs/codecs.md)";
            section.add_missing(title, why, next);
        } else if first.carried.is_none() {
            let why = "the robot has no counters of its network, or nothing was answered";
            section.add_missing(format!("{title}: bytes on the cable"), why, AGAIN);
        }
    }
    for (kind, alone) in &runs.alone {
        alone.require(section, &format!("{}: codecs alone", kind.name()));
    }
}

#[cfg(test)]
mod tests {
    use super::super::StreamLength;
    use super::super::sources::CodecOutput;
    use super::*;
    use crate::words::assert_tells;

    fn spec(setting: Setting) -> StreamSpec {
        let length = StreamLength { settle: 1, counted: 2 };
        StreamSpec { kind: Kind::Video, setting, network: NetworkProfile::Lan, length }
    }

    fn measured_stream(setting: Setting, bytes: f64, response: f64) -> (StreamSpec, Runs<StreamResult>) {
        let result = StreamResult {
            responses: vec![response; 2],
            carried: Some([bytes, 10.0]),
            each: vec![bytes as u64, 1000],
            ..StreamResult::default()
        };
        (spec(setting), Runs::from(result))
    }

    fn test_runs() -> CodecRuns {
        let made = |codec: &str, bytes: u64| CodecOutput {
            codec: codec.to_owned(),
            ours: codec == "image",
            bytes: [200, bytes],
        };
        let alone = OfflineResult { codecs: vec![made("deflate", 150), made("image", 160)], known: None };
        CodecRuns {
            streams: vec![
                measured_stream(Setting::None, 1000.0, 0.08),
                measured_stream(Setting::Auto, 500.0, 0.09),
                measured_stream(Setting::Jpeg, 50.0, 0.02),
            ],
            alone: vec![(Kind::Video, Runs::from(alone))],
            quick: false,
        }
    }

    #[test]
    fn savings_are_beside_the_published_ones() {
        let section = section(&test_runs());
        let rows = &section.tables[0].rows;
        assert_eq!(rows[0][4], "the base");
        assert_eq!(rows[1][3..5], ["75.4 %", "50.0 %"]);
        assert_eq!(rows[2][4..6], ["95.0 %", "95.0 %"]);
        assert_eq!(rows[2][8], "1 of 2");
        assert_eq!(section.tables[2].rows[0][4], "25.00 %");
        let told = section.findings.join(" ");
        for words in [
            "saves 50.0 % of the bytes and loses nothing: less than the publication's row \u{201c}video, libav\u{201d}",
            "saves 95.0 % of the bytes: at least the publication's",
            "takes longer with the codec (90.0 ms)",
            "of the same 200 bytes the codec image makes 160 and deflate 150 (1.1 times as many by ours: worse",
        ] {
            assert_tells(&told, words);
        }
        assert!(section.missing.is_empty(), "{:?}", section.missing);
    }

    #[test]
    fn a_codec_that_is_not_built_in_is_missing() {
        let mut runs = test_runs();
        let mut lacks = measured_stream(Setting::Video, 1.0, 1.0);
        lacks.1.done[0].warning = Some("codec = \"video\" is not built into this stub".to_owned());
        runs.streams.push(lacks);
        let section = section(&runs);
        assert_eq!(section.tables[0].rows.len(), 3);
        assert!(section.missing[0].why.contains("not built"));
        assert!(section.missing[0].next.contains("feature video"));
    }

    #[test]
    fn a_stream_without_its_base_saves_nothing_known() {
        let mut runs = test_runs();
        runs.streams[0].1 = Runs::from_failure("the place was killed");
        let section = section(&runs);
        assert_eq!(section.tables[0].rows[0][4], "–");
        assert!(section.missing[0].why.contains("killed"));
    }
}
