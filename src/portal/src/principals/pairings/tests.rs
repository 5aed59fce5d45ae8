use access::{ConnectionAccess, Operation};
use store::State;

use super::*;
use crate::tokens::Tokens;

struct World {
    _home: tempfile::TempDir,
    principals: Principals,
    authority: Authority,
    /// Authority of a lab.
    other: Authority,
}

const WEEK: Duration = Duration::from_secs(7 * 86_400);
const HERE: IpAddr = IpAddr::V4(std::net::Ipv4Addr::LOCALHOST);

fn world() -> World {
    let home = tempfile::tempdir().expect("a directory");
    let state = State::open(&home.path().join("cloudroid.db")).expect("a database");
    let authority = |name| Authority::load_or_create(&home.path().join(name)).expect("made");
    World {
        principals: Principals::new(Tokens::default(), Arc::new(state)).expect("readable"),
        authority: authority("own.pem"),
        other: authority("lab.pem"),
        _home: home,
    }
}

fn new_pairing(robot: &str) -> NewPairing {
    NewPairing {
        robot: robot.into(),
        services: vec!["det*".parse().expect("a pattern")],
        classes: Vec::new(),
        lifetime: None,
        address: None,
        own_certificate: false,
    }
}

fn request(robot: &str) -> CertificateRequest {
    let key = rcgen::KeyPair::generate().expect("a key");
    let mut params = rcgen::CertificateParams::default();
    params.distinguished_name = rcgen::DistinguishedName::new();
    let made = params.serialize_request(&key).expect("made");
    CertificateRequest::parse(&made.pem().expect("PEM"), robot).expect("a request")
}

impl World {
    fn pair(&self, robot: &str) -> (CertificateRequest, Certificate) {
        let (code, _) = self.principals.begin_pairing(&new_pairing(robot)).expect("made");
        let code = self.code(robot, &code).expect("good");
        let request = request(robot);
        let issued = self.principals.pair(&code, &request, &self.authority, WEEK);
        (request, read_certificate(&issued.expect("paired")))
    }

    fn code(&self, robot: &str, code: &str) -> Result<CodeRecord, String> {
        self.code_at(robot, code, store::now())
    }

    fn code_at(&self, robot: &str, code: &str, now: Millis) -> Result<CodeRecord, String> {
        let known = self.principals.check_code(robot, code, HERE, now);
        known.map_err(|error| error.to_string())
    }

    fn recognise(&self, shown: &Certificate, now: Millis) -> Result<CallerIdentity, CertificateRefusal> {
        let principals = &self.principals;
        principals.with_recogniser(|known| known.recognise_certificate(&self.authority, shown, now))
    }

    fn ended_reason(&self, who: &CallerIdentity) -> Option<String> {
        match self.principals.connection_access(who, "detector") {
            ConnectionAccess::Ended(reason) => Some(reason),
            ConnectionAccess::Granted(grants) => {
                assert!(grants.permits(Operation::Publish, "/x"));
                None
            }
        }
    }
}

fn read_certificate(issued: &IssuedRobotCertificate) -> Certificate {
    use tokio_rustls::rustls::pki_types::CertificateDer;
    use tokio_rustls::rustls::pki_types::pem::PemObject;
    let der = CertificateDer::from_pem_slice(issued.certificate.as_bytes()).expect("PEM");
    authority::read_robot_certificate(&der).expect("a robot's")
}

#[test]
fn a_robot_is_paired_until_it_is_unpaired() {
    let world = world();
    assert!(world.principals.has_no_credentials());
    let (_, shown) = world.pair("r1");
    assert!(!world.principals.has_no_credentials());
    let who = world.recognise(&shown, store::now()).expect("paired");
    assert!(who.principal.has_role(Role::Robot) && !who.principal.has_role(Role::Viewer));
    assert_eq!((who.principal.scope.robot.as_deref(), who.owner.as_deref()), (Some("r1"), Some("robot:r1")));
    world.principals.record_use(&who, store::now());
    let listed = world.principals.pairings().expect("listed");
    assert!(listed.len() == 1 && listed[0].last_used.is_some(), "{listed:?}");
    assert_eq!(world.ended_reason(&who), None);
    world.principals.unpair("r1").expect("there");
    assert_eq!(world.ended_reason(&who).as_deref(), Some("robot r1 was unpaired"));
    let refused = world.recognise(&shown, store::now());
    assert_eq!(refused, Err(CertificateRefusal::Unpaired("r1".into())));
    let request = request("r1");
    let Credential::Certificate { pairing, .. } = who.shown else { panic!("{who:?}") };
    let renewed = world.principals.renew((pairing, "r1"), &request, &world.authority, WEEK);
    assert_eq!(renewed.expect_err("over").problem().status, 401);
    assert_eq!(world.principals.unpair("r1").expect_err("once").problem().status, 404);
    assert!(!world.principals.has_no_credentials(), "the door does not open again");
}

#[test]
fn a_code_is_good_once_for_its_robot_and_until_its_end() {
    let world = world();
    let principals = &world.principals;
    let begin = |robot: &str| principals.begin_pairing(&new_pairing(robot)).expect("made");
    let (first, _) = begin("r1");
    let (code, end) = begin("r1");
    let words = |code: &str, robot: &str| world.code(robot, code).expect_err(code);
    assert!(words(&first, "r1").contains("replaced by a newer one"));
    assert!(words(&code, "r2").contains("for another robot"));
    assert!(world.code_at("r1", &code, end - 1).is_ok());
    assert!(world.code_at("r1", &code, end).expect_err("over").contains("has expired"));
    let known = world.code("r1", &code).expect("good");
    principals.pair(&known, &request("r1"), &world.authority, WEEK).expect("paired");
    assert!(words(&code, "r1").contains("already used"));
    // Two robots presented it at the same time.
    let late = principals.pair(&known, &request("r1"), &world.authority, WEEK);
    assert!(late.expect_err("late").to_string().contains("already used"));
    let (code, _) = begin("r3");
    principals.cancel_pairing("r3").expect("there");
    assert!(words(&code, "r3").contains("was cancelled"));
    assert_eq!(principals.cancel_pairing("r3").expect_err("once").problem().status, 404);
    // Unpairing also cancels a pending code.
    let (code, _) = begin("r1");
    principals.unpair("r1").expect("there");
    assert!(words(&code, "r1").contains("was cancelled"));
}

#[test]
fn who_guesses_codes_is_slowed_and_whoever_has_one_is_not() {
    let world = world();
    let (code, _) = world.principals.begin_pairing(&new_pairing("r1")).expect("made");
    for number in 0..access::guesses::FREE {
        // Some have the right length, others do not.
        for guess in [format!("{number:026}"), format!("{number}")] {
            let refused = world.code_at("r1", &guess, 5_000).expect_err("a guess");
            assert!(refused.contains("not known") || refused.contains("are not checked"), "{refused}");
        }
    }
    let refused = world.code_at("r1", "guess", 5_000).expect_err("slowed");
    assert!(refused.contains("are not checked"), "{refused}");
    world.code_at("r1", &code, 5_000).expect("looked up always");
}

#[test]
fn a_certificate_is_of_the_key_that_was_paired_last() {
    let world = world();
    let (_, first) = world.pair("r1");
    let who = world.recognise(&first, store::now()).expect("paired");
    let (_, second) = world.pair("r1");
    world.recognise(&second, store::now()).expect("paired anew");
    let replaced = CertificateRefusal::Replaced("r1".into());
    assert_eq!(world.recognise(&first, store::now()), Err(replaced.clone()));
    assert_eq!(world.ended_reason(&who), Some(replaced.to_string()));
    let nobody = world.authority.issue(&request("r9"), "r9", store::now(), WEEK).expect("made");
    let refused = world.recognise(&read_certificate(&nobody), store::now());
    assert_eq!(refused, Err(CertificateRefusal::NotPaired("r9".into())));
}

#[test]
fn a_connection_lasts_as_long_as_the_newest_certificate() {
    let world = world();
    let (request, old) = world.pair("r1");
    let who = world.recognise(&old, store::now()).expect("paired");
    let Credential::Certificate { pairing, .. } = who.shown else { panic!("{who:?}") };
    let month = 4 * WEEK;
    let renewed = world.principals.renew((pairing, "r1"), &request, &world.authority, month);
    let end = renewed.expect("renewed").expires;
    assert!(end > old.until);
    assert_eq!(world.principals.expiry(&who), Some(end));
    // Both certificates have the same key; the older one is valid to its own end, which the handshake checks.
    world.recognise(&old, end - 1).expect("of the key");
    assert_eq!(world.recognise(&old, end), Err(CertificateRefusal::Expired("r1".into())));
}

#[test]
fn a_labs_own_authority_names_robots_that_were_paired_for_it() {
    let world = world();
    let made = |authority: &Authority, robot: &str| {
        let issued = authority.issue(&request(robot), robot, store::now(), WEEK);
        read_certificate(&issued.expect("made"))
    };
    let own = made(&world.other, "r1");
    assert_eq!(world.recognise(&own, store::now()), Err(CertificateRefusal::NotPaired("r1".into())));
    world.principals.pair_own(&new_pairing("r1")).expect("paired");
    let who = world.recognise(&own, store::now()).expect("paired");
    assert_eq!(world.recognise(&own, own.until), Err(CertificateRefusal::Expired("r1".into())));
    // Certificates of the daemon's authority are not valid for this pairing, and vice versa.
    let replaced = Err(CertificateRefusal::Replaced("r1".into()));
    assert_eq!(world.recognise(&made(&world.authority, "r1"), store::now()), replaced);
    let (_, paired) = world.pair("r1");
    world.recognise(&paired, store::now()).expect("paired");
    assert_eq!(world.recognise(&own, store::now()), replaced);
    assert!(world.ended_reason(&who).is_some());
}

#[test]
fn what_cannot_be_a_pairing_is_refused_with_words() {
    let world = world();
    let table = [
        (NewPairing { robot: "a b".into(), ..new_pairing("x") }, "robot"),
        (NewPairing { robot: "root".into(), ..new_pairing("x") }, "is a reserved name"),
        (NewPairing { services: Vec::new(), ..new_pairing("x") }, "--services"),
        (NewPairing { lifetime: Some(0), ..new_pairing("x") }, "expires at once"),
        (NewPairing { lifetime: Some(u64::MAX), ..new_pairing("x") }, "at most 7d"),
    ];
    for (new, words) in table {
        let refused = world.principals.begin_pairing(&new).expect_err(words).problem();
        assert!(refused.status == 400 && refused.detail.contains(words), "{words}: {refused:?}");
    }
    assert!(world.principals.pairings().expect("listed").is_empty());
}

/// Pairings and their ends survive a restart.
#[test]
fn pairings_are_kept() {
    let home = tempfile::tempdir().expect("a directory");
    let open = || Arc::new(State::open(&home.path().join("cloudroid.db")).expect("a database"));
    let principals = Principals::new(Tokens::default(), open()).expect("readable");
    principals.pair_own(&new_pairing("r1")).expect("paired");
    principals.pair_own(&new_pairing("r2")).expect("paired");
    principals.unpair("r2").expect("there");
    let before = principals.pairings().expect("listed");
    drop(principals);
    let principals = Principals::new(Tokens::default(), open()).expect("readable");
    assert_eq!(principals.pairings().expect("listed"), before);
    assert_eq!((before.len(), &*before[0].robot), (1, "r1"));
}

#[test]
fn a_robot_that_is_paired_shares_its_name_with_nobody_but_its_own_token() {
    let world = world();
    let principals = &world.principals;
    let account = |name: &str| {
        let new = api::people::NewAccount {
            name: name.into(),
            password: "four quiet purple engines".into(),
            role: Role::Admin,
            services: Vec::new(),
        };
        principals.create_account(&new, "hash")
    };
    let token = |name: &str, robot: Option<&str>| {
        let new = api::access::NewToken {
            name: name.into(),
            role: if robot.is_some() { Role::Robot } else { Role::Viewer },
            services: vec!["det*".parse().expect("a pattern")],
            robot: robot.map(str::to_owned),
            classes: Vec::new(),
            lifetime: None,
        };
        principals.create_token(&new).map(|_| ())
    };
    let status = |refused: Result<(), Error>| refused.expect_err("taken").problem().status;
    let pair = |robot: &str| principals.begin_pairing(&new_pairing(robot)).map(|_| ());
    account("ann").expect("made");
    token("tool", None).expect("made");
    token("arm", Some("r9")).expect("made");
    for taken in ["ann", "tool", "arm"] {
        assert_eq!(status(pair(taken)), 409, "{taken}");
        assert_eq!(status(principals.pair_own(&new_pairing(taken))), 409, "{taken}");
    }
    // First its code is pending, then it is paired.
    pair("r1").expect("free");
    principals.pair_own(&new_pairing("r2")).expect("free");
    for taken in ["r1", "r2"] {
        assert_eq!(status(account(taken)), 409, "{taken}");
        assert_eq!(status(token(taken, None)), 409, "{taken}");
        assert_eq!(status(token(taken, Some("r9"))), 409, "{taken}");
        token(taken, Some(taken)).expect("the same robot's");
        pair(taken).expect("again");
    }
    principals.revoke_token("tool").expect("there");
    pair("tool").expect("free by now");
}
