//! Pushing a package: options in the query, an archive in the body, a stream of events as the response.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::grants::Grants;
use crate::group::Shared;
use crate::limits::{Caps, Limits};
use crate::problem::Problem;
use crate::service::ServiceDetail;
use crate::sla::Sla;
use crate::underlays::Underlay;
pub use qos::ParsePairError;

/// Options of a push (`POST /api/v1/push?options=JSON`; the body is a tar archive, gzipped or not; empty with `apt`).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PushOptions {
    /// Name of the service (default: the name of the package).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// ROS package of the distribution to publish instead of an archive.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub apt: Option<String>,
    /// Name of the base image definition.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base: Option<String>,
    /// Launch file, relative to the package, or its bare name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub launch: Option<String>,
    /// Executables to run instead of a launch file: `EXE` or `PACKAGE/EXE`, followed by arguments that are split as by
    /// a shell.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<String>,
    /// Private parameters of the nodes (`~K`), or global ones if they begin with `/`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub params: BTreeMap<String, serde_json::Value>,
    /// Arguments of the launch file.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub args: BTreeMap<String, String>,
    /// Name remappings, from → to.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub remaps: BTreeMap<String, String>,
    /// Additions to the interface, where the push cannot find all of it: the text of a TOML or JSON file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub interface: Option<String>,
    /// Manual dependency mapping: rosdep key or ROS package → Debian packages, or packages of the push or the base;
    /// empty for a key that needs none.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub map: BTreeMap<String, String>,
    /// Request pairs that override those found by the push: `INPUT=OUTPUT`, or as in a robot's stub.toml,
    /// `INPUT -> OUTPUT, OUTPUT by arrival`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub requests: Vec<String>,
    /// Additional Debian or ROS packages, for the build and at run time.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub with: Vec<String>,
    /// Packages of the workspace to build, with those that they need (default: what the chosen nodes need).
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub packages_up_to: Vec<String>,
    /// Packages of the workspace that are not built.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub packages_skip: Vec<String>,
    /// Arguments of CMake for the packages of the push, such as `-DWITH_QT=OFF`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cmake_args: Vec<String>,
    /// Underlays to compile and run upon; of two, the later one lies above.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub on: Vec<String>,
    /// Name under which the workspace becomes an underlay for others, instead of a service.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub as_underlay: Option<String>,
    /// Resource limits of a servant; limits that are given are also reserved.
    pub limits: Limits,
    /// Upper limits on what robots may request.
    #[serde(skip_serializing_if = "Caps::is_empty")]
    pub caps: Caps,
    /// Default SLA of stubs whose robot states none; only `rrt` and `max_rrt`.
    #[serde(skip_serializing_if = "Sla::is_empty")]
    pub sla: Sla,
    /// Access to devices, volumes and hosts beyond the container.
    #[serde(skip_serializing_if = "Grants::is_empty")]
    pub grants: Grants,
    /// True if answers depend on earlier requests: local originals then answer only while the link is down.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub stateful: bool,
    /// True if the deployer declares the service stateless: the push then does not ask.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub stateless: bool,
    /// Settings for servants shared by robots; absent if each robot has a servant of its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared: Option<Shared>,
    /// Rollout terms (default: the revision replaces the previous one at once).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rollout: Option<crate::rollout::RolloutTerms>,
    /// Time of the newest source in seconds since 1970 (like SOURCE_DATE_EPOCH), which becomes the creation time of the
    /// image (default: 2023-11-14, the time to which those of files in layers are clamped).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub created: Option<u64>,
    /// Human-readable description of what was pushed, stored with the revision.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub source: String,
}

impl PushOptions {
    /// Parses [`requests`](Self::requests).
    ///
    /// # Errors
    /// Returns the error of the first malformed request pair, with the expected format.
    pub fn parse_requests(&self) -> Result<Vec<qos::TopicPair>, ParsePairError> {
        self.requests.iter().map(|text| parse_request(text)).collect()
    }
}

/// Parses a request pair in the format of `--request`.
///
/// # Errors
/// The pair is malformed; the error has the expected format.
pub fn parse_request(text: &str) -> Result<qos::TopicPair, ParsePairError> {
    match text.split_once('=') {
        Some((input, outputs)) if !text.contains("->") => format!("{input} -> {outputs}").parse(),
        _ => text.parse(),
    }
}

/// Title of the last step, which cannot be cancelled.
pub const PUBLISHING: &str = "publishing";

impl PushEvent {
    /// Creates a step whose earlier duration is not known.
    pub fn step(title: impl Into<String>) -> PushEvent {
        PushEvent::Step { title: title.into(), last_took: None }
    }
}

/// One line of the response. The last line is `done`, `underlay` or `error`; a stream that ends otherwise was
/// truncated.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum PushEvent {
    /// The archive is complete: from now on the push continues without this client.
    Accepted {
        /// Number of the push, by which it is followed and cancelled.
        number: u64,
    },
    /// A new step begins.
    Step {
        /// Title of the step.
        title: String,
        /// Duration of this step when it was completed last, in milliseconds; absent if that is unknown.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        last_took: Option<u64>,
    },
    /// A line of the build log.
    Log {
        /// The line, without its line terminator.
        line: String,
    },
    /// Progress of the current step.
    Progress {
        /// Unit that is counted, such as `packages` or `bytes`.
        unit: String,
        /// Number of units done.
        done: u64,
        /// Total number of units, if known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        total: Option<u64>,
    },
    /// A warning; the push continues.
    Warning {
        /// Text of the warning.
        message: String,
    },
    /// The service is published, or was already.
    Done {
        /// The published service.
        service: Box<ServiceDetail>,
        /// Layers of the image.
        layers: Vec<Layer>,
        /// Duration of the push in milliseconds, from the first byte.
        took: u64,
        /// True if the current revision has the same image, launch plan and interface: it continues to serve, and no
        /// revision was published.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        unchanged: bool,
    },
    /// The underlay is published, or was already.
    Underlay {
        /// The published underlay.
        underlay: Box<Underlay>,
        /// Layers of the image.
        layers: Vec<Layer>,
        /// Duration of the push in milliseconds, from the first byte.
        took: u64,
        /// True if it is the same as before, and no revision was published.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        unchanged: bool,
    },
    /// The push failed; an earlier revision remains in service.
    Error {
        /// Reason of the failure, and the next step.
        problem: Problem,
    },
}

/// A layer of the pushed image.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Layer {
    /// Name of the layer: `base`, `dependencies`, `underlay` or `package`.
    pub name: String,
    /// Digest of the compressed layer.
    pub digest: String,
    /// Compressed size in bytes.
    pub size: u64,
    /// True if the layer already existed.
    pub cached: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_say_only_what_was_asked_for() {
        let options = PushOptions {
            apt: Some("opencv_apps".into()),
            nodes: vec!["people_detect".into()],
            ..PushOptions::default()
        };
        let text = serde_json::to_string(&options).expect("plain data");
        assert_eq!(text, r#"{"apt":"opencv_apps","nodes":["people_detect"],"limits":{}}"#);
        assert_eq!(serde_json::from_str::<PushOptions>(&text).expect("its own output"), options);
    }

    #[test]
    fn requests_are_written_as_on_robots_or_shorter() {
        for (text, expected) in [
            ("/image=/boxes", "/image -> /boxes"),
            ("/image=/boxes,/view by arrival", "/image -> /boxes, /view by arrival"),
            ("/image -> /boxes by stamp", "/image -> /boxes by stamp"),
        ] {
            let pair = parse_request(text).expect(text);
            assert_eq!(pair.to_string(), expected);
        }
        for text in ["/image", "image=/boxes", "/image=", "", "/image=/boxes by luck"] {
            let options = PushOptions { requests: vec![text.to_owned()], ..PushOptions::default() };
            let refused = options.parse_requests().expect_err(text);
            assert!(refused.to_string().contains("write it as"), "{refused}");
        }
    }

    #[test]
    fn an_unknown_option_is_named() {
        let refused = serde_json::from_str::<PushOptions>(r#"{"nmae":"x"}"#).expect_err("misspelt");
        assert!(refused.to_string().contains("`nmae`"), "{refused}");
    }

    #[test]
    fn events_carry_their_type() {
        let text = serde_json::to_string(&PushEvent::Progress { unit: "packages".into(), done: 3, total: Some(60) })
            .expect("plain data");
        assert_eq!(text, r#"{"type":"progress","unit":"packages","done":3,"total":60}"#);
    }
}
