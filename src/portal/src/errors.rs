//! All errors of the HTTP API and their problem details (RFC 9457).

use api::Problem;
use api::problem::PROBLEM_JSON;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use catalogue::names::NameError;
use choreographer::{AdmissionError, ResizeError, TermsError, with_last_log_line};

use crate::principals::refusals::{AuthenticationError, CertificateRefusal, PairingCodeRefusal};

mod next;

/// Reason why a request is refused.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No robot of that name is served, or was recently.
    #[error("unknown robot {name:?}: it has no servant and no recent events")]
    UnknownRobot {
        /// Requested name.
        name: String,
        /// Robots that are served.
        exists: Vec<String>,
    },
    /// The service's dictionary has no such row.
    #[error("the SLA table of {service} has no entry {id:?}")]
    UnknownRow {
        /// Name of the service.
        service: String,
        /// Requested row.
        id: String,
        /// Existing rows.
        exists: Vec<String>,
    },
    /// The path is unknown.
    #[error("there is nothing at {path}")]
    UnknownPath {
        /// Requested path.
        path: String,
    },
    /// The path exists, but not for this method.
    #[error("{method} is not supported at {path}")]
    OtherMethod {
        /// Request method.
        method: String,
        /// Requested path.
        path: String,
    },
    /// The request is malformed.
    #[error("{0}")]
    BadRequest(String),
    /// The stated requirements are invalid.
    #[error("{0}")]
    Unstatable(api::sla::Unstatable),
    /// The WebSocket handshake has a version other than 13.
    #[error("not a WebSocket handshake: Sec-WebSocket-Version is not 13")]
    WebSocketVersion,
    /// No credential was presented.
    #[error("{0}")]
    Unauthorised(&'static str),
    /// The token, session or sign-in was not accepted.
    #[error(transparent)]
    Unrecognised(#[from] AuthenticationError),
    /// The client certificate was not accepted.
    #[error(transparent)]
    Uncertified(#[from] CertificateRefusal),
    /// The pairing code was not accepted.
    #[error(transparent)]
    Uncoded(#[from] PairingCodeRefusal),
    /// No certificate could be issued.
    #[error(transparent)]
    Uncertifiable(authority::Error),
    /// The robot is not paired, and no pairing code is pending for it.
    #[error("robot {name:?} is not paired and has no pending pairing code")]
    UnknownPairing {
        /// Requested name.
        name: String,
        /// Existing pairings.
        exists: Vec<String>,
    },
    /// Plain HTTP on a port that uses TLS.
    #[error("this port requires https, but the request was plain http")]
    PlainText {
        /// URL to use instead.
        instead: String,
    },
    /// The request comes from another site's page, or is addressed to another host.
    #[error("{what}")]
    Foreign {
        /// Description of what is wrong.
        what: String,
        /// Next step for the client.
        next: String,
    },
    /// The policy does not allow the request.
    #[error("{what}")]
    Forbidden {
        /// Description: the caller, and what it may not do.
        what: String,
    },
    /// No token of that name, or it was revoked.
    #[error("there is no valid token {name:?}")]
    UnknownToken {
        /// Requested name.
        name: String,
        /// Existing tokens.
        exists: Vec<String>,
    },
    /// The token's name is taken.
    #[error("there is a token {0:?} already")]
    TokenExists(String),
    /// No account of that name.
    #[error("there is no account {name:?}")]
    UnknownAccount {
        /// Requested name.
        name: String,
        /// Existing accounts.
        exists: Vec<String>,
    },
    /// The account's name is taken.
    #[error("there is an account {0:?} already")]
    AccountExists(String),
    /// The name belongs to a robot that is paired or has a pending pairing code.
    #[error("robot {0:?} is already paired or has a pending pairing code")]
    PairingExists(String),
    /// Wrong password or unknown account; which of the two is not revealed.
    #[error("name or password is wrong")]
    WrongPassword,
    /// No identity provider is configured.
    #[error("no identity provider is configured")]
    NoProvider,
    /// The sign-in through the identity provider failed.
    #[error(transparent)]
    Provider(#[from] oidc::Error),
    /// A person signed in whose groups have no role here.
    #[error("{who} signed in, but is in no group that has a role here: {has}")]
    NoRole {
        /// Name that the person would have here.
        who: String,
        /// Groups of the person.
        has: String,
    },
    /// Too many sign-ins at once.
    #[error("too many sign-ins at once")]
    SignInBusy,
    /// The caller has too many open streams.
    #[error("{most} streams are already open, which is the limit")]
    TooManyStreams {
        /// The limit.
        most: usize,
    },
    /// Too many connections look into the servant.
    #[error("too many connections look into servant {servant}: the limit is {most}, and {each} for each user")]
    TooManyLook {
        /// Id of the servant.
        servant: String,
        /// Limit on all connections.
        most: usize,
        /// Limit on the connections of each principal.
        each: usize,
    },
    /// The servant's ROS is not available yet, or no longer.
    #[error("cannot look into servant {0}: it is starting or ending")]
    NotThereYet(String),
    /// The servant's container does not run yet, or no longer.
    #[error("no program can be run in servant {0}: it is starting or ending")]
    NotRunning(String),
    /// The configuration allows no programs in servants.
    #[error("no programs can be run in servants here: the configuration has exec = false")]
    ExecOff,
    /// The caller has too many exec sessions.
    #[error("{who} runs {most} programs in servants already, which is the limit")]
    TooManyExecs {
        /// Name of the caller.
        who: String,
        /// The limit.
        most: usize,
    },
    /// The servant has no black box.
    #[error("servant {0} has no ring-buffer recording")]
    NoBlackBox(String),
    /// No such recording.
    #[error("there is no recording {0}")]
    UnknownRecording(String),
    /// No such push.
    #[error("there is no push {0}")]
    UnknownPush(String),
    /// The push cannot be cancelled.
    #[error("push {number} cannot be cancelled: {why}")]
    PushNotCancelled {
        /// Number of the push.
        number: u64,
        /// Reason.
        why: &'static str,
    },
    /// The servant's last seconds could not be recorded.
    #[error("the last seconds of servant {servant} could not be recorded: {reason}")]
    NotRecorded {
        /// Id of the servant.
        servant: String,
        /// Reason of the failure.
        reason: String,
    },
    /// The servant's last seconds were recorded a moment ago.
    #[error("the last seconds of servant {servant} were recorded a moment ago")]
    RecordedLately {
        /// Id of the servant.
        servant: String,
        /// Seconds to wait.
        again: u64,
    },
    /// No such rule of the policy.
    #[error("the policy has no rule {id:?}")]
    UnknownRule {
        /// Requested rule.
        id: String,
        /// Existing rules.
        exists: Vec<String>,
    },
    /// The robot's name belongs to another token.
    #[error("the robot name {0:?} belongs to another token")]
    RobotTaken(String),
    /// The body is too large.
    #[error("the body is larger than {limit}")]
    BodyTooLarge {
        /// Maximum size.
        limit: api::Size,
    },
    /// The recording or picture is too large.
    #[error("the recording or picture is larger than {limit}")]
    TrialTooLarge {
        /// Maximum size.
        limit: api::Size,
    },
    /// The body exceeds its sender's memory budget.
    #[error("not enough memory for the body: {0}")]
    Memory(#[from] budget::Exceeded),
    /// The body was not complete in time.
    #[error("the body was not complete after {} s", after.as_secs())]
    Unfinished {
        /// The timeout.
        after: std::time::Duration,
    },
    /// The push failed.
    #[error(transparent)]
    Push(#[from] push::Error),
    /// The choreographer refused or failed.
    #[error(transparent)]
    Choreographer(#[from] choreographer::Error),
    /// The catalogue refused or failed.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// The state database failed.
    #[error(transparent)]
    State(#[from] store::Error),
    /// The image store failed.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// A task of the daemon failed.
    #[error("the daemon failed at {0}; see its log for details")]
    Internal(&'static str),
}

impl Error {
    /// Formats the error for a status message: what happened, and the last line of the log if one explains it.
    pub fn one_line(&self) -> String {
        match self.log() {
            Some(log) => with_last_log_line(&self.to_string(), log),
            None if self.is_terms_refusal() => {
                format!("{self}; {}", self.next_step())
            }
            None => self.to_string(),
        }
    }
}

impl From<access::AccessDenied> for Error {
    fn from(refusal: access::AccessDenied) -> Error {
        Error::Forbidden { what: refusal.to_string() }
    }
}

impl Error {
    /// Returns true if the robot is refused as long as it asks for the same on a machine of this configuration:
    /// because of its requirements, or because its servant does not fit even on an empty machine.
    pub fn is_final(&self) -> bool {
        use choreographer::Error as C;
        let error = self.choreographer_error();
        matches!(error, Some(C::Terms(_) | C::Full(AdmissionError::TooBig { .. })))
            || matches!(error, Some(C::NotResized { reason, .. }) if !matches!(&**reason, ResizeError::Full(_)))
    }

    /// Returns true if the robot is refused because of its requirements; the message then tells what it could state.
    fn is_terms_refusal(&self) -> bool {
        matches!(
            self.choreographer_error(),
            Some(choreographer::Error::Terms(_) | choreographer::Error::NotResized { .. })
        )
    }
}

/// Default of `Retry-After` in seconds.
const DEFAULT_RETRY_DELAY: u64 = 10;

/// Status, kind and title of a problem.
type Kind = (StatusCode, &'static str, &'static str);

const INTERNAL: Kind = (StatusCode::INTERNAL_SERVER_ERROR, "internal", "internal error");
const ENDING: Kind = (StatusCode::SERVICE_UNAVAILABLE, "ending", "daemon shutting down");

impl Error {
    /// Returns the problem details for the client.
    pub fn problem(&self) -> Problem {
        let (status, kind, title) = self.kind();
        let mut problem = Problem {
            kind: format!("urn:cloudroid:{kind}"),
            title: title.to_owned(),
            status: status.as_u16(),
            detail: self.to_string(),
            next: Some(self.next_step()),
            ..Problem::default()
        };
        if let Error::UnknownRobot { exists, .. }
        | Error::UnknownRow { exists, .. }
        | Error::UnknownToken { exists, .. }
        | Error::UnknownPairing { exists, .. }
        | Error::UnknownAccount { exists, .. }
        | Error::Push(push::Error::UnknownBase { exists, .. } | push::Error::UnknownUnderlay { exists, .. })
        | Error::UnknownRule { exists, .. } = self
        {
            problem.exists = exists.clone();
        }
        if let Some(
            choreographer::Error::UnknownServant { exists, .. }
            | choreographer::Error::Terms(TermsError::UnknownClass { exists, .. }),
        ) = self.choreographer_error()
        {
            problem.exists = exists.clone();
        }
        if let Some(
            catalogue::Error::UnknownService { exists, .. }
            | catalogue::Error::UnknownRevision { exists, .. }
            | catalogue::Error::UnknownArchitecture { exists, .. },
        ) = self.catalogue_error()
        {
            problem.exists = exists.clone();
        }
        if let Some(log) = self.log() {
            problem.log = log.to_vec();
        }
        let again = [StatusCode::SERVICE_UNAVAILABLE, StatusCode::TOO_MANY_REQUESTS];
        let after = match (self, self.choreographer_error()) {
            (Error::Unrecognised(AuthenticationError::Slowed(left) | AuthenticationError::SlowedSignIn(left)), _) => {
                left.div_ceil(1000)
            }
            (_, Some(choreographer::Error::BackOff { again, .. })) => choreographer::seconds(*again),
            (Error::RecordedLately { again, .. }, _) => *again,
            _ => DEFAULT_RETRY_DELAY,
        };
        problem.retry_after = again.contains(&status).then_some(after);
        problem
    }

    /// Returns the choreographer's error that this error wraps, if any.
    fn choreographer_error(&self) -> Option<&choreographer::Error> {
        match self {
            Error::Choreographer(error) | Error::Push(push::Error::Choreographer(error)) => Some(error),
            _ => None,
        }
    }

    /// Returns the catalogue's error that this error wraps, if any.
    fn catalogue_error(&self) -> Option<&catalogue::Error> {
        match self {
            Error::Catalogue(error) | Error::Push(push::Error::Catalogue(error)) => Some(error),
            _ => match self.choreographer_error()? {
                choreographer::Error::Catalogue(error) => Some(error),
                _ => None,
            },
        }
    }

    /// Returns the log that explains the error, if any.
    fn log(&self) -> Option<&[String]> {
        match self {
            Error::Push(push::Error::Failed { log, .. }) => Some(log),
            _ => match self.choreographer_error()? {
                choreographer::Error::Servant { log, .. } => Some(log),
                _ => None,
            },
        }
    }

    fn kind(&self) -> Kind {
        use StatusCode as S;
        match self {
            Error::UnknownRobot { .. } => (S::NOT_FOUND, "unknown-robot", "unknown robot"),
            Error::UnknownRow { .. } => (S::NOT_FOUND, "unknown-row", "unknown entry"),
            Error::UnknownPath { .. } => (S::NOT_FOUND, "unknown-path", "not found"),
            Error::OtherMethod { .. } => (S::METHOD_NOT_ALLOWED, "other-method", "method not supported"),
            Error::BodyTooLarge { .. } | Error::TrialTooLarge { .. } => {
                (S::PAYLOAD_TOO_LARGE, "too-large", "body too large")
            }
            Error::Memory(_) => (S::SERVICE_UNAVAILABLE, "memory", "not enough memory"),
            Error::Unfinished { .. } => (S::REQUEST_TIMEOUT, "unfinished", "body incomplete"),
            Error::BadRequest(_) => (S::BAD_REQUEST, "bad-request", "bad request"),
            Error::Unstatable(_) => (S::BAD_REQUEST, "unstatable", "invalid terms"),
            Error::WebSocketVersion => (S::UPGRADE_REQUIRED, "websocket-version", "WebSocket version not supported"),
            Error::Unrecognised(AuthenticationError::Slowed(_)) => {
                (S::TOO_MANY_REQUESTS, "guessing", "too many unknown tokens")
            }
            Error::Unrecognised(AuthenticationError::SlowedSignIn(_)) => {
                (S::TOO_MANY_REQUESTS, "guessing", "too many wrong passwords")
            }
            Error::Unrecognised(AuthenticationError::SessionOver) => (S::UNAUTHORIZED, "unauthorised", "session ended"),
            Error::WrongPassword => (S::UNAUTHORIZED, "wrong-password", "sign-in failed"),
            Error::TooManyStreams { .. } => (S::TOO_MANY_REQUESTS, "too-many-streams", "too many streams"),
            Error::TooManyLook { .. } => (S::TOO_MANY_REQUESTS, "too-many-look", "too many connections inside"),
            Error::NotThereYet(_) => (S::CONFLICT, "not-ready", "not ready"),
            Error::NotRunning(_) => (S::CONFLICT, "not-running", "not running"),
            Error::ExecOff => (S::FORBIDDEN, "exec-off", "not allowed"),
            Error::TooManyExecs { .. } => (S::TOO_MANY_REQUESTS, "too-many-execs", "too many programs in servants"),
            Error::NoBlackBox(_) => (S::CONFLICT, "no-black-box", "no ring-buffer recording"),
            Error::UnknownRecording(_) => (S::NOT_FOUND, "unknown-recording", "unknown recording"),
            Error::UnknownPush(_) => (S::NOT_FOUND, "unknown-push", "unknown push"),
            Error::PushNotCancelled { .. } => (S::CONFLICT, "not-cancelled", "push not cancelled"),
            Error::NotRecorded { .. } => (S::INSUFFICIENT_STORAGE, "not-recorded", "not recorded"),
            Error::RecordedLately { .. } => (S::TOO_MANY_REQUESTS, "recorded-lately", "already recorded"),
            Error::SignInBusy | Error::Provider(oidc::Error::Busy) => {
                (S::SERVICE_UNAVAILABLE, "busy", "too many sign-ins")
            }
            Error::NoProvider => (S::NOT_FOUND, "no-provider", "no identity provider"),
            Error::NoRole { .. } => (S::FORBIDDEN, "no-role", "not allowed"),
            Error::Provider(error) => kind_of_provider(error),
            Error::Unauthorised(_) | Error::Unrecognised(_) => (S::UNAUTHORIZED, "unauthorised", "token needed"),
            Error::Uncertified(_) => (S::UNAUTHORIZED, "unpaired", "robot not paired"),
            Error::Uncoded(_) => (S::UNAUTHORIZED, "pairing-code", "no pairing"),
            Error::Uncertifiable(authority::Error::Unmade { .. } | authority::Error::Io { .. }) => INTERNAL,
            Error::Uncertifiable(authority::Error::TooLong(_)) => (S::PAYLOAD_TOO_LARGE, "too-large", "body too large"),
            Error::Uncertifiable(_) => (S::BAD_REQUEST, "no-request", "invalid certificate request"),
            Error::UnknownPairing { .. } => (S::NOT_FOUND, "unknown-pairing", "unknown robot"),
            Error::UnknownAccount { .. } => (S::NOT_FOUND, "unknown-account", "unknown account"),
            Error::AccountExists(_) => (S::CONFLICT, "account-exists", "name taken"),
            Error::PairingExists(_) => (S::CONFLICT, "pairing-exists", "name taken"),
            Error::PlainText { .. } => (S::BAD_REQUEST, "plain-text", "https required"),
            Error::Foreign { .. } => (S::FORBIDDEN, "foreign", "request from another site"),
            Error::Forbidden { .. } => (S::FORBIDDEN, "forbidden", "not allowed"),
            Error::UnknownToken { .. } => (S::NOT_FOUND, "unknown-token", "unknown token"),
            Error::TokenExists(_) => (S::CONFLICT, "token-exists", "name taken"),
            Error::UnknownRule { .. } => (S::NOT_FOUND, "unknown-rule", "unknown rule"),
            Error::RobotTaken(_) => (S::FORBIDDEN, "robot-taken", "robot name taken"),
            Error::Push(error) => kind_of_push(error),
            Error::Choreographer(error) => kind_of_choreographer(error),
            Error::Catalogue(error) => kind_of_catalogue(error),
            Error::State(_) | Error::Image(_) | Error::Internal(_) => INTERNAL,
        }
    }
}

fn kind_of_provider(error: &oidc::Error) -> Kind {
    use StatusCode as S;
    use oidc::Error as O;
    match error {
        O::Unreachable { .. } | O::Client { .. } | O::NoAddress(_) => {
            (S::BAD_GATEWAY, "provider", "identity provider failed")
        }
        O::Busy => (S::SERVICE_UNAVAILABLE, "busy", "too many sign-ins"),
        O::UnknownState | O::OtherBrowser => (S::BAD_REQUEST, "sign-in", "sign-in failed"),
        O::Denied { .. } => (S::FORBIDDEN, "denied", "sign-in failed"),
        O::Code { .. } | O::Token { .. } => (S::UNAUTHORIZED, "sign-in", "sign-in failed"),
    }
}

fn kind_of_push(error: &push::Error) -> Kind {
    use StatusCode as S;
    use push::Error as P;
    match error {
        P::NotAllowed(_) => (S::FORBIDDEN, "forbidden", "not allowed"),
        P::NameTaken { .. } => (S::CONFLICT, "name-taken", "name taken"),
        P::Options(_) => (S::BAD_REQUEST, "bad-request", "bad request"),
        P::UnknownBase { .. } => (S::NOT_FOUND, "unknown-base", "unknown base"),
        P::UnknownUnderlay { .. } => (S::NOT_FOUND, "unknown-underlay", "unknown underlay"),
        P::UnderlayInUse { .. } => (S::CONFLICT, "underlay-in-use", "underlay in use"),
        P::BaseExists(_) => (S::CONFLICT, "base-exists", "base exists"),
        P::BaseNotImported(_) => (S::CONFLICT, "base-not-imported", "base not imported"),
        P::BaseNotSetUp(_) => (S::CONFLICT, "base-not-set-up", "base not set up"),
        P::Failed { .. } => (S::UNPROCESSABLE_ENTITY, "push-failed", "push failed"),
        P::TooLarge { .. } => (S::PAYLOAD_TOO_LARGE, "too-large", "archive too large"),
        P::Ending => ENDING,
        P::Cancelled => (S::CONFLICT, "push-cancelled", "push cancelled"),
        P::Choreographer(error) => kind_of_choreographer(error),
        P::Catalogue(error) => kind_of_catalogue(error),
        P::Engine(error) => kind_of_engine(error),
        P::State(_) | P::Image(_) | P::UnderlayRecord { .. } | P::Internal(_) => INTERNAL,
    }
}

fn kind_of_choreographer(error: &choreographer::Error) -> Kind {
    use StatusCode as S;
    use choreographer::Error as C;
    match error {
        C::UnknownServant { .. } => (S::NOT_FOUND, "unknown-servant", "unknown servant"),
        C::Full(AdmissionError::TooBig { .. }) => (S::UNPROCESSABLE_ENTITY, "too-big", "does not fit"),
        C::Full(_) => (S::SERVICE_UNAVAILABLE, "full", "no capacity"),
        C::Terms(untenable) => kind_of_terms(untenable),
        C::NotResized { reason, .. } => match &**reason {
            ResizeError::Untenable(untenable) => kind_of_terms(untenable),
            ResizeError::Full(_) => (S::SERVICE_UNAVAILABLE, "full", "no capacity"),
            ResizeError::Used { .. } => (S::CONFLICT, "in-use", "more memory in use"),
            ResizeError::Many => (S::CONFLICT, "too-many", "too many stubs with terms"),
        },
        C::Place { .. } => (S::CONFLICT, "place", "no container"),
        C::Servant { .. } => (S::BAD_GATEWAY, "servant-failed", "servant failed"),
        C::NoRollout(_) => (S::NOT_FOUND, "no-rollout", "no rollout"),
        C::Rollout(_) => (S::CONFLICT, "rollout", "no such rollout"),
        C::BackOff { .. } => (S::SERVICE_UNAVAILABLE, "back-off", "servant keeps failing"),
        C::Ending => ENDING,
        C::Catalogue(error) => kind_of_catalogue(error),
        C::Engine(error) => kind_of_engine(error),
        C::OutOfMemory { .. } => (S::UNPROCESSABLE_ENTITY, "out-of-memory", "out of memory"),
        C::Calibration(_) | C::Shadow(_) | C::Reach(reach::Error::Trial(_) | reach::Error::Linked(_)) => {
            (S::BAD_REQUEST, "bad-request", "bad request")
        }
        C::Reach(_) => (S::BAD_GATEWAY, "servant-failed", "servant failed"),
        C::State(_) | C::Internal(_) => INTERNAL,
    }
}

fn kind_of_terms(untenable: &TermsError) -> Kind {
    use StatusCode as S;
    match untenable {
        TermsError::UnknownClass { .. } => (S::BAD_REQUEST, "unknown-class", "unknown class"),
        TermsError::Capped { .. } | TermsError::Beyond { .. } => (S::FORBIDDEN, "capped", "more than allowed"),
        TermsError::Unmet { .. } => (S::UNPROCESSABLE_ENTITY, "unmet", "SLA cannot be met"),
    }
}

fn kind_of_engine(error: &servant::Error) -> Kind {
    match error {
        servant::Error::Grant(_) => (StatusCode::FORBIDDEN, "not-granted", "not granted"),
        servant::Error::Refused { .. } => (StatusCode::CONFLICT, "refused", "servant refused"),
        _ => INTERNAL,
    }
}

fn kind_of_catalogue(error: &catalogue::Error) -> Kind {
    use StatusCode as S;
    use catalogue::Error as C;
    match error {
        C::UnknownService { .. } => (S::NOT_FOUND, "unknown-service", "unknown service"),
        C::UnknownRevision { .. } => (S::NOT_FOUND, "unknown-revision", "unknown revision"),
        C::UnknownImage { .. } => (S::NOT_FOUND, "unknown-image", "unknown image"),
        C::NoStub { .. } => (S::UNPROCESSABLE_ENTITY, "no-stub", "no stub"),
        C::NoTwins { .. } => (S::UNPROCESSABLE_ENTITY, "no-twin", "types without an equivalent in the other ROS"),
        C::UnknownArchitecture { .. } => (S::NOT_FOUND, "unknown-architecture", "unknown architecture"),
        C::Name(NameError::Reserved(_)) => (S::CONFLICT, "reserved-name", "reserved name"),
        C::Name(_) => (S::BAD_REQUEST, "bad-name", "invalid name"),
        C::Inventory(_) => (S::UNPROCESSABLE_ENTITY, "push-failed", "push failed"),
        C::State(_) | C::Image(_) | C::Internal(_) => INTERNAL,
    }
}

impl IntoResponse for Error {
    fn into_response(self) -> Response {
        let mut response = respond(&self.problem());
        if let Error::WebSocketVersion = self {
            // RFC 6455, section 4.4.
            let headers = response.headers_mut();
            headers.insert(header::UPGRADE, HeaderValue::from_static("websocket"));
            headers.insert(header::SEC_WEBSOCKET_VERSION, HeaderValue::from_static("13"));
        }
        response
    }
}

/// Builds the HTTP response of a problem.
pub fn respond(problem: &Problem) -> Response {
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    if status.is_server_error() && status != StatusCode::SERVICE_UNAVAILABLE {
        tracing::error!("answered {status}: {problem}");
    }
    let mut body = serde_json::to_vec_pretty(problem).unwrap_or_default();
    body.push(b'\n');
    let mut response = (status, [(header::CONTENT_TYPE, PROBLEM_JSON)], body).into_response();
    if let Some(seconds) = problem.retry_after {
        response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    if status == StatusCode::UNAUTHORIZED {
        response.headers_mut().insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    // Where clients read another format, the registry's, the problem is translated.
    response.extensions_mut().insert(problem.clone());
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refusal(refused: AdmissionError) -> Error {
        choreographer::Error::from(refused).into()
    }

    #[test]
    fn an_unknown_service_lists_those_that_exist() {
        let error = catalogue::Error::UnknownService { name: "nope".into(), exists: vec!["opencv_apps".into()] };
        let problem = Error::from(error).problem();
        assert_eq!((problem.status, problem.kind.as_str()), (404, "urn:cloudroid:unknown-service"));
        assert!(problem.detail.contains("nope"), "{problem:?}");
        assert_eq!(problem.exists, ["opencv_apps"]);
        assert!(problem.next.is_some());
    }

    #[test]
    fn a_full_machine_says_when_to_come_again() {
        let response = refusal(AdmissionError::QueueFull { waiting: 3 }).into_response();
        assert_eq!(response.status(), 503);
        assert_eq!(response.headers()[header::RETRY_AFTER], "10");
        assert_eq!(response.headers()[header::CONTENT_TYPE], PROBLEM_JSON);
    }

    #[test]
    fn what_can_never_fit_is_not_to_be_tried_again() {
        let amount = choreographer::Amount::new(64.0, 1);
        let problem = refusal(AdmissionError::TooBig { wanted: amount, capacity: amount }).problem();
        assert_eq!((problem.status, problem.retry_after), (422, None));
        assert!(problem.detail.contains("64 cores"), "{problem:?}");
    }

    #[test]
    fn a_reserved_name_says_so() {
        let reserved = catalogue::Error::from(NameError::Reserved("api".into()));
        let problem = Error::from(reserved).problem();
        assert_eq!(problem.status, 409);
        assert!(problem.detail.contains("reserved") && problem.detail.contains("api"), "{problem:?}");
    }

    #[test]
    fn who_sends_too_much_or_at_the_wrong_time_is_told_what_to_do() {
        let after = std::time::Duration::from_secs(300);
        let limit = api::Size(1 << 20);
        for (error, word) in [
            (Error::BodyTooLarge { limit }, "send less"),
            (Error::TrialTooLarge { limit }, "[memory]"),
            (Error::Unfinished { after }, "raise unfinished"),
            (Error::Choreographer(choreographer::Error::Ending), "has restarted"),
        ] {
            let problem = error.problem();
            let next = problem.next.as_deref().unwrap_or_default();
            assert!(next.contains(word), "{problem:?}");
        }
    }

    #[test]
    fn a_missing_token_names_the_ways_to_give_one() {
        let response = Error::Unauthorised("a token is needed").into_response();
        assert_eq!(response.status(), 401);
        assert_eq!(response.headers()[header::WWW_AUTHENTICATE], "Bearer");
    }

    #[test]
    fn who_guesses_is_told_when_to_come_again() {
        let response = Error::from(AuthenticationError::Slowed(3_001)).into_response();
        assert_eq!(response.status(), 429);
        assert_eq!(response.headers()[header::RETRY_AFTER], "4");
    }

    #[test]
    fn the_last_line_that_says_something_is_told() {
        let log = ["loading".to_owned(), "no map file".to_owned(), " ".to_owned()];
        assert_eq!(with_last_log_line("it ended", &log), "it ended; its log ends with: no map file");
        assert_eq!(with_last_log_line("it ended", &[]), "it ended");
    }
}
