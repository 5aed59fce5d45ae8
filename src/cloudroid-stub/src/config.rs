//! `stub.toml`, which stands beside `interface.toml` in the stub's share directory, and what overrides it.
//!
//! ```toml
//! server = "ws://cloud.example:9090"   # the portal; wss:// where TLS is spoken
//! service = "opencv_apps"              # what was published
//! ca_file = "/path/ca.pem"             # for wss://: whom to trust, PEM; by default the system's authorities
//! # For wss://: the server's certificate, where no authority that is trusted has signed it; without it a certificate that
//! # signs itself is remembered when it is first seen, in the file that known_servers names.
//! fingerprint = "SHA256:5d215d215d215d215d215d215d215d215d215d215d215d215d215d215d215d21"
//! known_servers = "~/.config/cloudroid/known_servers"
//! identity = "~/.config/cloudroid"    # for wss://: where this robot's key and certificates are, once it is paired
//! token_file = "~/.config/cloudroid/token"   # holds the bearer token; none is needed where the portal asks for none
//! robot = "rover1"                     # this robot's id; by default its host name
//!
//! desire = 0.10        # T_desire, seconds: the response time that is wished for
//! max = 0.30           # T_max, seconds: the longest that is acceptable
//! threshold = 4.0      # Q_t: below it the local original is started
//! initial = 8.0        # Q at the beginning; 2·Q_t where absent
//! cap = 16.0           # Q stays below it; 4·Q_t where absent, inf for no bound
//! frames_per_second = 5.0   # instead of desire and max: least rate of an output
//! desired_frames_per_second = 10.0   # the rate that is wished for; frames_per_second where absent
//! age = 0.5            # instead of desire and max, seconds: greatest age that an output reaches
//! desired_age = 0.2    # the age that is wished for; age where absent
//! output = "/people"   # which output those are about; the one that answers the node's requests where absent
//! request = "auto"     # "auto": as the push decided (revision.toml), or "INPUT -> OUTPUT" where that is wrong
//! # The same for several, with other times than desire and max for those that need them: inputs, services and actions.
//! requests = ["/image -> /people", { request = "/plan", desire = 1.0, max = 5.0 }]
//!
//! fallback_after = 3.0 # where no time, rate or age is promised: seconds for which the link is down before the local
//!                      # original takes over, until the link is up again
//! call_limit = 600.0   # seconds that a service of the robot may take when the node in the cloud calls it
//!
//! local = "cold"       # the local original: "cold" started when needed, "warm" started at once and fed when needed,
//!                      # "first-sign" started by the first late request and fed when needed, "none"
//! stateful = false     # the local original takes over only while the link is down
//! safe_stop = "/cmd_vel"   # experimental: an output on which a message of zeros is published when neither side answers in time, or
//! safe_stop = { topic = "/cmd_vel", type = "geometry_msgs/Twist", message = { linear = { x = 0.0 } } }  # any topic
//! # The name that an executable's node has when none is given, where that is not the executable's; in ROS 2 with a namespace
//! # ("/camera/listener") where the program gives it one.
//! nodes = { "listener.py" = "listener" }
//!
//! # What the node in the cloud is to get, stated to the server with desire and max, or what else is promised:
//! class = "interactive"   # a class that the server's operator has configured
//! cpus = 1.5           # cores outright, whatever the server knows of what desire and max need
//! memory = "1G"        # and memory
//! aux = { width = 640 }   # what the service's deployer wants to know, such as the width of pictures
//!
//! stamps = "rewrite"   # "rewrite" to the cloud's clock and back, or "keep"
//! codec = "auto"       # "none", "auto" (lossless), or "jpeg": pictures may lose detail where no lossless codec keeps up
//!                      # with them or with T_max; "video" is the same as H.264, in programs that are built with it
//! quality = 80         # of "jpeg", 1 to 100
//! ```
//!
//! Each key can be given by the environment, as `CLOUDROID_` and the key in capitals, and, before that, by a ROS
//! parameter: `cloudroid/KEY` in the node's own namespace (`~cloudroid/KEY`) or in one around it.

mod aux_parameters;
mod check;
mod parameters;
mod requests;
mod sources;

pub use aux_parameters::{Aux, Scalar};

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use serde::{Deserialize, Serialize};

use tls::{Fingerprint, KnownServers, Trust};

use crate::address::Address;
use crate::pairing;
use crate::revision::Defaults;

pub use parameters::{Group, groups};
pub use requests::Requests;
pub use sources::read;

/// The file's name in the share directory.
pub const FILE: &str = "stub.toml";

/// Times, rates and counts of a configuration must be less than this.
const MOST: f64 = 1e6;

/// How the stub is to behave.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// The portal: `ws://host:port` or `wss://host:port`.
    pub server: String,
    /// The service's name.
    pub service: String,
    /// The bearer token itself; prefer `token_file`, which only its owner can read.
    #[serde(default)]
    pub token: Option<String>,
    /// A file that holds it.
    #[serde(default)]
    pub token_file: Option<PathBuf>,
    /// For `wss://`: a PEM file with the certificates to trust; the system's where absent.
    #[serde(default)]
    pub ca_file: Option<PathBuf>,
    /// For `wss://`: the certificate to trust, by its fingerprint, besides those that an authority has signed.
    #[serde(default)]
    pub fingerprint: Option<Fingerprint>,
    /// For `wss://`: where certificates are remembered that were seen first; below the user's configuration where absent.
    #[serde(default)]
    pub known_servers: Option<PathBuf>,
    /// For `wss://`: directory of the robot's own key and certificates; below the user's configuration where absent.
    #[serde(default)]
    pub identity: Option<PathBuf>,
    /// This robot's id; where absent, the one that it is paired as, or else its host name.
    #[serde(default)]
    pub robot: Option<String>,
    /// T_desire in seconds.
    #[serde(default)]
    pub desire: Option<f64>,
    /// T_max in seconds.
    #[serde(default)]
    pub max: Option<f64>,
    /// Q_t.
    #[serde(default)]
    pub threshold: Option<f64>,
    /// Q at the beginning.
    #[serde(default)]
    pub initial: Option<f64>,
    /// Q stays below it; may be infinite.
    #[serde(default)]
    pub cap: Option<f64>,
    /// Least rate of an output.
    #[serde(default)]
    pub frames_per_second: Option<f64>,
    /// The rate that is wished for.
    #[serde(default)]
    pub desired_frames_per_second: Option<f64>,
    /// Greatest age of an output in seconds.
    #[serde(default)]
    pub age: Option<f64>,
    /// The age that is wished for, seconds.
    #[serde(default)]
    pub desired_age: Option<f64>,
    /// What those two are about.
    #[serde(default)]
    pub output: Option<String>,
    /// `auto`, or `INPUT -> OUTPUT`.
    #[serde(default)]
    pub request: Option<String>,
    /// The same for several, with times of their own.
    #[serde(default)]
    pub requests: Option<Requests>,
    /// Seconds for which the link is down before the local original takes over, where no time, rate or age is promised.
    #[serde(default = "fallback_after")]
    pub fallback_after: f64,
    /// Seconds that a service of the robot may take when the node in the cloud calls it.
    #[serde(default = "call_limit")]
    pub call_limit: f64,
    /// When the local original runs.
    #[serde(default)]
    pub local: Local,
    /// The local original takes over only while the link is down.
    #[serde(default)]
    pub stateful: bool,
    /// What is published when neither side answers in time.
    #[serde(default)]
    pub safe_stop: Option<SafeStop>,
    /// A class of the server's configuration.
    #[serde(default)]
    pub class: Option<String>,
    /// Cores that are asked for outright.
    #[serde(default)]
    pub cpus: Option<f64>,
    /// Memory that is asked for outright.
    #[serde(default)]
    pub memory: Option<Scalar>,
    /// Auxiliary parameters of the service's dictionary.
    #[serde(default)]
    pub aux: Option<Aux>,
    /// What becomes of stamps while the clocks of robot and cloud differ.
    #[serde(default)]
    pub stamps: Stamps,
    /// How messages are made smaller on the link.
    #[serde(default)]
    pub codec: Codec,
    /// Quality of JPEG pictures, 1 to 100.
    #[serde(default)]
    pub quality: Option<f64>,
    /// Executable → the name its node has when none is given; in ROS 2 also with a namespace.
    #[serde(default)]
    pub nodes: BTreeMap<String, String>,
}

/// Default of [`Config::fallback_after`], seconds.
pub const FALLBACK_AFTER: f64 = 3.0;

/// What a robot says that has no authorities.
const NOBODY_TRUSTED: &str = "this robot trusts nobody yet: sudo apt install ca-certificates, or name the server's authority by ca_file in stub.toml";

fn fallback_after() -> f64 {
    FALLBACK_AFTER
}

fn call_limit() -> f64 {
    600.0
}

impl Config {
    /// Seconds without an answer, or without a frame, after which the promise is broken.
    pub fn longest(&self) -> Option<f64> {
        let interval = self.frames_per_second.map(|rate| 1.0 / rate);
        self.max.or(interval).or(self.age)
    }

    /// Quality of JPEG pictures, 1 to 100; none: the codec's own, 80.
    pub fn quality(&self) -> Option<u8> {
        self.quality.map(|quality| quality as u8)
    }

    /// [`call_limit`](Self::call_limit) as a duration.
    pub fn call_limit(&self) -> Duration {
        Duration::from_secs_f64(self.call_limit)
    }

    /// Whether a time, a rate or an age is promised.
    pub fn promises(&self) -> bool {
        let all = [self.desire, self.max, self.frames_per_second, self.age];
        all.iter().any(Option::is_some)
    }

    /// With what the service's deployer says of response times, where the robot promises nothing.
    pub fn or(self, defaults: &Defaults) -> Config {
        if self.promises() {
            return self;
        }
        Config {
            desire: defaults.desire,
            max: defaults.max,
            ..self
        }
    }

    /// This robot's id.
    pub fn robot(&self) -> String {
        let host = || {
            nix::unistd::gethostname()
                .ok()
                .and_then(|name| name.into_string().ok())
        };
        let paired = || pairing::robot(self);
        self.robot
            .clone()
            .or_else(paired)
            .or_else(host)
            .unwrap_or_else(|| "robot".to_owned())
    }

    /// The portal's address.
    pub fn address(&self) -> Result<Address, String> {
        Address::parse(&self.server)
    }

    /// Whom to trust where TLS is spoken, and what to show there.
    pub fn trust(&self) -> anyhow::Result<Trust> {
        let named = self.known_servers.as_deref().map(at_home);
        // Where a robot's certificates are, there pairing has left what it knows of servers.
        let beside = self.identity.as_deref().map(at_home);
        let beside = beside.map(|directory| directory.join("known_servers"));
        Ok(Trust {
            authorities: self.ca_file.as_deref().map(at_home),
            fingerprint: self.fingerprint,
            known: named
                .or(beside)
                .map(KnownServers::at)
                .or_else(KnownServers::of_user),
            accept: "install.sh --fingerprint".to_owned(),
            advice: NOBODY_TRUSTED,
            identity: pairing::identity(self)?,
        })
    }

    /// The bearer token.
    pub fn token(&self) -> anyhow::Result<Option<String>> {
        if let Some(token) = &self.token {
            return Ok(Some(token.clone()));
        }
        let Some(path) = &self.token_file else {
            return Ok(None);
        };
        let path = at_home(path);
        let text = std::fs::read_to_string(&path)
            .with_context(|| format!("cannot read the token in {}", path.display()))?;
        Ok(Some(text.trim().to_owned()))
    }
}

/// A path with `~` for the user's own directory.
pub fn at_home(path: &Path) -> PathBuf {
    let home = std::env::var_os("HOME").map(PathBuf::from);
    match (path.strip_prefix("~"), home) {
        (Ok(below), Some(home)) => home.join(below),
        _ => path.to_owned(),
    }
}

/// What brings the robot to rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum SafeStop {
    /// Zeros on an output of the node.
    Output(String),
    /// A message on any topic.
    Message(qos::SafeStop),
}

/// When the local original runs.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Local {
    /// Started when it is needed.
    #[default]
    Cold,
    /// Started at once, given requests when it is needed.
    Warm,
    /// Started by the first late request, given requests when it is needed.
    FirstSign,
    /// Never.
    None,
}

/// How stamps are treated while the clocks of robot and cloud differ.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Stamps {
    /// The node has them in its own clock's time, the robot in its.
    #[default]
    Rewrite,
    /// They cross as they are.
    Keep,
}

/// How messages are made smaller.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Codec {
    /// No codec: messages are sent unchanged.
    None,
    /// Where it saves time, without loss.
    #[default]
    Auto,
    /// Where it saves time; pictures may lose detail, each as a JPEG.
    Jpeg,
    /// Where it saves time; pictures may lose detail, as H.264.
    Video,
}

impl Codec {
    /// The codec by which pictures may lose detail.
    pub fn lossy(self) -> Option<codec::Codec> {
        match self {
            Self::None | Self::Auto => None,
            Self::Jpeg => Some(codec::Codec::Jpeg),
            Self::Video => Some(codec::Codec::Video),
        }
    }

    /// Why this choice has no effect with a server that decodes the codecs `decoded`, and what to do; none if it has.
    pub fn unmet(self, decoded: &[String]) -> Option<String> {
        let lossy = self.lossy()?;
        let name = lossy.name();
        let instead = match self {
            Self::Video => {
                "set codec = \"jpeg\", or use programs that are built with the feature `video` on both sides"
            }
            _ => "update the server",
        };
        if !lossy.is_built() {
            return Some(format!(
                "codec = \"{name}\" is not built into this stub, so pictures lose no detail and need more of the network; {instead}"
            ));
        }
        if !decoded.iter().any(|has| has == name) {
            return Some(format!(
                "codec = \"{name}\" is not known to the server, so pictures lose no detail and need more of the network; {instead}"
            ));
        }
        None
    }
}

#[cfg(test)]
mod tests;
