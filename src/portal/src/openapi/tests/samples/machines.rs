//! Samples of robot pairings.

use api::machines::{NewPairing, Pair, Pairing, PairingMade, PairingState, Renew, RobotCertificate};
use serde_json::Value;

use super::{sample, some_text};

fn patterns() -> Vec<access::Glob> {
    vec!["det*".parse().expect("a pattern")]
}

fn new_pairing() -> NewPairing {
    NewPairing {
        robot: "r1".into(),
        services: patterns(),
        classes: patterns(),
        lifetime: Some(60),
        address: some_text("lab:9090"),
        own_certificate: true,
    }
}

fn pairing() -> Pairing {
    Pairing {
        robot: "r1".into(),
        services: patterns(),
        classes: patterns(),
        state: PairingState::Paired,
        own_certificate: false,
        created: 1,
        expires: Some(1),
        last_used: Some(1),
    }
}

/// Returns samples of every type, with and without optional fields.
pub fn samples() -> Vec<(&'static str, Value)> {
    let bare =
        NewPairing { classes: Vec::new(), lifetime: None, address: None, own_certificate: false, ..new_pairing() };
    let waiting = Pairing { state: PairingState::Waiting, expires: None, last_used: None, ..pairing() };
    let made = |line, expires| PairingMade { robot: "r1".into(), line, expires };
    vec![
        sample("NewPairing", new_pairing()),
        sample("NewPairing", bare),
        sample("Pairing", pairing()),
        sample("Pairing", waiting),
        sample("PairingMade", made(some_text("cloudroid://lab:9090/"), Some(1))),
        sample("PairingMade", made(None, None)),
        sample("Pair", Pair { robot: "r1".into(), code: "c".into(), request: "x".into() }),
        sample("Renew", Renew { request: "x".into() }),
        sample(
            "RobotCertificate",
            RobotCertificate { robot: "r1".into(), certificate: "x".into(), issued: 1, expires: 2 },
        ),
    ]
}
