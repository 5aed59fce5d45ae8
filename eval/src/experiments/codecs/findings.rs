//! What the figures of codecs say, in sentences.

use super::sources::Alone;
use super::told::{base, done, encoded, lan, saving};
use super::{Kind, Runs, Sent, Setting, What};
use crate::statistics::{median, median_interval};
use crate::words::{digits, ratio};

/// Of the medians' intervals, which must not overlap where one is called longer than the other.
const CONFIDENCE: f64 = 0.95;

pub(super) fn findings(runs: &Runs) -> Vec<String> {
    let mut findings: Vec<String> = lan(runs)
        .filter(|(what, _)| what.setting != Setting::None)
        .filter_map(|(what, sent)| Some(beside_published(what, saving(runs, what, sent)?)))
        .collect();
    for (what, sent) in done(runs).filter(|(what, _)| what.setting != Setting::None) {
        findings.extend(as_they_are(runs, what, sent));
        findings.extend(slower(runs, what, sent));
    }
    for (kind, alone) in &runs.alone {
        if let Some(alone) = alone.done() {
            findings.extend(larger_than_deflate(*kind, alone));
        }
    }
    findings
}

fn beside_published(what: &What, saved: f64) -> String {
    let (row, published) = what.kind.published();
    // As both are printed.
    let less = published - (10.0 * saved).round() / 10.0;
    let beside = if saved >= published {
        "at least as many as".to_owned()
    } else {
        format!("{less:.1} percentage points less than")
    };
    let lossless = if what.setting.is_lossy() {
        ""
    } else {
        " and loses nothing"
    };
    format!(
        "{}: codec {} saves {saved:.1} % of the bytes{lossless}: {beside} the publication's row \u{201c}{row}\u{201d} ({published} %).",
        what.kind.name(),
        what.setting.name()
    )
}

/// Where the link did not encode what it could have encoded.
fn as_they_are(runs: &Runs, what: &What, sent: &Sent) -> Option<String> {
    let plain = sent.each.len() - encoded(runs, what, sent)?;
    (plain > 0).then(|| {
        format!(
            "{}, codec {}, {}: {plain} of {} messages took nine tenths of the bytes or more: the link sent them as they are, which it does until it has measured itself and where it is quick, or the codec saves less than a tenth of them.",
            what.kind.name(),
            what.setting.name(),
            what.network.name(),
            sent.each.len()
        )
    })
}

fn slower(runs: &Runs, what: &What, sent: &Sent) -> Option<String> {
    let plain = base(runs, what)?.1;
    let [with, without] = [sent, plain].map(|sent| median(&sent.responses));
    let (with, without) = with.zip(without)?;
    let interval = |sent: &Sent| median_interval(&sent.responses, CONFIDENCE);
    let ((low, _), (_, high)) = interval(sent).zip(interval(plain))?;
    (low > high).then(|| {
        format!(
            "{}, codec {}, {}: a message takes longer with the codec ({} ms) than without ({} ms): encoding and decoding take more time than the network needs for what they save.",
            what.kind.name(),
            what.setting.name(),
            what.network.name(),
            digits(with * 1e3),
            digits(without * 1e3)
        )
    })
}

fn larger_than_deflate(kind: Kind, alone: &Alone) -> Option<String> {
    let published = alone.codecs.iter().find(|made| !made.ours)?;
    let ours = alone.codecs.iter().find(|made| made.ours)?;
    let known = alone.known.map_or_else(String::new, |known| {
        format!(
            " Of its cells {:.1} % are known: what is not known costs nearly nothing, so that a map of which less is known saves more.",
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
            ratio(Some(
                ours.bytes[1] as f64 / published.bytes[1].max(1) as f64
            )),
            if larger {
                " by ours: worse than hoped"
            } else {
                " by ours"
            }
        )
    })
}
