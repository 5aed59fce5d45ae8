//! What a client does that is refused: for every refusal a sentence. A refusal without one does not compile.

use catalogue::names::NameError;
use choreographer::{Refused, Unchanged, Untenable};

use super::Error;
use crate::principals::Unrecognised;

const NEXT_OF_ENDING: &str = "ask again when the daemon has started again";
const NEXT_OF_INTERNAL: &str =
    "try again; if it fails again, look at the daemon's log: journalctl -u cloudroid";

impl Error {
    /// What the client does now.
    pub(super) fn next(&self) -> String {
        match self {
            Error::UnknownRobot { .. } => {
                "see those that are served with: cloudroidctl servants; on the robot: rosrun PACKAGE cloudroid-stub doctor".into()
            }
            Error::Unstatable(_) => "see what can be stated in docs/robots.md".into(),
            Error::UnknownPath { .. } => {
                "see what is served: services with cloudroidctl services, the API at /api/v1/openapi.json".into()
            }
            Error::OtherMethod { .. } => "use one of the methods that Allow names".into(),
            Error::BadRequest(_) => {
                "correct that and ask again; what can be asked is described at /api/v1/openapi.json, for robots in docs/robots.md".into()
            }
            Error::UnknownRow { service, .. } => {
                format!("see those that exist with: cloudroidctl sla list {service}")
            }
            Error::Forbidden { .. } => {
                "show a token that may (an admin makes one with: cloudroidctl token create), or ask at the daemon's socket, as root".into()
            }
            Error::UnknownToken { .. } => "see those that exist with: cloudroidctl token list".into(),
            Error::TokenExists(name) => format!(
                "choose another name, give it another secret with: cloudroidctl token rotate {name}, or end it with: cloudroidctl token revoke {name}"
            ),
            Error::UnknownAccount { .. } => "see those that exist with: cloudroidctl account list".into(),
            Error::AccountExists(name) => format!(
                "choose another name, or remove it with: cloudroidctl account remove {name}"
            ),
            Error::PairingExists(name) => format!(
                "choose another name, or end the pairing with: cloudroidctl unpair {name}"
            ),
            Error::WrongPassword => {
                "try again, or have an admin set another password with: cloudroidctl account passwd NAME".into()
            }
            Error::SignInBusy => "try again later".into(),
            Error::TooManyStreams { .. } => {
                "close pages of the portal that are open elsewhere, or end commands that follow something (cloudroidctl logs --follow), then try again".into()
            }
            Error::TooManyLook { .. } => {
                "close pages that look into it elsewhere, then try again".into()
            }
            Error::NotThereYet(id) => {
                format!("see its state with: cloudroidctl servants, or GET /api/v1/servants/{id}; try again when it is ready")
            }
            Error::NoBlackBox(_) => {
                "have an operator set seconds of [black_box] in the configuration (docs/viewers.md); where it is set, a servant is listened to a second after it is ready".into()
            }
            Error::UnknownRecording(_) => "see those that exist with: cloudroidctl recordings list".into(),
            Error::NotRecorded { .. } => {
                "make room on the disk of the state directory, or set another disk in [black_box] of the configuration; then: cloudroidctl recordings take SERVANT".into()
            }
            Error::RecordedLately { .. } => {
                "take that one (cloudroidctl recordings list), or ask again in a few seconds".into()
            }
            Error::NoProvider => "sign in with an account, or have [oidc] configured (docs/access.md)".into(),
            Error::Provider(error) => error.next().into(),
            Error::NoRole { .. } => {
                "have an operator name one of them in roles of [oidc] in the configuration (docs/access.md), or the provider put you into one that is; then sign in again".into()
            }
            Error::UnknownRule { .. } => "see those that exist with: cloudroidctl policy list".into(),
            Error::WebSocketVersion => "use a client that speaks RFC 6455".into(),
            Error::Unrecognised(Unrecognised::Slowed(_)) => {
                "ask again then; tokens made by cloudroidctl token create are looked at always".into()
            }
            Error::Unrecognised(Unrecognised::SlowedSignIn(_)) => {
                "try again then; who is signed in stays so, and root and the group cloudroid need no password at the daemon's sockets".into()
            }
            Error::Unrecognised(Unrecognised::SessionOver) => "sign in again".into(),
            Error::Unauthorised(_)
            | Error::Unrecognised(
                Unrecognised::Revoked | Unrecognised::Expired | Unrecognised::Unknown,
            ) => {
                "send a token that the operator gave you: Authorization: Bearer TOKEN, or ?token=TOKEN".into()
            }
            Error::Uncertified(_) | Error::Uncoded(_) => {
                "have it paired: on the server cloudroidctl pair ROBOT, on the robot cloudroid-stub pair 'LINE'".into()
            }
            Error::UnknownPairing { .. } => "see those that there are with: cloudroidctl pair --list".into(),
            Error::PlainText { instead } => format!(
                "use {instead}; what was sent, such as a token, could be read by anybody on the way"
            ),
            Error::Foreign { next, .. } => next.clone(),
            Error::RobotTaken(_) => "connect with that token, or under another name".into(),
            Error::Memory(_) => "send less at a time, or raise client and daemon in [memory] of the configuration".into(),
            Error::BodyTooLarge { .. } => "send less in one request".into(),
            Error::Unfinished { .. } => {
                "send it over a faster connection, or raise unfinished in [memory] of the configuration".into()
            }
            Error::TrialTooLarge { .. } => {
                "send a shorter one, or raise client and daemon in [memory] of the configuration; 512M is the most".into()
            }
            Error::Uncertifiable(error) => next_of_authority(error).into(),
            Error::Push(error) => next_of_push(error),
            Error::Choreographer(error) => next_of_choreographer(error),
            Error::Catalogue(error) => next_of_catalogue(error),
            Error::State(error) => next_of_state(error).into(),
            Error::Image(error) => next_of_image(error).into(),
            Error::Internal(_) => NEXT_OF_INTERNAL.into(),
        }
    }
}

fn next_of_authority(error: &authority::Error) -> &'static str {
    use authority::Error as A;
    match error {
        A::Io { .. } | A::NoAuthority { .. } | A::Unmade { .. } => NEXT_OF_INTERNAL,
        A::NoRequest(_) | A::TooLong(_) | A::OtherName { .. } | A::Kind => {
            "have the robot make its request itself: cloudroid-stub pair 'LINE'"
        }
        A::Nameless(_) => {
            "show a certificate whose name is a robot's, or pair the robot anew: cloudroidctl pair ROBOT"
        }
    }
}

fn next_of_state(error: &store::Error) -> &'static str {
    match error {
        store::Error::Database { .. } => {
            "make sure that the disk of the state directory has room and can be written, then try again; the daemon's log says more"
        }
        store::Error::TooNew { .. } => "install the newer cloudroidd",
        store::Error::Record { .. } => NEXT_OF_INTERNAL,
    }
}

fn next_of_image(error: &image::Error) -> &'static str {
    use image::Error as I;
    match error {
        I::DiskFull { .. } => "make room on the disk of the state directory, then try again",
        I::Json { .. } | I::UnknownLayer { .. } | I::UnknownImage { .. } | I::Damaged { .. } => {
            "push the package again"
        }
        I::BadDigest { .. }
        | I::BadTag { .. }
        | I::Unreceivable { .. }
        | I::Tree { .. }
        | I::Archive { .. } => "correct what is sent, and send it again",
        I::File { .. } | I::NotALayout { .. } => NEXT_OF_INTERNAL,
    }
}

fn next_of_push(error: &push::Error) -> String {
    use push::Error as P;
    match error {
        P::NotAllowed(_) => "choose another name with --name, or ask its owner".into(),
        P::NameTaken { name, .. } => {
            format!(
                "choose another name with --name, or remove the service with: cloudroidctl rm {name}"
            )
        }
        P::Options(_) => {
            "correct that and push again; cloudroidctl push --help says what can be given".into()
        }
        P::Failed { next, .. } => next
            .clone()
            .unwrap_or_else(|| "correct what it names, and push again".into()),
        P::TooLarge { .. } => {
            "leave out what is not needed, or raise archive in [push] of the configuration".into()
        }
        P::Choreographer(error) => next_of_choreographer(error),
        P::Catalogue(error) => next_of_catalogue(error),
        P::Engine(error) => next_of_engine(error).into(),
        P::State(error) => next_of_state(error).into(),
        P::Image(error) => next_of_image(error).into(),
        P::Ending => NEXT_OF_ENDING.into(),
        P::Internal(_) => NEXT_OF_INTERNAL.into(),
    }
}

fn next_of_choreographer(error: &choreographer::Error) -> String {
    use choreographer::Error as C;
    match error {
        C::UnknownServant { .. } => "see those that exist with: cloudroidctl servants".into(),
        C::Full(Refused::TooBig { .. }) => "push it with smaller --cpus and --memory".into(),
        C::Terms(untenable) => next_of_terms(untenable),
        C::NotResized { reason, .. } => match &**reason {
            Unchanged::Untenable(untenable) => next_of_terms(untenable),
            Unchanged::Full(Refused::NoMore { free, .. }) => format!(
                "state what fits: cpus={} memory={}; it keeps what it has until then",
                free.cpus(),
                api::Size(free.memory)
            ),
            Unchanged::Full(
                Refused::TooBig { .. }
                | Refused::QueueFull { .. }
                | Refused::Deadline { .. }
                | Refused::Stalled { .. }
                | Refused::NoMoreNow { .. },
            ) => "try again later; it keeps what it has until then".into(),
            Unchanged::Used { used, .. } => {
                format!("state memory={used} or more, or end it with: cloudroidctl stop")
            }
            Unchanged::Many => {
                "let these stubs state nothing, or end the servant with: cloudroidctl stop".into()
            }
        },
        C::Full(
            Refused::NoMore { .. }
            | Refused::QueueFull { .. }
            | Refused::Deadline { .. }
            | Refused::Stalled { .. }
            | Refused::NoMoreNow { .. },
        ) => "try again later, end servants (cloudroidctl stop), or raise [capacity] in the configuration".into(),
        C::Place { service, .. } => format!(
            "name one of the servants of {service}, which are named ~group- where a robot's name stands: cloudroidctl servants"
        ),
        // Nothing is wrong with what somebody has ended.
        C::Servant { reason, .. } if reason.starts_with("was ended: ") => {
            "begin again; who ended it is told by: cloudroidctl events".into()
        }
        C::Servant { service, .. } => {
            format!("see cloudroidctl events, and push {service} again when its package is fixed")
        }
        C::NoRollout(service) => format!(
            "push a revision with --canary or --deadline, or begin with one: cloudroidctl rollout {service} start REVISION --canary 10%"
        ),
        C::BackOff { service, .. } => {
            format!("see why with: cloudroidctl events; push {service} again when its package is fixed: a new revision is started at once")
        }
        C::Rollout(_) => {
            "see the service's revisions with: cloudroidctl services NAME, and how it comes to the next one with: cloudroidctl rollout NAME".into()
        }
        C::OutOfMemory { .. } => {
            "give it more memory: --robot-memory where it stands for a robot, else push it with a greater --memory".into()
        }
        C::Calibration(_) | C::Shadow(_) => "do what it says, and begin again".into(),
        C::Catalogue(error) => next_of_catalogue(error),
        C::State(error) => next_of_state(error).into(),
        C::Engine(error) => next_of_engine(error).into(),
        C::Reach(error) => next_of_reach(error).into(),
        C::Ending => NEXT_OF_ENDING.into(),
        C::Internal(_) => NEXT_OF_INTERNAL.into(),
    }
}

fn next_of_reach(error: &reach::Error) -> &'static str {
    use reach::Error as R;
    match error {
        R::Bus(_) | R::Elsewhere(_) => {
            "see what became of the servant with: cloudroidctl events, then try again"
        }
        R::Linked(_) => "try the service with a robot that has its stub",
        R::Trial(_) => {
            "give a recording (rosbag 2.0) of what the service listens to; try and calibrate take PNG files as well"
        }
    }
}

fn next_of_engine(error: &servant::Error) -> &'static str {
    use servant::Error as E;
    match error {
        E::Grant(_) => {
            "push again without it, or have the operator allow it: [allow] of the configuration"
        }
        E::Refused { .. }
        | E::Ended { .. }
        | E::Start { .. }
        | E::Exists { .. }
        | E::NoNode { .. } => {
            "see what became of the servant with: cloudroidctl events, then try again"
        }
        E::Unanswered { .. } => {
            "see whether its shim runs with: cloudroidctl doctor, or end the servant"
        }
        E::Isolation { .. }
        | E::IdmapUnsupported { .. }
        | E::NoUidRange { .. }
        | E::Stray { .. } => {
            "do what it says on the server, and see with cloudroidctl doctor whether it suffices"
        }
        E::Image { .. } => "push the package again",
        E::File { .. }
        | E::Call { .. }
        | E::InvalidSpec { .. }
        | E::LeftOver { .. }
        | E::Malformed { .. } => NEXT_OF_INTERNAL,
    }
}

fn next_of_terms(untenable: &Untenable) -> String {
    match untenable {
        Untenable::UnknownClass { exists, .. } if exists.is_empty() => {
            "state none, or have the operator add it: [class.NAME] of the configuration".into()
        }
        Untenable::UnknownClass { .. } => {
            "state one that exists, or have the operator add it: [class.NAME] of the configuration"
                .into()
        }
        Untenable::Capped { cap, .. } => {
            format!("state {}={} or less", cap.resource, cap.most)
        }
        Untenable::Beyond { assumed, fits, .. } if !assumed.is_empty() => {
            let keys: Vec<String> = assumed.keys().map(|key| format!("aux.{key}")).collect();
            let fits = fits.as_ref().map(|fits| format!(", or what fits: {fits}"));
            let keys = keys.join(" and ");
            format!("state {keys}{}", fits.unwrap_or_default())
        }
        Untenable::Beyond {
            fits: Some(fits), ..
        }
        | Untenable::Unmet {
            fits: Some(fits), ..
        } => format!("state what fits: {fits}"),
        Untenable::Beyond { .. } => "state less, or have the operator raise the cap".into(),
        Untenable::Unmet { service, .. } => format!(
            "state resources outright (cpus, memory), or have the deployer add a row: cloudroidctl sla set {service}"
        ),
    }
}

fn next_of_catalogue(error: &catalogue::Error) -> String {
    use catalogue::Error as C;
    match error {
        C::UnknownService { exists, .. } if exists.is_empty() => {
            "publish one with: cloudroidctl push".to_owned()
        }
        C::UnknownService { .. } => {
            "use one that exists, or publish it with: cloudroidctl push".to_owned()
        }
        C::UnknownRevision { service, .. } => {
            format!("see those that exist with: cloudroidctl services {service}")
        }
        C::NoStub { service, .. } => format!("fix the package and push {service} again"),
        C::UnknownArchitecture { .. } => {
            "ask for one that it holds with ?arch=, or have its operator add the others: make stub-cross".to_owned()
        }
        C::UnknownImage { .. } => {
            "see those that exist with: cloudroidctl services NAME".to_owned()
        }
        C::Name(NameError::Service(_) | NameError::Reserved(_)) => {
            "choose another name with --name".to_owned()
        }
        C::Name(NameError::Robot(_)) => "name the robot so".to_owned(),
        C::Inventory(_) => "correct the package, and push it again".to_owned(),
        C::State(error) => next_of_state(error).to_owned(),
        C::Image(error) => next_of_image(error).to_owned(),
        C::Internal(_) => NEXT_OF_INTERNAL.to_owned(),
    }
}

#[cfg(test)]
mod tests;
