use std::os::unix::fs::PermissionsExt;

use super::*;

fn test_directory() -> (tempfile::TempDir, IdentityDirectory) {
    let place = tempfile::tempdir().unwrap();
    let own = IdentityDirectory(place.path().join("cloudroid"));
    (place, own)
}

fn mode(path: &Path) -> u32 {
    path.metadata().unwrap().permissions().mode() & 0o7777
}

fn address() -> Address {
    Address::parse("wss://lab.example:9090").unwrap()
}

fn certificate() -> PairedCertificate {
    let key = rcgen::KeyPair::generate().unwrap();
    let made = rcgen::CertificateParams::default().self_signed(&key).unwrap();
    PairedCertificate { robot: "r1".into(), received: 10_000, lifetime: 9_000, certificate: made.pem() }
}

#[test]
fn a_key_is_made_once_and_is_its_owners_alone() {
    let (_place, own) = test_directory();
    let made = own.load_or_create_key().unwrap().private_key();
    assert_eq!(own.load_or_create_key().unwrap().private_key(), made);
    assert_eq!((mode(&own.key_path()), mode(&own.0)), (0o600, 0o700));
    let request = RobotKey::read(&own.key_path()).unwrap().certificate_request("r1").unwrap();
    assert!(request.contains("BEGIN CERTIFICATE REQUEST"), "{request}");
}

#[test]
fn a_key_that_others_can_read_or_nobody_is_refused_with_what_to_type() {
    let (_place, own) = test_directory();
    own.load_or_create_key().unwrap();
    for open in [0o640, 0o604, 0o660, 0o644] {
        std::fs::set_permissions(own.key_path(), PermissionsExt::from_mode(open)).unwrap();
        let refused = own.load_or_create_key().err().expect("open").to_string();
        let command = format!("chmod 600 {}", own.key_path().display());
        assert!(refused.contains(&command), "{refused}");
    }
    std::fs::set_permissions(own.key_path(), PermissionsExt::from_mode(0o600)).unwrap();
    std::fs::write(own.key_path(), "rubbish").unwrap();
    let refused = own.load_or_create_key().err().expect("not a valid key").to_string();
    assert!(refused.contains("not a valid key") && refused.contains("pair the robot again"), "{refused}");
    std::fs::remove_file(own.key_path()).unwrap();
    let refused = RobotKey::read(&own.key_path()).err().expect("none").to_string();
    assert!(refused.contains("robot.key") && refused.contains("pair the robot again"), "{refused}");
}

#[test]
fn a_certificate_is_kept_by_server_and_renewed_at_two_thirds_of_its_life() {
    let (_place, own) = test_directory();
    assert_eq!(own.load_certificate(&address()).unwrap(), None);
    let kept = certificate();
    own.store_certificate(&address(), &kept).unwrap();
    assert_eq!(own.load_certificate(&address()).unwrap(), Some(kept.clone()));
    let other = Address::parse("wss://lab.example:9091").unwrap();
    assert_eq!(own.load_certificate(&other).unwrap(), None);
    let due = |now| kept.renewal_delay(now).as_millis();
    // In the last case the clock was set back.
    assert_eq!([due(10_000), due(15_999), due(16_000), due(99_000), due(9_999)], [6_000, 1, 0, 0, 0]);
    let path = own.0.join("paired/lab.example:9090.toml");
    assert_eq!(mode(&path), 0o600);
    let left: Vec<_> = std::fs::read_dir(own.0.join("paired")).unwrap().collect();
    assert_eq!(left.len(), 1, "nothing half-made is left");
    for damaged in ["", "rubbish", "robot = 3"] {
        std::fs::write(&path, damaged).unwrap();
        let refused = own.load_certificate(&address()).unwrap_err().to_string();
        assert!(refused.contains("pair the robot again"), "{refused}");
    }
}

#[test]
fn what_is_no_answer_is_no_certificate() {
    let good = serde_json::json!({"robot": "r", "certificate": certificate().certificate, "issued": 1, "expires": 5});
    let read = |value: &serde_json::Value| PairedCertificate::read(value.to_string().as_bytes());
    assert_eq!(read(&good).unwrap().lifetime, 4);
    for (key, value) in [("certificate", "rubbish"), ("certificate", ""), ("issued", "x")] {
        let mut bad = good.clone();
        bad[key] = value.into();
        assert!(read(&bad).is_err(), "{bad}");
    }
}

#[test]
fn signers_are_kept_once_each() {
    let (_place, own) = test_directory();
    for key in ["AAAA1", "AAAA2", "AAAA1"] {
        own.trust_signer(key).unwrap();
    }
    let text = std::fs::read_to_string(own.0.join("servers.pub")).unwrap();
    assert_eq!(text, "cloudroid ssh-ed25519 AAAA1\ncloudroid ssh-ed25519 AAAA2\n");
}

#[test]
fn a_robot_that_is_paired_has_the_name_that_it_was_paired_by() {
    let (place, own) = test_directory();
    own.store_certificate(&address(), &certificate()).unwrap();
    let settings = |server: &str, more: &str| -> Config {
        let text = format!("server = {server:?}\nservice = 's'\nidentity = {:?}\n{more}", own.0);
        toml::from_str(&text).unwrap()
    };
    let paired = settings("wss://lab.example:9090", "");
    assert_eq!(paired.robot_id(), "r1");
    assert_eq!(settings("wss://lab.example:9090", "robot = 'r2'").robot_id(), "r2");
    // Without TLS no certificate is requested or presented.
    assert!(load_identity(&settings("ws://lab.example:9090", "")).unwrap().is_none());
    // The key is missing.
    let refused = load_identity(&paired).unwrap_err().to_string();
    assert!(refused.contains("robot.key"), "{refused}");
    own.load_or_create_key().unwrap();
    assert!(load_identity(&paired).unwrap().is_some());
    drop(place);
}
