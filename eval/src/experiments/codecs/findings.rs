//! Findings of the codec experiment, in sentences.

use super::sources::OfflineResult;
use super::told::{count_encoded, find_base, lan_streams, measured_streams, saving};
use super::{CodecRuns, Kind, Setting, StreamResult, StreamSpec};
use crate::statistics::{median, median_interval};
use crate::words::{digits, ratio};

/// Confidence of the intervals of medians, which must not overlap if one median is called longer than another.
const CONFIDENCE: f64 = 0.95;

pub(super) fn findings(runs: &CodecRuns) -> Vec<String> {
    let mut findings: Vec<String> = lan_streams(runs)
        .filter(|(what, _)| what.setting != Setting::None)
        .filter_map(|(what, sent)| Some(compare_with_published(what, saving(runs, what, sent)?)))
        .collect();
    for (what, sent) in measured_streams(runs).filter(|(what, _)| what.setting != Setting::None) {
        findings.extend(unencoded_finding(runs, what, sent));
        findings.extend(slower_finding(runs, what, sent));
    }
    for (kind, alone) in &runs.alone {
        if let Some(alone) = alone.value() {
            findings.extend(larger_than_deflate(*kind, alone));
        }
    }
    findings
}

fn compare_with_published(what: &StreamSpec, saved: f64) -> String {
    let (row, published) = what.kind.published_saving();
    // Rounded as both are printed.
    let less = published - (10.0 * saved).round() / 10.0;
    let beside = if saved >= published {
        "at least as many as".to_owned()
    } else {
        format!("{less:.1} percentage points less than")
    };
    let lossless = if what.setting.is_lossy() { "" } else { " and loses nothing" };
    format!(
        "{}: codec {} saves {saved:.1} % of the bytes{lossless}: {beside} the publication's row \u{201c}{row}\u{201d} \
         ({published} %).",
        what.kind.name(),
        what.setting.name()
    )
}

/// Reports messages that the link did not encode although it could have.
fn unencoded_finding(runs: &CodecRuns, what: &StreamSpec, sent: &StreamResult) -> Option<String> {
    let plain = sent.each.len() - count_encoded(runs, what, sent)?;
    (plain > 0).then(|| {
        format!(
            "{}, codec {}, {}: {plain} of {} messages took nine tenths of the bytes or more: the link sent them as \
             they are, which it does until it has measured itself and where it is quick, or the codec saves less than \
             a tenth of them.",
            what.kind.name(),
            what.setting.name(),
            what.network.name(),
            sent.each.len()
        )
    })
}

fn slower_finding(runs: &CodecRuns, what: &StreamSpec, sent: &StreamResult) -> Option<String> {
    let plain = find_base(runs, what)?.1;
    let [with, without] = [sent, plain].map(|sent| median(&sent.responses));
    let (with, without) = with.zip(without)?;
    let interval = |sent: &StreamResult| median_interval(&sent.responses, CONFIDENCE);
    let ((low, _), (_, high)) = interval(sent).zip(interval(plain))?;
    (low > high).then(|| {
        format!(
            "{}, codec {}, {}: a message takes longer with the codec ({} ms) than without ({} ms): encoding and \
             decoding take more time than the network needs for what they save.",
            what.kind.name(),
            what.setting.name(),
            what.network.name(),
            digits(with * 1e3),
            digits(without * 1e3)
        )
    })
}

fn larger_than_deflate(kind: Kind, alone: &OfflineResult) -> Option<String> {
    let published = alone.codecs.iter().find(|made| !made.ours)?;
    let ours = alone.codecs.iter().find(|made| made.ours)?;
    let known = alone.known.map_or_else(String::new, |known| {
        format!(
            " Of its cells {:.1} % are known: what is not known costs nearly nothing, so that a map of which less is \
             known saves more.",
            100.0 * known
        )
    });
    let larger = ours.bytes[1] > published.bytes[1];
    (larger || alone.known.is_some()).then(|| {
        format!(
            "{}: of the same {} bytes the codec {} makes {} and {} {} ({} times as many{}).{known}",
            kind.name(),
            ours.bytes[0],
            ours.codec,
            ours.bytes[1],
            published.codec,
            published.bytes[1],
            ratio(Some(ours.bytes[1] as f64 / published.bytes[1].max(1) as f64)),
            if larger { " by ours: worse than hoped" } else { " by ours" }
        )
    })
}
