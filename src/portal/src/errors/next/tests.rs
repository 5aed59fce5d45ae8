use std::io;
use std::path::PathBuf;
use std::time::Duration;

use api::Size;
use choreographer::Amount;
use choreographer::Error as C;
use servant::Error as E;

use super::super::Error;
use super::*;
use crate::principals::refusals::{CertificateRefusal, PairingCodeRefusal};

fn x() -> String {
    "x".to_owned()
}

fn io() -> io::Error {
    io::ErrorKind::Other.into()
}

fn not_json() -> serde_json::Error {
    serde_json::from_str::<u8>("").expect_err("nothing")
}

/// One error of each kind.
fn portal_errors() -> Vec<Error> {
    let (name, exists) = (x(), Vec::new());
    let limit = Size(1);
    vec![
        Error::UnknownRobot { name: x(), exists: Vec::new() },
        Error::UnknownRow { service: x(), id: x(), exists: Vec::new() },
        Error::UnknownPath { path: x() },
        Error::OtherMethod { method: x(), path: x() },
        Error::BadRequest(x()),
        Error::WebSocketVersion,
        Error::Unauthorised("x"),
        AuthenticationError::Revoked.into(),
        AuthenticationError::Expired.into(),
        AuthenticationError::Unknown.into(),
        AuthenticationError::Slowed(1).into(),
        AuthenticationError::SlowedSignIn(1).into(),
        AuthenticationError::SessionOver.into(),
        CertificateRefusal::Nameless(x()).into(),
        PairingCodeRefusal::Unknown.into(),
        Error::Uncertifiable(authority::Error::Kind),
        Error::Uncertifiable(authority::Error::Nameless(x())),
        Error::UnknownPairing { name: x(), exists: Vec::new() },
        Error::PlainText { instead: x() },
        Error::Foreign { what: x(), next: x() },
        Error::Forbidden { what: x() },
        Error::UnknownToken { name: x(), exists: Vec::new() },
        Error::TokenExists(x()),
        Error::UnknownAccount { name, exists },
        Error::AccountExists(x()),
        Error::WrongPassword,
        Error::NoProvider,
        oidc::Error::Busy.into(),
        Error::NoRole { who: x(), has: x() },
        Error::PairingExists(x()),
        Error::SignInBusy,
        Error::TooManyStreams { most: 1 },
        Error::TooManyLook { servant: x(), most: 1, each: 1 },
        Error::NotThereYet(x()),
        Error::NotRunning(x()),
        Error::ExecOff,
        Error::TooManyExecs { who: x(), most: 1 },
        Error::NoBlackBox(x()),
        Error::UnknownRecording(x()),
        Error::UnknownPush(x()),
        Error::PushNotCancelled { number: 1, why: "x" },
        Error::NotRecorded { servant: x(), reason: x() },
        Error::RecordedLately { servant: x(), again: 1 },
        Error::UnknownRule { id: x(), exists: Vec::new() },
        Error::RobotTaken(x()),
        Error::BodyTooLarge { limit },
        Error::TrialTooLarge { limit },
        Error::Memory(budget::Exceeded { name: x(), asked: 2, used: 0, limit: 1 }),
        Error::Unfinished { after: Duration::from_secs(1) },
        Error::Internal("x"),
    ]
}

fn push_errors() -> Vec<Error> {
    use push::Error as P;
    let pushes = [
        P::NameTaken { name: x(), package: x(), newcomer: x() },
        P::NotAllowed(x()),
        P::Options(push::OptionsError::Exported),
        P::Failed { message: x(), next: None, log: Vec::new() },
        P::TooLarge { limit: Size(1) },
        P::Ending,
        P::Cancelled,
        P::Engine(E::Exists { id: x() }),
        P::Internal("x"),
    ];
    pushes.into_iter().map(Error::from).collect()
}

fn servant_errors() -> Vec<Error> {
    let amount = Amount::new(1.0, 1);
    let refused = [
        AdmissionError::TooBig { wanted: amount, capacity: amount },
        AdmissionError::NoMore { wanted: amount, free: amount },
        AdmissionError::QueueFull { waiting: 1 },
        AdmissionError::Deadline { waited: Duration::ZERO, place: None },
        AdmissionError::Stalled { why: x(), waited: Duration::ZERO, place: None },
        AdmissionError::NoMoreNow { why: x() },
    ];
    let unchanged = |reason| C::NotResized { servant: x(), service: x(), stated: x(), reason: Box::new(reason) };
    let kept = refused.clone().map(|refused| unchanged(ResizeError::Full(refused)));
    let others = [
        unchanged(ResizeError::Many),
        unchanged(ResizeError::Used { used: Size(2), wanted: Size(1) }),
        C::Terms(TermsError::UnknownClass { name: x(), exists: Vec::new() }),
        C::UnknownServant { id: x(), exists: Vec::new() },
        C::Place { id: x(), service: x(), robot: x() },
        C::Servant { service: x(), robot: x(), reason: x(), log: Vec::new() },
        C::BackOff { service: x(), robot: x(), failures: 1, reason: x(), again: Duration::ZERO },
        C::NoRollout(x()),
        C::Rollout(x()),
        C::Ending,
        C::OutOfMemory { service: x(), memory: api::Size(1), ready: true },
        C::Calibration(x()),
        C::Shadow(x()),
        C::Reach(reach::Error::Elsewhere(x())),
        C::Reach(reach::Error::Linked(Box::new(reach::links::NodeError::ServantEnded))),
        C::Reach(reach::Error::Trial(x())),
        C::Internal("x"),
        C::Engine(E::Call { call: "x", source: io() }),
        C::Engine(E::Refused { id: x(), reason: x() }),
        C::Engine(E::NoUidRange { base: 1, ranges: 1 }),
        C::Engine(E::Image { image: x(), source: x().into() }),
    ];
    let full = refused.map(C::from);
    let all = full.into_iter().chain(kept).chain(others);
    all.map(Error::from).collect()
}

fn storage_errors() -> Vec<Error> {
    use catalogue::Error as K;
    let path = PathBuf::from("x");
    let state = store::Error::Record { what: x(), source: not_json() };
    let full = image::Error::DiskFull { path: path.clone(), needed: None, free: None };
    let damaged = image::Error::Json { path, source: not_json() };
    let kept = [
        K::UnknownService { name: x(), exists: vec![x()] },
        K::UnknownRevision { service: x(), revision: x(), exists: Vec::new() },
        K::UnknownImage { what: x() },
        K::NoStub { service: x(), reason: x() },
        K::NoTwins { service: x(), reason: package::Error::NoManifest { package: x() } },
        K::UnknownArchitecture { asked: x(), exists: Vec::new() },
        K::Name(NameError::Service(x())),
        K::Name(NameError::Reserved(x())),
        K::Name(NameError::Robot(x())),
        K::State(state),
        K::Image(full),
        K::Image(image::Error::BadTag { name: x() }),
        K::Internal("x"),
    ];
    let kept = kept.into_iter().map(Error::from);
    kept.chain([damaged.into()]).collect()
}

/// Returns true if the sentence is an instruction in the usual form.
fn is_instruction(next: &str) -> bool {
    let begins_small = next.starts_with(|c: char| c.is_ascii_lowercase());
    begins_small && !next.ends_with('.') && !next.contains('\n') && next.len() < 300
}

#[test]
fn every_refusal_says_what_to_do() {
    let all = [portal_errors(), push_errors(), servant_errors(), storage_errors()];
    for error in all.into_iter().flatten() {
        let problem = error.problem();
        let next = problem.next.as_deref().unwrap_or_default();
        assert!(is_instruction(next), "{error:?}: {next:?}");
        assert!(!problem.detail.is_empty(), "{error:?}");
    }
}

#[test]
fn want_of_memory_is_mended_where_the_memory_was_named() {
    let error = choreographer::Error::OutOfMemory { service: "people".into(), memory: api::Size(1), ready: true };
    let next = Error::from(error).problem().next.unwrap_or_default();
    for option in ["--robot-memory", "push it with a larger --memory"] {
        assert!(next.contains(option), "{next}");
    }
}

#[test]
fn nobody_is_to_mend_a_package_whose_servant_somebody_has_ended() {
    let next = |reason: &str| {
        let error = choreographer::Error::Servant {
            service: "people".into(),
            robot: "r1".into(),
            reason: reason.into(),
            log: Vec::new(),
        };
        Error::from(error).problem().next.unwrap_or_default()
    };
    assert!(!next("was ended: an operator has stopped it").contains("package"));
    assert!(next("exited with status 1").contains("push people again"));
}
