//! Next steps after each error: one sentence for every error; an error without one does not compile.

use catalogue::names::NameError;
use choreographer::{AdmissionError, ResizeError, TermsError};

use super::Error;
use crate::principals::refusals::AuthenticationError;

const NEXT_OF_ENDING: &str = "try again when the daemon has restarted";
const NEXT_OF_INTERNAL: &str = "try again; if it fails again, see the daemon's log: journalctl -u cloudroid";

impl Error {
    /// Returns what the client should do now.
    pub(super) fn next_step(&self) -> String {
        match self {
            Error::UnknownRobot { .. } => {
                "list robots with servants by: cloudroidctl servants; on the robot: rosrun PACKAGE cloudroid-stub \
                    doctor"
                    .into()
            }
            Error::Unstatable(_) => "see docs/robots.md for what a robot can ask for".into(),
            Error::UnknownPath { .. } => {
                "see the services with: cloudroidctl services; the API is described at /api/v1/openapi.json".into()
            }
            Error::OtherMethod { .. } => "use one of the methods in the header Allow".into(),
            Error::BadRequest(_) => {
                "correct the request and try again; the API is described at /api/v1/openapi.json, for robots in \
                    docs/robots.md"
                    .into()
            }
            Error::UnknownRow { service, .. } => {
                format!("list them with: cloudroidctl sla list {service}")
            }
            Error::Forbidden { .. } => {
                "use a token that may do this (an admin creates one with: cloudroidctl token create), or run the \
                    command on the server as root"
                    .into()
            }
            Error::UnknownToken { .. } => "list them with: cloudroidctl token list".into(),
            Error::TokenExists(name) => format!(
                "choose another name, replace its secret with: cloudroidctl token rotate {name}, or revoke it with: \
                    cloudroidctl token revoke {name}"
            ),
            Error::UnknownAccount { .. } => "list them with: cloudroidctl account list".into(),
            Error::AccountExists(name) => {
                format!("choose another name, or remove it with: cloudroidctl account remove {name}")
            }
            Error::PairingExists(name) => {
                format!("choose another name, or end the pairing with: cloudroidctl unpair {name}")
            }
            Error::WrongPassword => {
                "try again, or have an admin set another password with: cloudroidctl account passwd NAME".into()
            }
            Error::SignInBusy => "try again later".into(),
            Error::TooManyStreams { .. } => {
                "close other open pages of the portal, or stop commands that follow (cloudroidctl logs --follow), then \
                    try again"
                    .into()
            }
            Error::TooManyLook { .. } => "close other pages that look into it, then try again".into(),
            Error::NotThereYet(id) => {
                format!(
                    "see its state with: cloudroidctl servants, or GET /api/v1/servants/{id}; try again when it \
                         is ready"
                )
            }
            Error::NotRunning(id) => {
                format!("see its state with: cloudroidctl servants; try again when {id} is ready")
            }
            Error::ExecOff => {
                "have an operator set exec = true in [portal] of the configuration; the output of nodes is shown by: \
                    cloudroidctl logs SERVANT"
                    .into()
            }
            Error::TooManyExecs { .. } => "end one of them (exit, or Ctrl-D), then try again".into(),
            Error::NoBlackBox(_) => {
                "have an operator set seconds in [black_box] of the configuration (docs/viewers.md); if it is set, \
                    recording begins a second after the servant is ready"
                    .into()
            }
            Error::UnknownRecording(_) => "list them with: cloudroidctl recordings list".into(),
            Error::UnknownPush(_) => "list them with: cloudroidctl pushes".into(),
            Error::PushNotCancelled { .. } => {
                "see what became of it with: cloudroidctl pushes; change a service back with: cloudroidctl rollback"
                    .into()
            }
            Error::NotRecorded { .. } => {
                "free some space on the disk of the state directory, or set another disk in [black_box] of the \
                    configuration; then: cloudroidctl recordings take SERVANT"
                    .into()
            }
            Error::RecordedLately { .. } => {
                "use that one (cloudroidctl recordings list), or try again in a few seconds".into()
            }
            Error::NoProvider => "sign in with an account, or have [oidc] configured (docs/access.md)".into(),
            Error::Provider(error) => error.next_step().into(),
            Error::NoRole { .. } => {
                "ask an operator to add one of them to roles in [oidc] of the configuration (docs/access.md), or ask \
                    the provider to put you into a group that is listed there; then sign in again"
                    .into()
            }
            Error::UnknownRule { .. } => "list them with: cloudroidctl policy list".into(),
            Error::WebSocketVersion => "use a client that speaks RFC 6455".into(),
            Error::Unrecognised(AuthenticationError::Slowed(_)) => {
                "try again then; valid tokens made by cloudroidctl token create always work".into()
            }
            Error::Unrecognised(AuthenticationError::SlowedSignIn(_)) => {
                "try again then; open sessions are not affected, and root and the group cloudroid need no password at \
                    the daemon's sockets"
                    .into()
            }
            Error::Unrecognised(AuthenticationError::SessionOver) => "sign in again".into(),
            Error::Unauthorised(_)
            | Error::Unrecognised(
                AuthenticationError::Revoked | AuthenticationError::Expired | AuthenticationError::Unknown,
            ) => "send a token from the operator: Authorization: Bearer TOKEN, or ?token=TOKEN".into(),
            Error::Uncertified(_) | Error::Uncoded(_) => {
                "pair it: on the server cloudroidctl pair ROBOT, on the robot cloudroid-stub pair 'LINE'".into()
            }
            Error::UnknownPairing { .. } => "list them with: cloudroidctl pair --list".into(),
            Error::PlainText { instead } => {
                format!("use {instead}; anything sent in plain text, such as a token, can be read on the way")
            }
            Error::Foreign { next, .. } => next.clone(),
            Error::RobotTaken(_) => "connect with that token, or under another name".into(),
            Error::Memory(_) => "send less at a time, or raise client and daemon in [memory] of the \
                                 configuration"
                .into(),
            Error::BodyTooLarge { .. } => "send less in one request".into(),
            Error::Unfinished { .. } => {
                "send it over a faster connection, or raise unfinished in [memory] of the configuration".into()
            }
            Error::TrialTooLarge { .. } => {
                "send a shorter one, or raise client and daemon in [memory] of the configuration; 512M is the \
                 most"
                    .into()
            }
            Error::Uncertifiable(error) => authority_next_step(error).into(),
            Error::Push(error) => push_next_step(error),
            Error::Choreographer(error) => choreographer_next_step(error),
            Error::Catalogue(error) => catalogue_next_step(error),
            Error::State(error) => state_next_step(error).into(),
            Error::Image(error) => image_next_step(error).into(),
            Error::Internal(_) => NEXT_OF_INTERNAL.into(),
        }
    }
}

fn authority_next_step(error: &authority::Error) -> &'static str {
    use authority::Error as A;
    match error {
        A::Io { .. } | A::NoAuthority { .. } | A::Unmade { .. } => NEXT_OF_INTERNAL,
        A::NoRequest(_) | A::TooLong(_) | A::OtherName { .. } | A::Kind => {
            "have the robot make its request itself: cloudroid-stub pair 'LINE'"
        }
        A::Nameless(_) => "use a certificate that names a robot, or pair the robot again: cloudroidctl pair ROBOT",
    }
}

fn state_next_step(error: &store::Error) -> &'static str {
    match error {
        store::Error::Database { .. } => {
            "make sure that the disk of the state directory has room and can be written, then try again; see the \
                daemon's log"
        }
        store::Error::TooNew { .. } => "install the newer cloudroidd",
        store::Error::Record { .. } => NEXT_OF_INTERNAL,
    }
}

fn image_next_step(error: &image::Error) -> &'static str {
    use image::Error as I;
    match error {
        I::DiskFull { .. } => "free some space on the disk of the state directory, then try again",
        I::Json { .. } | I::UnknownLayer { .. } | I::UnknownImage { .. } | I::Damaged { .. } => {
            "push the package again"
        }
        I::BadDigest { .. } | I::BadTag { .. } | I::Unreceivable { .. } | I::Tree { .. } | I::Archive { .. } => {
            "correct the content and send it again"
        }
        I::File { .. } | I::NotALayout { .. } => NEXT_OF_INTERNAL,
    }
}

fn push_next_step(error: &push::Error) -> String {
    use push::Error as P;
    match error {
        P::NotAllowed(_) => "choose another name with --name, or ask its owner".into(),
        P::NameTaken { name, .. } => {
            format!("choose another name with --name, or remove the service with: cloudroidctl rm {name}")
        }
        P::UnknownBase { .. } | P::BaseNotImported(_) | P::BaseExists(_) => "list them with: cloudroidctl bases".into(),
        P::UnknownUnderlay { .. } => {
            "list them with: cloudroidctl underlays; publish one with: cloudroidctl push WORKSPACE --as-underlay NAME"
                .into()
        }
        P::UnderlayInUse { .. } => "push these services without it, or remove them".into(),
        P::UnderlayRecord { .. } => "push the underlay again".into(),
        P::BaseNotSetUp(_) => "push a package that uses it, then try again".into(),
        P::Options(_) => "correct the options and push again; see cloudroidctl push --help".into(),
        P::Failed { next, .. } => {
            next.clone().unwrap_or_else(|| "correct the problem named above and push again".into())
        }
        P::TooLarge { .. } => {
            "remove files that are not needed, or raise archive in [push] of the configuration".into()
        }
        P::Choreographer(error) => choreographer_next_step(error),
        P::Catalogue(error) => catalogue_next_step(error),
        P::Engine(error) => engine_next_step(error).into(),
        P::State(error) => state_next_step(error).into(),
        P::Image(error) => image_next_step(error).into(),
        P::Ending => NEXT_OF_ENDING.into(),
        P::Cancelled => "push again when it is wanted; what was built before is kept".into(),
        P::Internal(_) => NEXT_OF_INTERNAL.into(),
    }
}

fn choreographer_next_step(error: &choreographer::Error) -> String {
    use choreographer::Error as C;
    match error {
        C::UnknownServant { .. } => "list them with: cloudroidctl servants".into(),
        C::Full(AdmissionError::TooBig { .. }) => {
            "pass smaller --cpus and --memory; cloudroidctl status shows what this machine has".into()
        }
        C::Terms(untenable) => terms_next_step(untenable),
        C::NotResized { reason, .. } => match &**reason {
            ResizeError::Untenable(untenable) => terms_next_step(untenable),
            ResizeError::Full(AdmissionError::NoMore { free, .. }) => format!(
                "request at most cpus={} memory={}; until then it keeps its limits",
                free.cpus(),
                api::Size(free.memory)
            ),
            ResizeError::Full(
                AdmissionError::TooBig { .. }
                | AdmissionError::QueueFull { .. }
                | AdmissionError::Deadline { .. }
                | AdmissionError::Stalled { .. }
                | AdmissionError::NoMoreNow { .. },
            ) => "try again later; until then it keeps its limits".into(),
            ResizeError::Used { used, .. } => {
                format!("request memory={used} or more, or stop it with: cloudroidctl stop")
            }
            ResizeError::Many => "remove the terms of these stubs, or stop the servant with: cloudroidctl stop".into(),
        },
        C::Full(
            AdmissionError::NoMore { .. }
            | AdmissionError::QueueFull { .. }
            | AdmissionError::Deadline { .. }
            | AdmissionError::Stalled { .. }
            | AdmissionError::NoMoreNow { .. },
        ) => "try again later, stop servants (cloudroidctl stop), or raise [capacity] in the configuration".into(),
        C::Place { service, .. } => format!(
            "give one of the servants of {service}, which have ~group- in the place of a robot's name: cloudroidctl \
                servants"
        ),
        // Nothing is wrong with a servant that was stopped on purpose.
        C::Servant { reason, .. } if reason.starts_with("was ended: ") => {
            "start again; cloudroidctl events tells who stopped it".into()
        }
        C::Servant { service, .. } => {
            format!("see cloudroidctl events, and push {service} again when its package is fixed")
        }
        C::NoRollout(service) => format!(
            "push a revision with --canary or --deadline, or start a rollout: cloudroidctl rollout {service} start \
                REVISION --canary 10%"
        ),
        C::BackOff { service, .. } => {
            format!(
                "see why with: cloudroidctl events; push {service} again when its package is fixed: a new revision \
                starts at once"
            )
        }
        C::Rollout(_) => {
            "see the service's revisions with: cloudroidctl services NAME, and its rollout with: cloudroidctl rollout \
                NAME"
                .into()
        }
        C::OutOfMemory { .. } => {
            "give it more memory: with --robot-memory if it stands for a robot, otherwise push it with a larger \
                --memory"
                .into()
        }
        C::Calibration(_) | C::Shadow(_) => "correct the problem named above and start again".into(),
        C::Catalogue(error) => catalogue_next_step(error),
        C::State(error) => state_next_step(error).into(),
        C::Engine(error) => engine_next_step(error).into(),
        C::Reach(error) => reach_next_step(error).into(),
        C::Ending => NEXT_OF_ENDING.into(),
        C::Internal(_) => NEXT_OF_INTERNAL.into(),
    }
}

fn reach_next_step(error: &reach::Error) -> &'static str {
    use reach::Error as R;
    match error {
        R::Bus(_) | R::Elsewhere(_) => "see what happened to the servant with: cloudroidctl events, then try again",
        R::Linked(_) => "try the service with a robot that has its stub",
        R::Trial(_) => {
            "give a recording (rosbag 2.0) of the topics that the service subscribes to; try and calibrate also take \
                PNG files"
        }
    }
}

fn engine_next_step(error: &servant::Error) -> &'static str {
    use servant::Error as E;
    match error {
        E::Grant(_) => "push again without it, or ask the operator to allow it in [allow] of the configuration",
        E::Refused { .. } | E::Ended { .. } | E::Start { .. } | E::Exists { .. } | E::NoNode { .. } => {
            "see what happened to the servant with: cloudroidctl events, then try again"
        }
        E::Unanswered { .. } => "check with cloudroidctl doctor whether its shim runs, or stop the servant",
        E::Isolation { .. } | E::IdmapUnsupported { .. } | E::NoUidRange { .. } | E::Stray { .. } => {
            "do this on the server, then check it with: cloudroidctl doctor"
        }
        E::Image { .. } => "push the package again",
        E::File { .. } | E::Call { .. } | E::InvalidSpec { .. } | E::LeftOver { .. } | E::Malformed { .. } => {
            NEXT_OF_INTERNAL
        }
    }
}

fn terms_next_step(untenable: &TermsError) -> String {
    match untenable {
        TermsError::UnknownClass { exists, .. } if exists.is_empty() => {
            "request no class, or ask the operator to add it: [class.NAME] of the configuration".into()
        }
        TermsError::UnknownClass { .. } => {
            "request an existing class, or ask the operator to add it: [class.NAME] of the configuration".into()
        }
        TermsError::Capped { cap, .. } => {
            format!("request {}={} or less", cap.resource, cap.most)
        }
        TermsError::Beyond { assumed, fits, .. } if !assumed.is_empty() => {
            let keys: Vec<String> = assumed.keys().map(|key| format!("aux.{key}")).collect();
            let fits = fits.as_ref().map(|fits| format!(", or request what fits: {fits}"));
            let keys = keys.join(" and ");
            format!("give {keys}{}", fits.unwrap_or_default())
        }
        TermsError::Beyond { fits: Some(fits), .. } | TermsError::Unmet { fits: Some(fits), .. } => {
            format!("request what fits: {fits}")
        }
        TermsError::Beyond { .. } => "request less, or ask the operator to raise the cap".into(),
        TermsError::Unmet { service, .. } => format!(
            "request cpus and memory directly, or ask the deployer to add an entry: cloudroidctl sla set {service}"
        ),
    }
}

fn catalogue_next_step(error: &catalogue::Error) -> String {
    use catalogue::Error as C;
    match error {
        C::UnknownService { exists, .. } if exists.is_empty() => "publish one with: cloudroidctl push".to_owned(),
        C::UnknownService { .. } => "use an existing service, or publish this one with: cloudroidctl push".to_owned(),
        C::UnknownRevision { service, .. } => {
            format!("list them with: cloudroidctl services {service}")
        }
        C::NoStub { service, .. } => format!("fix the package and push {service} again"),
        C::NoTwins { service, .. } => format!(
            "change these fields of the package's messages and push {service} again, or request the archive for \
             robots of the service's own ROS (without ?ros=)"
        ),
        C::UnknownArchitecture { .. } => {
            "request an available one with ?arch=, or ask the operator to add others: make stub-cross".to_owned()
        }
        C::UnknownImage { .. } => "list them with: cloudroidctl services NAME".to_owned(),
        C::Name(NameError::Service(_) | NameError::Reserved(_)) => "choose another name with --name".to_owned(),
        C::Name(NameError::Robot(_)) => "rename the robot accordingly".to_owned(),
        C::Inventory(_) => "correct the package and push it again".to_owned(),
        C::State(error) => state_next_step(error).to_owned(),
        C::Image(error) => image_next_step(error).to_owned(),
        C::Internal(_) => NEXT_OF_INTERNAL.to_owned(),
    }
}

#[cfg(test)]
mod tests;
