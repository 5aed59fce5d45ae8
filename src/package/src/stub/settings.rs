//! `stub.toml`, which the robot's owner may edit, and `revision.toml`, which describes what the archive was built from.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::{ProgramRequest, RosTerms, StubInfo};

/// Returns the robot's settings, with the available options as comments.
pub(super) fn stub_toml(about: &StubInfo<'_>) -> String {
    #[derive(Serialize)]
    struct StubSettings<'a> {
        server: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        fingerprint: Option<&'a str>,
        service: &'a str,
        stateful: bool,
    }
    let known = StubSettings {
        server: &about.portal.address,
        fingerprint: about.portal.fingerprint.as_deref(),
        service: about.service,
        stateful: about.stateful,
    };
    let known = toml::to_string(&known).expect("texts and a word are TOML");
    let words = RosTerms::for_ros(about.ros);
    format!(
        "# How this robot uses the service {}. Each key can also be set by an environment variable (CLOUDROID_MAX=0.3) \
            or by\n# {}. `{} {} cloudroid-stub doctor` checks it.\n{known}{SETTINGS}",
        about.service, words.settings, words.run, about.package
    )
}

/// Available options; tests of the stub compare the stated defaults with the actual ones.
const SETTINGS: &str = include_str!("inside/settings.toml");

/// Returns the description of what the archive was built from.
pub(super) fn revision_toml(about: &StubInfo<'_>, executables: &BTreeSet<String>) -> String {
    #[derive(Serialize)]
    struct Revision<'a> {
        ros: u8,
        #[serde(skip_serializing_if = "Option::is_none")]
        service_ros: Option<u8>,
        package: &'a str,
        service: &'a str,
        revision: u64,
        image: &'a str,
        architecture: &'a str,
        outsourced: &'a BTreeSet<String>,
        original: BTreeSet<&'a String>,
        #[serde(skip_serializing_if = "BTreeMap::is_empty")]
        names: &'a BTreeMap<String, String>,
        #[serde(skip_serializing_if = "Option::is_none")]
        defaults: Option<Defaults>,
        #[serde(skip_serializing_if = "<[_]>::is_empty")]
        requests: &'a [ProgramRequest],
    }
    /// Defaults if the robot states nothing: not in `stub.toml`, which is preserved by an installation.
    #[derive(Serialize)]
    struct Defaults {
        desire: f64,
        max: f64,
    }
    let revision = Revision {
        ros: about.ros.number(),
        service_ros: about.is_for_other_ros().then(|| about.service_ros.number()),
        package: about.package,
        service: about.service,
        revision: about.revision,
        image: about.image,
        architecture: about.architecture,
        outsourced: about.outsourced,
        original: executables.difference(about.outsourced).collect(),
        names: about.names,
        defaults: about.times.map(|(desire, max)| Defaults { desire, max }),
        requests: about.requests,
    };
    let text = toml::to_string(&revision).expect("texts and a number are TOML");
    format!("# What this stub was made from. Written by the server; changes have no effect.\n{text}")
}
