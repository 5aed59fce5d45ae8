//! Pushing a package: options in the query, an archive in the body, a stream of events back.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::grants::Grants;
use crate::group::Shared;
use crate::limits::{Caps, Limits};
use crate::problem::Problem;
use crate::service::ServiceDetail;
use crate::sla::Sla;

/// What to make of the archive (`POST /api/v1/push?options=JSON`; the body is a tar, gzipped or not, and empty
/// with `apt`).
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(default, deny_unknown_fields)]
pub struct PushOptions {
    /// The service's name; the package's by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// A packaged ROS package instead of an archive.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub apt: Option<String>,
    /// Name of the base image definition.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub base: Option<String>,
    /// Launch file, relative to the package, or its bare name.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub launch: Option<String>,
    /// Executables to run, instead of a launch file: `EXE` or `PACKAGE/EXE`, with arguments behind it as a shell would
    /// split them.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub nodes: Vec<String>,
    /// Private parameters of the nodes (`~K`), or global ones when they begin with `/`.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub params: BTreeMap<String, serde_json::Value>,
    /// Arguments of the launch file.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub args: BTreeMap<String, String>,
    /// Names to remap, from → to.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub remaps: BTreeMap<String, String>,
    /// What to add to the interface, where the push cannot find all of it: the text of a TOML or JSON file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub interface: Option<String>,
    /// Dependencies by hand: rosdep key or ROS package → Debian package.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub map: BTreeMap<String, String>,
    /// Which input is answered by which output, instead of what the push finds: `INPUT=OUTPUT`, or as a robot's
    /// stub.toml has it, `INPUT -> OUTPUT, OUTPUT by arrival`.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub requests: Vec<String>,
    /// Debian or ROS packages to add, for compiling and for running.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub with: Vec<String>,
    /// Limits of a servant; those given are also reserved for it.
    pub limits: Limits,
    /// The most that robots may ask for.
    #[serde(skip_serializing_if = "Caps::is_empty")]
    pub caps: Caps,
    /// What stubs promise where their robot says nothing: `rrt` and `max_rrt` alone.
    #[serde(skip_serializing_if = "Sla::is_empty")]
    pub sla: Sla,
    /// What a servant is given beyond its container.
    #[serde(skip_serializing_if = "Grants::is_empty")]
    pub grants: Grants,
    /// Answers depend on earlier requests: robots' local originals answer only while there is no link.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub stateful: bool,
    /// They do not, says the deployer: the push does not ask.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub stateless: bool,
    /// Robots share its servants; none: each robot has a servant of its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shared: Option<Shared>,
    /// On which terms it takes the place of the revision before; at once by default.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rollout: Option<crate::rollout::RolloutTerms>,
    /// What was pushed, in words, kept with the revision.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub source: String,
}

impl PushOptions {
    /// Reads [`requests`](Self::requests).
    ///
    /// # Errors
    /// What is wrong with one of them, and how it is written.
    pub fn read_requests(&self) -> Result<Vec<qos::Pair>, String> {
        self.requests
            .iter()
            .map(|text| read_request(text))
            .collect()
    }
}

/// Reads a request as `--request` has it.
///
/// # Errors
/// What is wrong with it, and how it is written.
pub fn read_request(text: &str) -> Result<qos::Pair, String> {
    match text.split_once('=') {
        Some((input, outputs)) if !text.contains("->") => format!("{input} -> {outputs}").parse(),
        _ => text.parse(),
    }
}

/// The title of the last step: once it has begun nothing cancels the push.
pub const PUBLISHING: &str = "publishing";

/// One line of the answer. The last is `done` or `error`; a stream that ends otherwise was cut.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
#[serde(tag = "type", rename_all = "snake_case")]
pub enum PushEvent {
    /// A new step begins.
    Step {
        /// What is done now.
        title: String,
    },
    /// One line of the build log.
    Log {
        /// Without the line end.
        line: String,
    },
    /// How far the step is.
    Progress {
        /// What is counted, such as `packages`, or `bytes`.
        unit: String,
        /// Number of those that are done.
        done: u64,
        /// Number of all, where it is known.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        total: Option<u64>,
    },
    /// Something to know that is no failure.
    Warning {
        /// Text of the warning.
        message: String,
    },
    /// Published.
    Done {
        /// The service as it is now.
        service: Box<ServiceDetail>,
        /// How its layers came to be.
        layers: Vec<Layer>,
        /// Milliseconds from the first byte to here.
        took: u64,
    },
    /// Not published; an earlier revision keeps serving.
    Error {
        /// The reason, and what to do.
        problem: Problem,
    },
}

/// A layer of the pushed image.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(utoipa::ToSchema))]
pub struct Layer {
    /// `base`, `dependencies` or `package`.
    pub name: String,
    /// Digest of the compressed layer.
    pub digest: String,
    /// Compressed size.
    pub size: u64,
    /// Not made anew: it was known already.
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
        assert_eq!(
            text,
            r#"{"apt":"opencv_apps","nodes":["people_detect"],"limits":{}}"#
        );
        assert_eq!(
            serde_json::from_str::<PushOptions>(&text).expect("its own output"),
            options
        );
    }

    #[test]
    fn requests_are_written_as_on_robots_or_shorter() {
        for (text, expected) in [
            ("/image=/boxes", "/image -> /boxes"),
            (
                "/image=/boxes,/view by arrival",
                "/image -> /boxes, /view by arrival",
            ),
            ("/image -> /boxes by stamp", "/image -> /boxes by stamp"),
        ] {
            assert_eq!(
                read_request(text).map(|pair| pair.to_string()).as_deref(),
                Ok(expected)
            );
        }
        for text in [
            "/image",
            "image=/boxes",
            "/image=",
            "",
            "/image=/boxes by luck",
        ] {
            let options = PushOptions {
                requests: vec![text.to_owned()],
                ..PushOptions::default()
            };
            let refused = options.read_requests().expect_err(text);
            assert!(refused.contains("write it as"), "{refused}");
        }
    }

    #[test]
    fn an_unknown_option_is_named() {
        let refused = serde_json::from_str::<PushOptions>(r#"{"nmae":"x"}"#).expect_err("misspelt");
        assert!(refused.to_string().contains("`nmae`"), "{refused}");
    }

    #[test]
    fn events_carry_their_type() {
        let text = serde_json::to_string(&PushEvent::Progress {
            unit: "packages".into(),
            done: 3,
            total: Some(60),
        })
        .expect("plain data");
        assert_eq!(
            text,
            r#"{"type":"progress","unit":"packages","done":3,"total":60}"#
        );
    }
}
