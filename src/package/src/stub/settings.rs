//! `stub.toml`, which the robot's owner may change, and `revision.toml`, which says what the archive was made of.

use std::collections::BTreeSet;

use serde::Serialize;

use super::About;

/// The robot's settings, with what may be added.
pub(super) fn stub(about: &About<'_>) -> String {
    #[derive(Serialize)]
    struct Where<'a> {
        server: &'a str,
        service: &'a str,
        stateful: bool,
    }
    let known = Where {
        server: about.server,
        service: about.service,
        stateful: about.stateful,
    };
    let known = toml::to_string(&known).expect("texts and a word are TOML");
    format!(
        "# How this robot uses the service {}. Each key can also be given by the environment (CLOUDROID_MAX=0.3) or by\n\
         # a parameter of the node or of a namespace around it (~cloudroid/max). `rosrun {} cloudroid-stub doctor` checks it.\n\
         {known}{SETTINGS}",
        about.service, about.package
    )
}

const SETTINGS: &str = r#"
# robot = "rover1"         # this robot's id; by default its host name
# ca_file = "/path.pem"    # for a server of wss://: whom to trust, where that is not the system's to say
# token_file = "/path"     # holds the token, where the server asks for one
# desire = 0.1             # T_desire: the response time that is wished for, seconds
# max = 0.3                # T_max: the longest that is acceptable, seconds
# local = "cold"           # the local original: "cold", "first-sign", "warm" or "none"
# nodes = { "talk.py" = "talker" }   # what an executable's node is called by default, where that is not its own name
"#;

/// What the archive was made of.
pub(super) fn revision(about: &About<'_>, executables: &BTreeSet<String>) -> String {
    #[derive(Serialize)]
    struct Revision<'a> {
        package: &'a str,
        service: &'a str,
        revision: u64,
        image: &'a str,
        architecture: &'a str,
        outsourced: &'a BTreeSet<String>,
        original: BTreeSet<&'a String>,
    }
    let revision = Revision {
        package: about.package,
        service: about.service,
        revision: about.revision,
        image: about.image,
        architecture: about.architecture,
        outsourced: about.outsourced,
        original: executables.difference(about.outsourced).collect(),
    };
    let text = toml::to_string(&revision).expect("texts and a number are TOML");
    format!(
        "# What this stub was made of. Written by the server; changing it changes nothing.\n{text}"
    )
}
