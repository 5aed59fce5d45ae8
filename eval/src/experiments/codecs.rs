//! Experiment 8: pictures and maps go from a robot to a servant with each codec that `stub.toml` can name: bytes on the cable, response times
//! on each network, and what lossy codecs lose.

mod findings;
mod received;
mod sources;
mod told;

use anyhow::{Context, Result, ensure};
use serde::{Deserialize, Serialize};

use crate::attempts;
use crate::cells::{Cells, Measured};
use crate::examples::{DETECTOR, Where, Workshop};
use crate::place::{Class, Network, Place};
use crate::robot::{Node, Plan};
use crate::trace::{Request, Trace};

use received::Received;
use sources::{Alone, Sources};
pub use told::section;

/// A node that answers each message by its header.
const PACKAGE: &str = "receipts_py";
const EXECUTABLE: &str = "receipts.py";
const CLASS: Class = Class::ULTRABOOK;
/// T_desire and T_max (seconds) where a lossy codec is to be used: no lossless one brings a picture over in a quarter of that.
const HURRY: (f64, f64) = (0.04, 0.08);

/// What is sent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Kind {
    /// Frames of a video, one after the other.
    Video,
    /// Photographs that have nothing to do with one another.
    Pictures,
    /// The map of a drive.
    Map,
    /// The same in the middle of 4000 x 4000 cells.
    LargeMap,
}

impl Kind {
    /// As tables name it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Video => "video, 640x480",
            Self::Pictures => "photographs, 640x480",
            Self::Map => "map of laser_slam",
            Self::LargeMap => "the same map in 4000x4000 cells",
        }
    }

    /// The published row, and the share that was saved there (Table I), percent.
    pub fn published(self) -> (&'static str, f64) {
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

/// What `codec` is in `stub.toml`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Setting {
    /// Nothing is encoded: the base of what others save.
    None,
    /// Without loss.
    Auto,
    /// JPEG of the usual quality, 80.
    Jpeg,
    /// H.264, in programs that are built with it.
    Video,
}

impl Setting {
    /// As `stub.toml` has it.
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

/// How many messages are sent.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct Length {
    /// By then the link knows how fast it is, and has chosen.
    settle: usize,
    counted: usize,
}

impl Length {
    fn of(kind: Kind, setting: Setting, quick: bool) -> Self {
        let settle = match setting {
            // There is nothing to choose.
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

    fn all(self) -> usize {
        self.settle + self.counted
    }
}

/// One stream.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct What {
    kind: Kind,
    setting: Setting,
    network: Network,
    length: Length,
}

/// What one stream took.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Sent {
    /// Seconds from publishing a message to its receipt.
    responses: Vec<f64>,
    /// Messages without a receipt.
    lost: usize,
    /// Bytes of packets on the cable for each message, to the servant and back.
    carried: Option<[f64; 2]>,
    /// Those to the servant, message by message.
    each: Vec<u64>,
    /// What the stub had to say of the codec.
    warning: Option<String>,
}

/// All that was measured.
pub struct Runs {
    streams: Vec<(What, Measured<Sent>)>,
    received: Vec<(What, Measured<Received>)>,
    alone: Vec<(Kind, Measured<Alone>)>,
    quick: bool,
}

/// Measures all; a quick evaluation sends a video over the LAN, as it is and as JPEG.
pub fn measure(cells: &Cells, workshop: &Workshop, quick: bool) -> Result<Runs> {
    let sources = Sources { cells, workshop };
    let mut runs = Runs {
        streams: Vec::new(),
        received: Vec::new(),
        alone: Vec::new(),
        quick,
    };
    for what in wanted(quick) {
        // What is not built into the programs is missing on every network.
        let lacks = |(other, sent): &(What, Measured<Sent>)| {
            other.setting == what.setting && sent.done().is_some_and(|sent| sent.warning.is_some())
        };
        if runs.streams.iter().any(lacks) {
            continue;
        }
        let Length { settle, counted } = what.length;
        let name = format!("codecs {}", title(&what));
        let sent = cells.measure(&name, &(&what, CLASS), || {
            let directory = workshop.directory()?;
            let plan = plan(&sources, &what, directory.path())?;
            let place = Place::new(&workshop.daemon.address, CLASS, what.network)?;
            let (trace, _) = place.runs(&plan, directory.path())?;
            ensure!(
                trace.requests.len() == settle + counted,
                "only {} of {} messages were sent: {}",
                trace.requests.len(),
                settle + counted,
                trace.node_ended.as_deref().unwrap_or("nobody knows why")
            );
            Ok(sent(&trace, settle))
        })?;
        // Without the codec nothing is to be seen of it.
        let lacks = sent.done().is_some_and(|sent| sent.warning.is_some());
        runs.streams.push((what, sent));
        if what.setting.is_lossy() && what.network == Network::Lan && !lacks {
            let name = format!("codecs received {}", title(&what));
            let received = cells.measure(&name, &(&what, CLASS), || {
                received::measure(&sources, &what)
            })?;
            runs.received.push((what, received));
        }
    }
    for kind in [Kind::Video, Kind::Pictures, Kind::Map, Kind::LargeMap] {
        if runs.streams.iter().any(|(what, _)| what.kind == kind) {
            let name = format!("codecs alone {}", kind.name());
            let alone = cells.measure(&name, &kind, || sources.alone(kind))?;
            runs.alone.push((kind, alone));
        }
    }
    Ok(runs)
}

fn title(what: &What) -> String {
    format!(
        "{} {} {}",
        what.kind.name(),
        what.setting.name(),
        what.network.name()
    )
}

/// In the order of the published table.
fn wanted(quick: bool) -> Vec<What> {
    use {Kind::*, Network::*};
    let networks: &[Network] = if quick { &[Lan] } else { &[Lan, Wan, Wifi] };
    let mut wanted = Vec::new();
    let mut add = |kind: Kind, settings: &[Setting], networks: &[Network]| {
        for network in networks {
            wanted.extend(settings.iter().map(|setting| What {
                kind,
                setting: *setting,
                network: *network,
                length: Length::of(kind, *setting, quick),
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

/// What the robot does.
fn plan(sources: &Sources, what: &What, directory: &std::path::Path) -> Result<Plan> {
    let workshop = sources.workshop;
    publishes(workshop)?;
    let (topic, answer) = (what.kind.topic(), format!("/{PACKAGE}/receipt"));
    let mut settings = format!(
        "service = \"{PACKAGE}\"\nlocal = \"none\"\ncodec = \"{}\"\nrequest = \"{topic} -> {answer}\"",
        what.setting.name()
    );
    if what.setting.is_lossy() {
        settings += &format!("\ndesire = {:?}\nmax = {:?}", HURRY.0, HURRY.1);
    }
    let base = workshop.plan(&DETECTOR, Where::Outsourced, directory)?;
    Ok(Plan {
        node: Node::Stub {
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
        most: what.length.all(),
        patience: 240.0,
        ..base
    })
}

/// Publishes the node that answers, unless that was done before or has failed before.
fn publishes(workshop: &Workshop) -> Result<()> {
    let services = workshop.daemon.deployer().asks(&["services"])?;
    let known = services
        .as_array()
        .is_some_and(|all| all.iter().any(|service| service["name"] == PACKAGE));
    if known {
        return Ok(());
    }
    attempts::once(PACKAGE, || {
        eprintln!("pushing {PACKAGE}");
        let with = ["--node", EXECUTABLE, "--cpus", "1", "--memory", "1G"];
        let pushed = workshop.daemon.deployer().pushes(PACKAGE, &with);
        pushed?
            .succeeded()
            .context("pushing the node that answers")?;
        Ok(())
    })
}

fn sent(trace: &Trace, settle: usize) -> Sent {
    let counted = trace.requests.get(settle..).unwrap_or_default();
    Sent {
        responses: counted.iter().filter_map(|one| one.response).collect(),
        lost: counted.iter().filter(|one| one.response.is_none()).count(),
        carried: trace.carried_each(settle),
        each: each(&trace.requests, settle),
        // Without the time and the place in the program that the log puts before it.
        warning: trace.warnings.iter().find_map(|line| {
            let words = line.find("codec = ").map(|begin| &line[begin..]);
            words.map(str::to_owned)
        }),
    }
}

/// Bytes to the servant of each message after the first ones, where its answer and that of the one before came.
fn each(requests: &[Request], settle: usize) -> Vec<u64> {
    let sent = |request: &Request| request.carried.map(|carried| carried[0]);
    let pairs = requests.windows(2).skip(settle.saturating_sub(1));
    let between = pairs.filter_map(|pair| sent(&pair[1])?.checked_sub(sent(&pair[0])?));
    between.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bytes_are_counted_from_answer_to_answer() {
        let one = |carried: Option<[u64; 2]>| Request {
            carried,
            response: carried.map(|_| 0.1),
            ..Request::default()
        };
        let requests = [
            one(Some([900, 90])),
            one(Some([1000, 100])),
            one(Some([1300, 110])),
            one(None),
            one(Some([1900, 130])),
        ];
        assert_eq!(each(&requests, 2), [300]);
        let trace = |requests: &[Request]| Trace {
            requests: requests.to_vec(),
            ..Trace::default()
        };
        assert_eq!(trace(&requests).carried_each(2), Some([300.0, 10.0]));
        assert_eq!(trace(&requests).carried_each(0), None);
        assert_eq!(trace(&requests[..2]).carried_each(2), None);
        let sent = sent(&trace(&requests), 2);
        assert_eq!((sent.lost, sent.responses.len()), (1, 2));
    }

    #[test]
    fn every_stream_has_a_base() {
        for quick in [true, false] {
            let all = wanted(quick);
            for what in &all {
                let base = all.iter().any(|base| {
                    base.setting == Setting::None
                        && base.kind == what.kind
                        && base.network == what.network
                });
                assert!(base, "{what:?}");
            }
        }
    }
}
