//! `stub.toml`, next to `interface.toml` in the stub's share directory, and the settings that override it.
//!
//! ```toml
//! server = "ws://cloud.example:9090"   # address of the portal; wss:// with TLS
//! service = "opencv_apps"              # name of the published service
//! ca_file = "/path/ca.pem"             # for wss://: authorities to trust, PEM (default: the system's)
//! # For wss://: fingerprint of the server's certificate, if no trusted authority has signed it. Without it, a
//! # self-signed certificate is accepted when it is first seen and stored in the file known_servers.
//! fingerprint = "SHA256:5d215d215d215d215d215d215d215d215d215d215d215d215d215d215d215d21"
//! known_servers = "~/.config/cloudroid/known_servers"
//! identity = "~/.config/cloudroid"    # for wss://: directory of the robot's key and certificates, once it is paired
//! token_file = "~/.config/cloudroid/token"   # file of the bearer token, if the portal requires one
//! robot = "rover1"                     # robot id (default: the host name)
//!
//! desire = 0.10        # T_desire: desired response time, seconds
//! max = 0.30           # T_max: longest acceptable response time, seconds
//! threshold = 4.0      # Q_t: below it the local original is started
//! initial = 8.0        # initial Q (default: 2·Q_t)
//! cap = 16.0           # upper limit of Q (default: 4·Q_t); inf for none
//! frames_per_second = 5.0   # instead of desire and max: lowest acceptable rate of an output, Hz
//! desired_frames_per_second = 10.0   # desired rate, Hz (default: frames_per_second)
//! age = 0.5            # instead of desire and max: greatest acceptable age of an output, seconds
//! desired_age = 0.2    # desired age, seconds (default: age)
//! output = "/people"   # output that the rate or age is for (default: the one that answers the node's requests)
//! request = "auto"     # "auto": as decided by the push (revision.toml), or "INPUT -> OUTPUT" to correct that
//! # Several requests, with their own times if they differ from desire and max: inputs, services and actions.
//! requests = ["/image -> /people", { request = "/plan", desire = 1.0, max = 5.0 }]
//!
//! fallback_after = 3.0 # if no time, rate or age is promised: seconds that the link is down before the local original
//!                      # takes over, until the link is up again
//! call_limit = 600.0   # longest time for a call of a robot's service by the node in the cloud, seconds
//!
//! local = "cold"       # process of the local original: "cold" is started when needed; "warm" is started at once and
//!                      # fed when needed; "first-sign" is started by the first late request and fed when needed;
//!                      # "none" disables it
//! stateful = false     # if true, the local original takes over only while the link is down
//! # Experimental: message that is published when neither side answers in time. Zeros on an output:
//! safe_stop = "/cmd_vel"
//! # Or a message on any topic:
//! safe_stop = { topic = "/cmd_vel", type = "geometry_msgs/Twist", message = { linear = { x = 0.0 } } }
//! # Name of an executable's node if none is given, where it differs from the executable's; in ROS 2 with the
//! # namespace ("/camera/listener") if the program sets one.
//! nodes = { "listener.py" = "listener" }
//!
//! # Resources for the node in the cloud, stated to the server with desire and max, or with what else is promised:
//! class = "interactive"   # class of the server's configuration
//! cpus = 1.5           # cores, instead of those that the server derives from desire and max
//! memory = "1G"        # memory, instead of what the server derives
//! aux = { width = 640 }   # auxiliary parameters that the service's deployer asks for, such as the width of images
//!
//! stamps = "rewrite"   # "rewrite" converts stamps to the cloud's clock and back, "keep" leaves them unchanged
//! codec = "auto"       # "none", "auto" (lossless), or "jpeg": images may lose detail if no lossless codec keeps up
//!                      # with them or with T_max; "video" is the same with H.264, if both programs are built with it
//! quality = 80         # quality of "jpeg", 1 to 100
//! ```
//!
//! A key can also be set by the environment variable `CLOUDROID_` with the key in capitals, and, with precedence over
//! that, by a ROS parameter: `cloudroid/KEY` in the node's own namespace (`~cloudroid/KEY`) or in one around it.

mod aux_parameters;
mod check;
mod goals;
mod parameters;
mod requests;
mod sources;

pub use aux_parameters::{Aux, Scalar};
pub use goals::OUTPUT_MEASURES;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::Context;
use serde::{Deserialize, Serialize};

use tls::{Fingerprint, KnownServers, Trust};

use crate::address::{Address, ParseAddressError};
use crate::pairing;
use crate::revision::Defaults;

pub use parameters::{ParameterGroup, group_names};
pub use requests::RequestsSetting;
pub use sources::load;

/// Name of the file in the share directory.
pub const FILE: &str = "stub.toml";

/// Upper limit of the times, rates and counts in a configuration.
const MAX_NUMBER: f64 = 1e6;

/// Settings of the stub.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Address of the portal: `ws://host:port` or `wss://host:port`.
    pub server: String,
    /// Name of the service.
    pub service: String,
    /// Bearer token; prefer `token_file`, which only its owner can read.
    #[serde(default)]
    pub token: Option<String>,
    /// File of the bearer token.
    #[serde(default)]
    pub token_file: Option<PathBuf>,
    /// For `wss://`: PEM file of the certificates to trust (default: the system's).
    #[serde(default)]
    pub ca_file: Option<PathBuf>,
    /// For `wss://`: fingerprint of the certificate to trust, besides those that an authority has signed.
    #[serde(default)]
    pub fingerprint: Option<Fingerprint>,
    /// For `wss://`: file of certificates that were accepted at first sight (default: in the user's configuration).
    #[serde(default)]
    pub known_servers: Option<PathBuf>,
    /// For `wss://`: directory of the robot's own key and certificates (default: in the user's configuration).
    #[serde(default)]
    pub identity: Option<PathBuf>,
    /// Robot id (default: the one that it is paired as, otherwise its host name).
    #[serde(default)]
    pub robot: Option<String>,
    /// T_desire in seconds.
    #[serde(default)]
    pub desire: Option<f64>,
    /// T_max in seconds.
    #[serde(default)]
    pub max: Option<f64>,
    /// Threshold Q_t.
    #[serde(default)]
    pub threshold: Option<f64>,
    /// Initial Q.
    #[serde(default)]
    pub initial: Option<f64>,
    /// Upper limit of Q; may be infinite.
    #[serde(default)]
    pub cap: Option<f64>,
    /// Lowest acceptable rate of an output, in Hz.
    #[serde(default)]
    pub frames_per_second: Option<f64>,
    /// Desired rate of an output, in Hz.
    #[serde(default)]
    pub desired_frames_per_second: Option<f64>,
    /// Greatest acceptable age of an output, in seconds.
    #[serde(default)]
    pub age: Option<f64>,
    /// Desired age of an output, in seconds.
    #[serde(default)]
    pub desired_age: Option<f64>,
    /// Output that the rate or age is for.
    #[serde(default)]
    pub output: Option<String>,
    /// `auto`, or `INPUT -> OUTPUT`.
    #[serde(default)]
    pub request: Option<String>,
    /// Several requests, with times of their own.
    #[serde(default)]
    pub requests: Option<RequestsSetting>,
    /// Time in seconds that the link is down before the local original takes over, if no time, rate or age is promised.
    #[serde(default = "fallback_after")]
    pub fallback_after: f64,
    /// Longest time in seconds for a call of a robot's service by the node in the cloud.
    #[serde(default = "call_limit")]
    pub call_limit: f64,
    /// Start of the local original.
    #[serde(default)]
    pub local: LocalMode,
    /// Set if the local original takes over only while the link is down.
    #[serde(default)]
    pub stateful: bool,
    /// Message that is published when neither side answers in time.
    #[serde(default)]
    pub safe_stop: Option<SafeStopConfig>,
    /// Class of the server's configuration.
    #[serde(default)]
    pub class: Option<String>,
    /// Requested number of cores.
    #[serde(default)]
    pub cpus: Option<f64>,
    /// Requested memory.
    #[serde(default)]
    pub memory: Option<Scalar>,
    /// Auxiliary parameters of the service's dictionary.
    #[serde(default)]
    pub aux: Option<Aux>,
    /// Treatment of stamps while the clocks of robot and cloud differ.
    #[serde(default)]
    pub stamps: StampMode,
    /// Compression of messages on the link.
    #[serde(default)]
    pub codec: CodecSetting,
    /// Quality of JPEG images, 1 to 100.
    #[serde(default)]
    pub quality: Option<f64>,
    /// Default names of nodes by executable; in ROS 2 optionally with a namespace.
    #[serde(default)]
    pub nodes: BTreeMap<String, String>,
}

/// Default of [`Config::fallback_after`], in seconds.
pub const FALLBACK_AFTER: f64 = 3.0;

/// Advice for a robot without trusted authorities.
const AUTHORITY_ADVICE: &str = "no certificate authorities are installed on this robot: sudo apt install \
    ca-certificates, or set ca_file in stub.toml to the server's authority";

fn fallback_after() -> f64 {
    FALLBACK_AFTER
}

fn call_limit() -> f64 {
    600.0
}

impl Config {
    /// Returns the time in seconds without an answer, or without a frame, after which the promise is broken.
    pub fn promise_timeout(&self) -> Option<f64> {
        let interval = self.frames_per_second.map(|rate| 1.0 / rate);
        self.max.or(interval).or(self.age)
    }

    /// Returns the quality of JPEG images, 1 to 100; `None` for the codec's default, 80.
    pub fn quality(&self) -> Option<u8> {
        self.quality.map(|quality| quality as u8)
    }

    /// Returns [`call_limit`](Self::call_limit) as a duration.
    pub fn call_limit(&self) -> Duration {
        Duration::from_secs_f64(self.call_limit)
    }

    /// Returns whether a time, a rate or an age is promised.
    pub fn has_promise(&self) -> bool {
        let all = [self.desire, self.max, self.frames_per_second, self.age];
        all.iter().any(Option::is_some)
    }

    /// Uses the response times of the service's deployer if the robot promises nothing.
    pub fn or_defaults(self, defaults: &Defaults) -> Config {
        if self.has_promise() {
            return self;
        }
        Config { desire: defaults.desire, max: defaults.max, ..self }
    }

    /// Returns the robot id.
    pub fn robot_id(&self) -> String {
        let host = || nix::unistd::gethostname().ok().and_then(|name| name.into_string().ok());
        let paired = || pairing::paired_robot(self);
        self.robot.clone().or_else(paired).or_else(host).unwrap_or_else(|| "robot".to_owned())
    }

    /// Returns the parsed address of the portal.
    pub fn address(&self) -> Result<Address, ParseAddressError> {
        Address::parse(&self.server)
    }

    /// Returns the trust settings for TLS and the identity to present.
    pub fn trust(&self) -> anyhow::Result<Trust> {
        let named = self.known_servers.as_deref().map(expand_home);
        // Pairing stores the known servers in the directory of the robot's certificates.
        let beside = self.identity.as_deref().map(expand_home);
        let beside = beside.map(|directory| directory.join("known_servers"));
        Ok(Trust {
            authorities: self.ca_file.as_deref().map(expand_home),
            fingerprint: self.fingerprint,
            known: named.or(beside).map(KnownServers::new).or_else(KnownServers::for_user),
            accept: "install.sh --fingerprint".to_owned(),
            advice: AUTHORITY_ADVICE,
            identity: pairing::load_identity(self)?,
        })
    }

    /// Returns the bearer token.
    pub fn token(&self) -> anyhow::Result<Option<String>> {
        if let Some(token) = &self.token {
            return Ok(Some(token.clone()));
        }
        let Some(path) = &self.token_file else {
            return Ok(None);
        };
        let path = expand_home(path);
        let text =
            std::fs::read_to_string(&path).with_context(|| format!("cannot read the token in {}", path.display()))?;
        Ok(Some(text.trim().to_owned()))
    }
}

/// Replaces a leading `~` of a path with the user's home directory.
pub fn expand_home(path: &Path) -> PathBuf {
    let home = std::env::var_os("HOME").map(PathBuf::from);
    match (path.strip_prefix("~"), home) {
        (Ok(below), Some(home)) => home.join(below),
        _ => path.to_owned(),
    }
}

/// Message that brings the robot to rest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum SafeStopConfig {
    /// Zeros on an output of the node.
    Output(String),
    /// A message on any topic.
    Message(qos::SafeStop),
}

/// Start of the local original.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LocalMode {
    /// Started when it is needed.
    #[default]
    Cold,
    /// Started at once, given requests when it is needed.
    Warm,
    /// Started by the first late request, given requests when it is needed.
    FirstSign,
    /// Never started.
    None,
}

/// Treatment of stamps while the clocks of robot and cloud differ.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StampMode {
    /// Converted, so that the node and the robot each see their own clock's time.
    #[default]
    Rewrite,
    /// Unchanged.
    Keep,
}

/// Compression of messages.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CodecSetting {
    /// No codec: messages are sent unchanged.
    None,
    /// Lossless, if it saves time.
    #[default]
    Auto,
    /// JPEG where that saves time; images may lose detail.
    Jpeg,
    /// H.264 where that saves time; images may lose detail.
    Video,
}

impl CodecSetting {
    /// Returns the lossy codec for images.
    pub fn lossy(self) -> Option<codec::Codec> {
        match self {
            Self::None | Self::Auto => None,
            Self::Jpeg => Some(codec::Codec::Jpeg),
            Self::Video => Some(codec::Codec::Video),
        }
    }

    /// Returns why this setting has no effect with a server that decodes the codecs `decoded`, and what to do; `None`
    /// if it has.
    pub fn unsupported_reason(self, decoded: &[String]) -> Option<String> {
        let lossy = self.lossy()?;
        let name = lossy.name();
        let instead = match self {
            Self::Video => "set codec = \"jpeg\", or use a stub and a server that are built with the feature `video`",
            _ => "update the server",
        };
        if !lossy.is_available() {
            return Some(format!(
                "codec = \"{name}\" is not built into this stub, so images are sent lossless and need more bandwidth; \
                    {instead}"
            ));
        }
        if !decoded.iter().any(|has| has == name) {
            return Some(format!(
                "codec = \"{name}\" is not supported by the server, so images are sent lossless and need more \
                    bandwidth; {instead}"
            ));
        }
        None
    }
}

#[cfg(test)]
mod tests;
