//! `stub.toml`, which the robot's owner may change, and `revision.toml`, which says what the archive was made of.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::{About, Answered, Words};

/// The robot's settings, with what may be added.
pub(super) fn stub(about: &About<'_>) -> String {
    #[derive(Serialize)]
    struct Where<'a> {
        server: &'a str,
        #[serde(skip_serializing_if = "Option::is_none")]
        fingerprint: Option<&'a str>,
        service: &'a str,
        stateful: bool,
    }
    let known = Where {
        server: &about.portal.address,
        fingerprint: about.portal.fingerprint.as_deref(),
        service: about.service,
        stateful: about.stateful,
    };
    let known = toml::to_string(&known).expect("texts and a word are TOML");
    let words = Words::of(about.ros);
    format!(
        "# How this robot uses the service {}. Each key can also be given by the environment (CLOUDROID_MAX=0.3) or by\n\
         # {}. `{} {} cloudroid-stub doctor` checks it.\n\
         {known}{SETTINGS}",
        about.service, words.settings, words.run, about.package
    )
}

/// What may be set; the stub's own tests compare what it says of defaults with the stub's.
const SETTINGS: &str = include_str!("inside/settings.toml");

/// What the archive was made of.
pub(super) fn revision(about: &About<'_>, executables: &BTreeSet<String>) -> String {
    #[derive(Serialize)]
    struct Revision<'a> {
        ros: u8,
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
        requests: &'a [Answered],
    }
    /// What holds where the robot says nothing: not in `stub.toml`, which an installation keeps.
    #[derive(Serialize)]
    struct Defaults {
        desire: f64,
        max: f64,
    }
    let revision = Revision {
        ros: about.ros.number(),
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
    format!(
        "# What this stub was made of. Written by the server; changing it changes nothing.\n{text}"
    )
}
