//! Experiment 8: images and maps are sent from a robot to a servant with each codec that `stub.toml` offers: bytes on
//! the cable, and response times on each network. What lossy codecs lose is measured by benches/codecs.

mod report;
mod sources;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use crate::cells::{RunCache, Runs};
use crate::examples::{DETECTOR, EvalFixtures, ExecutionSite, publish_once};
use crate::place::{NetworkProfile, RobotHardware, RobotSandbox};
use crate::robot::{NodeUnderTest, RobotPlan};
use crate::section::About;
use crate::trace::{RequestSample, Trace};

pub use report::section;
use sources::{OfflineResult, StreamSources};

/// The experiment.
pub const ABOUT: About = About {
    number: 8,
    id: "codecs",
    title: "Bytes that codecs save",
    published: "Table I of the publication: video by libav saves 75.4 %, images by deflate 96.1 %, grid maps by zlib \
        99.9 %; how much libav loses is not published.",
    differs: &[
        "Bytes are those of packets on the robot's cable, with the heads of TCP, IP and WebSocket. An ultrabook \
         sends one message after the other's receipt; the first are not counted: by then the link has \
         measured itself and chosen.",
        "The codec is the key `codec` of stub.toml: none (the base of each saving); auto (lossless); jpeg (quality 80) \
         and video (H.264, quantiser 22), which are taken where no lossless codec is quick enough: here T_max is 0.08 \
         s, so that they are.",
        "The video is vtest.avi of Debian's opencv-doc, images are photographs of the same package, scaled to 640x480, \
         the map is laser_slam's of a recorded drive, alone and in the middle of 4000 x 4000 cells, as gmapping \
         publishes it. Photographs and the large map are sent over the LAN alone.",
    ],
};

/// A node that answers each message with its header.
const PACKAGE: &str = "receipts_py";
const EXECUTABLE: &str = "receipts.py";
const CLASS: RobotHardware = RobotHardware::ULTRABOOK;
/// T_desire and T_max (seconds) that make the link choose a lossy codec: no lossless one transfers an image in a
/// quarter of that time.
const HURRY: (f64, f64) = (0.04, 0.08);

/// Data that is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Kind {
    Video,
    Pictures,
    Map,
    /// The map at the centre of 4000 x 4000 cells.
    LargeMap,
}

impl Kind {
    pub fn name(self) -> &'static str {
        match self {
            Self::Video => "video, 640x480",
            Self::Pictures => "photographs, 640x480",
            Self::Map => "map of laser_slam",
            Self::LargeMap => "the same map in 4000x4000 cells",
        }
    }

    /// Returns the row of the publication (Table I), and the space saved there in percent.
    pub fn published_saving(self) -> (&'static str, f64) {
        match self {
            Self::Video => ("video, libav", 75.4),
            Self::Pictures => ("image, deflate", 96.1),
            Self::Map | Self::LargeMap => ("grid map, zlib", 99.9),
        }
    }

    fn is_map(self) -> bool {
        matches!(self, Self::Map | Self::LargeMap)
    }

    fn topic(self) -> &'static str {
        if self.is_map() { "/map" } else { "/image" }
    }
}

/// Values of `codec` in `stub.toml`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Setting {
    /// No encoding: the reference for the savings of the others.
    None,
    Auto,
    /// JPEG with the default quality, 80.
    Jpeg,
    /// H.264, in programs that are built with it.
    Video,
}

impl Setting {
    /// Name in `stub.toml`.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Auto => "auto",
            Self::Jpeg => "jpeg",
            Self::Video => "video",
        }
    }

    fn is_lossy(self) -> bool {
        matches!(self, Self::Jpeg | Self::Video)
    }
}

/// Number of messages to send.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct StreamLength {
    /// Messages after which the link has measured its rate and chosen a codec.
    settle: usize,
    counted: usize,
}

impl StreamLength {
    fn for_stream(kind: Kind, setting: Setting, quick: bool) -> Self {
        let settle = match setting {
            // There is no codec to choose.
            Setting::None => 3,
            _ if kind == Kind::LargeMap => 12,
            _ => 24,
        };
        let counted = match kind {
            Kind::LargeMap => 4,
            _ if quick => 8,
            _ => 20,
        };
        Self { settle, counted }
    }

    fn total(self) -> usize {
        self.settle + self.counted
    }
}

/// Parameters of one stream.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct StreamSpec {
    kind: Kind,
    setting: Setting,
    network: NetworkProfile,
    length: StreamLength,
}

/// Measurements of one stream.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct StreamResult {
    /// Seconds from publishing a message to its receipt.
    responses: Vec<f64>,
    lost: usize,
    /// Bytes of packets on the cable per message, to the servant and back.
    carried: Option<[f64; 2]>,
    each: Vec<u64>,
    warning: Option<String>,
}

/// Results of all streams.
pub struct CodecRuns {
    streams: Vec<(StreamSpec, Runs<StreamResult>)>,
    alone: Vec<(Kind, Runs<OfflineResult>)>,
    quick: bool,
}

/// Measures all streams; a quick evaluation sends a video over the LAN, without a codec and as JPEG.
pub fn measure(cells: &RunCache, workshop: &EvalFixtures, quick: bool) -> Result<CodecRuns> {
    let sources = StreamSources { cells, workshop };
    let mut runs = CodecRuns { streams: Vec::new(), alone: Vec::new(), quick };
    for what in streams_to_measure(quick) {
        // A codec that is not built into the programs is missing on every network.
        let lacks = |sent: &Runs<StreamResult>| sent.first().is_some_and(|sent| sent.warning.is_some());
        if runs.streams.iter().any(|(other, sent)| other.setting == what.setting && lacks(sent)) {
            continue;
        }
        let name = format!("codecs {}", stream_title(&what));
        let sent = cells.repeat(&name, &(&what, CLASS), || send_stream(&sources, &what))?;
        runs.streams.push((what, sent));
    }
    for kind in [Kind::Video, Kind::Pictures, Kind::Map, Kind::LargeMap] {
        if runs.streams.iter().any(|(what, _)| what.kind == kind) {
            let name = format!("codecs alone {}", kind.name());
            runs.alone.push((kind, cells.measure(&name, &kind, || sources.encode_offline(kind))?));
        }
    }
    Ok(runs)
}

fn send_stream(sources: &StreamSources, what: &StreamSpec) -> Result<StreamResult> {
    let directory = sources.workshop.directory()?;
    let plan = robot_plan(sources, what, directory.path())?;
    let place = RobotSandbox::new(&sources.workshop.daemon.address, CLASS, what.network)?;
    let (trace, _) = place.run(&plan, directory.path())?;
    let (sent, wanted) = (trace.requests.len(), what.length.total());
    let why = trace.node_ended.as_deref().unwrap_or("nobody knows why");
    ensure!(sent == wanted, "only {sent} of {wanted} messages were sent: {why}");
    Ok(stream_result(&trace, what.length.settle))
}

fn stream_title(what: &StreamSpec) -> String {
    format!("{} {} {}", what.kind.name(), what.setting.name(), what.network.name())
}

fn streams_to_measure(quick: bool) -> Vec<StreamSpec> {
    use {Kind::*, NetworkProfile::*};
    let networks: &[NetworkProfile] = if quick { &[Lan] } else { &[Lan, Wan, Wifi] };
    let mut wanted = Vec::new();
    let mut add = |kind: Kind, settings: &[Setting], networks: &[NetworkProfile]| {
        for network in networks {
            wanted.extend(settings.iter().map(|setting| StreamSpec {
                kind,
                setting: *setting,
                network: *network,
                length: StreamLength::for_stream(kind, *setting, quick),
            }));
        }
    };
    if quick {
        add(Video, &[Setting::None, Setting::Jpeg], networks);
        return wanted;
    }
    let all = [Setting::None, Setting::Auto, Setting::Jpeg, Setting::Video];
    add(Video, &all, networks);
    add(Pictures, &all[..3], &[Lan]);
    add(Map, &all[..2], networks);
    add(LargeMap, &all[..2], &[Lan]);
    wanted
}

fn robot_plan(sources: &StreamSources, what: &StreamSpec, directory: &std::path::Path) -> Result<RobotPlan> {
    let workshop = sources.workshop;
    publish_receipts(workshop)?;
    let (topic, answer) = (what.kind.topic(), format!("/{PACKAGE}/receipt"));
    let mut settings = format!(
        "service = \"{PACKAGE}\"\nlocal = \"none\"\ncodec = \"{}\"\nrequest = \"{topic} -> {answer}\"",
        what.setting.name()
    );
    if what.setting.is_lossy() {
        settings += &format!("\ndesire = {:?}\nmax = {:?}", HURRY.0, HURRY.1);
    }
    let base = workshop.plan(&DETECTOR, ExecutionSite::Outsourced, directory)?;
    Ok(RobotPlan {
        node: NodeUnderTest::Stub {
            package: PACKAGE.to_owned(),
            executable: EXECUTABLE.to_owned(),
            argv: vec![format!("__name:={PACKAGE}")],
            settings,
            environment: Vec::new(),
        },
        recording: sources.recording(what.kind, directory)?,
        request: topic.to_owned(),
        answer,
        timing: None,
        most: what.length.total(),
        patience: 240.0,
        ..base
    })
}

/// Publishes the node that sends receipts, unless it has been published, or has failed, before.
fn publish_receipts(workshop: &EvalFixtures) -> Result<()> {
    publish_once(workshop.daemon, PACKAGE, || {
        let with = ["--node", EXECUTABLE, "--cpus", "1", "--memory", "1G"];
        let pushed = workshop.daemon.deployer().push(PACKAGE, &with);
        pushed?.expect_success().context("pushing the node that answers")?;
        Ok(())
    })
}

fn stream_result(trace: &Trace, settle: usize) -> StreamResult {
    let counted = trace.requests.get(settle..).unwrap_or_default();
    StreamResult {
        responses: counted.iter().filter_map(|one| one.response).collect(),
        lost: counted.iter().filter(|one| one.response.is_none()).count(),
        carried: trace.bytes_per_request(settle),
        each: bytes_per_message(&trace.requests, settle),
        // Without the timestamp and the target that the log puts before the message.
        warning: trace.warnings.iter().find_map(|line| {
            let words = line.find("codec = ").map(|begin| &line[begin..]);
            words.map(str::to_owned)
        }),
    }
}

/// Bytes to the servant of each message after the first `settle` ones, for which its answer and the previous one
/// arrived.
fn bytes_per_message(requests: &[RequestSample], settle: usize) -> Vec<u64> {
    let sent = |request: &RequestSample| request.carried.map(|carried| carried[0]);
    let pairs = requests.windows(2).skip(settle.saturating_sub(1));
    let between = pairs.filter_map(|pair| sent(&pair[1])?.checked_sub(sent(&pair[0])?));
    between.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_counted_from_answer_to_answer() {
        let one = |carried: Option<[u64; 2]>| RequestSample {
            carried,
            response: carried.map(|_| 0.1),
            ..RequestSample::default()
        };
        let requests =
            [one(Some([900, 90])), one(Some([1000, 100])), one(Some([1300, 110])), one(None), one(Some([1900, 130]))];
        assert_eq!(bytes_per_message(&requests, 2), [300]);
        let trace = |requests: &[RequestSample]| Trace { requests: requests.to_vec(), ..Trace::default() };
        assert_eq!(trace(&requests).bytes_per_request(2), Some([300.0, 10.0]));
        assert_eq!(trace(&requests).bytes_per_request(0), None);
        assert_eq!(trace(&requests[..2]).bytes_per_request(2), None);
        let sent = stream_result(&trace(&requests), 2);
        assert_eq!((sent.lost, sent.responses.len()), (1, 2));
    }

    #[test]
    fn every_stream_has_a_base() {
        for quick in [true, false] {
            let all = streams_to_measure(quick);
            for what in &all {
                let base = all.iter().any(|base| {
                    base.setting == Setting::None && base.kind == what.kind && base.network == what.network
                });
                assert!(base, "{what:?}");
            }
        }
    }
}
