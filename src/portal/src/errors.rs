//! Every refusal of the HTTP API, and the problem details (RFC 9457) that each becomes.

use api::Problem;
use api::problem::PROBLEM_JSON;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use catalogue::names::NameError;
use choreographer::{Refused, Unchanged, Untenable, with_last_words};

use crate::principals::{Uncertified, Uncoded, Unrecognised};

mod next;

/// Why a request is refused.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No robot of that name is served, or was lately.
    #[error("robot {name:?} is not served, and nothing is known of it")]
    UnknownRobot {
        /// Asked for.
        name: String,
        /// Those that are served.
        exists: Vec<String>,
    },
    /// No such row of a service's dictionary.
    #[error("the dictionary of {service} has no row {id:?}")]
    UnknownRow {
        /// The service.
        service: String,
        /// Asked for.
        id: String,
        /// Names that exist.
        exists: Vec<String>,
    },
    /// Nothing is served there.
    #[error("nothing is served at {path}")]
    UnknownPath {
        /// Asked for.
        path: String,
    },
    /// Something is served there, by other methods.
    #[error("{method} is not answered at {path}")]
    OtherMethod {
        /// Asked with.
        method: String,
        /// Asked for.
        path: String,
    },
    /// Something in the request is not what it should be.
    #[error("{0}")]
    BadRequest(String),
    /// What a robot states cannot be.
    #[error("{0}")]
    Unstatable(api::sla::Unstatable),
    /// A WebSocket handshake of another version than 13.
    #[error("this is no WebSocket handshake: Sec-WebSocket-Version is not 13")]
    WebSocketVersion,
    /// No token.
    #[error("{0}")]
    Unauthorised(&'static str),
    /// A token that lets nobody in.
    #[error(transparent)]
    Unrecognised(#[from] Unrecognised),
    /// A certificate that lets nobody in.
    #[error(transparent)]
    Uncertified(#[from] Uncertified),
    /// A pairing code that pairs nobody.
    #[error(transparent)]
    Uncoded(#[from] Uncoded),
    /// A certificate that is not made.
    #[error(transparent)]
    Uncertifiable(authority::Error),
    /// The robot is not paired, and no code waits for it.
    #[error("no robot {name:?} is paired, and no pairing code waits for one")]
    UnknownPairing {
        /// Asked for.
        name: String,
        /// Those that there are.
        exists: Vec<String>,
    },
    /// HTTP without TLS, where TLS is spoken.
    #[error("this port speaks https, and this request came as plain text")]
    PlainText {
        /// The address to ask instead.
        instead: String,
    },
    /// The request comes from a page that is not ours, or is addressed to another host.
    #[error("{what}")]
    Foreign {
        /// What was wrong.
        what: String,
        /// The next step.
        next: String,
    },
    /// The policy does not allow it.
    #[error("{what}")]
    Forbidden {
        /// Who may not do what.
        what: String,
    },
    /// No token of that name, or it was revoked.
    #[error("there is no token {name:?} that could be used")]
    UnknownToken {
        /// Asked for.
        name: String,
        /// Those that there are.
        exists: Vec<String>,
    },
    /// The name is another token's.
    #[error("there is a token {0:?} already")]
    TokenExists(String),
    /// No account of that name.
    #[error("there is no account {name:?}")]
    UnknownAccount {
        /// Asked for.
        name: String,
        /// Those that there are.
        exists: Vec<String>,
    },
    /// The name is another account's.
    #[error("there is an account {0:?} already")]
    AccountExists(String),
    /// The name is that of a robot that is paired, or for which a code waits.
    #[error("there is a robot {0:?} already, which is paired or is to be")]
    PairingExists(String),
    /// The password is wrong, or there is no such account: which of both is not said.
    #[error("name or password is wrong")]
    WrongPassword,
    /// No identity provider is configured.
    #[error("no identity provider knows people here")]
    NoProvider,
    /// The identity provider, or what came from it.
    #[error(transparent)]
    Provider(#[from] oidc::Error),
    /// Somebody has signed in who may nothing here.
    #[error("{who} has signed in, and none of its groups has a role here: {has}")]
    NoRole {
        /// By what it would be known here.
        who: String,
        /// The groups that it has.
        has: String,
    },
    /// Too many sign in at once.
    #[error("too many people sign in at once")]
    SignInBusy,
    /// One has more streams open than one may.
    #[error("{most} streams are open already, as many as one may have")]
    TooManyStreams {
        /// So many.
        most: usize,
    },
    /// A servant is looked into by as many as may.
    #[error(
        "servant {servant} is looked into by as many as may at once: {most}, and {each} of each"
    )]
    TooManyLook {
        /// Which.
        servant: String,
        /// So many, all together.
        most: usize,
        /// So many of each principal.
        each: usize,
    },
    /// A servant's ROS is not there yet, or not any more.
    #[error("nobody can look into servant {0}: it is starting, or ending")]
    NotThereYet(String),
    /// No black box listens to the servant.
    #[error("nothing of servant {0} is kept")]
    NoBlackBox(String),
    /// No such file.
    #[error("there is no recording {0}")]
    UnknownRecording(String),
    /// A file of a servant's last seconds is not written.
    #[error("the last seconds of servant {servant} are not recorded: {reason}")]
    NotRecorded {
        /// Whose.
        servant: String,
        /// Why.
        reason: String,
    },
    /// A file of a servant's last seconds was taken a moment ago.
    #[error("the last seconds of servant {servant} were recorded a moment ago")]
    RecordedLately {
        /// Whose.
        servant: String,
        /// In so many seconds again.
        again: u64,
    },
    /// No such rule of the policy.
    #[error("the policy has no rule {id:?}")]
    UnknownRule {
        /// Asked for.
        id: String,
        /// Those that there are.
        exists: Vec<String>,
    },
    /// Another token owns the robot's name.
    #[error("the robot name {0:?} belongs to another token")]
    RobotTaken(String),
    /// A body is too big.
    #[error("the body is bigger than {limit}")]
    BodyTooLarge {
        /// What is allowed.
        limit: api::Size,
    },
    /// What a service is tried with is too big.
    #[error("the recording or picture is bigger than {limit}")]
    TrialTooLarge {
        /// What is allowed.
        limit: api::Size,
    },
    /// A body does not fit into its sender's memory budget.
    #[error("there is no memory for the body: {0}")]
    Memory(#[from] budget::Exceeded),
    /// A body is not complete in time.
    #[error("the body is not complete after {} s", after.as_secs())]
    Unfinished {
        /// The time that it may take.
        after: std::time::Duration,
    },
    /// Pushes.
    #[error(transparent)]
    Push(#[from] push::Error),
    /// Servants.
    #[error(transparent)]
    Choreographer(#[from] choreographer::Error),
    /// What is published.
    #[error(transparent)]
    Catalogue(#[from] catalogue::Error),
    /// The state database.
    #[error(transparent)]
    State(#[from] store::Error),
    /// The image store.
    #[error("the image store: {0}")]
    Image(#[from] image::Error),
    /// A task of the daemon broke.
    #[error("the daemon failed at {0}; its log says more")]
    Internal(&'static str),
}

impl Error {
    /// What happened and, where a log explains it, its last line: for a status message.
    pub fn in_a_line(&self) -> String {
        match self.log() {
            Some(log) => with_last_words(&self.to_string(), log),
            None if self.is_of_terms() => {
                format!("{self}; {}", self.next())
            }
            None => self.to_string(),
        }
    }
}

impl From<access::Refusal> for Error {
    fn from(refusal: access::Refusal) -> Error {
        Error::Forbidden {
            what: refusal.to_string(),
        }
    }
}

impl Error {
    /// Whether a robot is refused for as long as it asks for the same, on a machine of this configuration: for what it states, or since
    /// its servant fits on no machine that is empty.
    pub fn is_final(&self) -> bool {
        use choreographer::Error as C;
        let error = self.of_choreographer();
        matches!(error, Some(C::Terms(_) | C::Full(Refused::TooBig { .. })))
            || matches!(error, Some(C::NotResized { reason, .. }) if !matches!(&**reason, Unchanged::Full(_)))
    }

    /// Whether a robot is refused for what it states: then it is told in one line what it could.
    fn is_of_terms(&self) -> bool {
        matches!(
            self.of_choreographer(),
            Some(choreographer::Error::Terms(_) | choreographer::Error::NotResized { .. })
        )
    }
}

/// Seconds after which a full machine may be asked again.
const RETRY_AFTER: u64 = 10;

/// Status, kind and title of a problem.
type Kind = (StatusCode, &'static str, &'static str);

const INTERNAL: Kind = (
    StatusCode::INTERNAL_SERVER_ERROR,
    "internal",
    "the daemon failed",
);
const ENDING: Kind = (StatusCode::SERVICE_UNAVAILABLE, "ending", "daemon ending");

impl Error {
    /// The problem that a client is told.
    pub fn problem(&self) -> Problem {
        let (status, kind, title) = self.kind();
        let mut problem = Problem {
            kind: format!("urn:cloudroid:{kind}"),
            title: title.to_owned(),
            status: status.as_u16(),
            detail: self.to_string(),
            next: Some(self.next()),
            ..Problem::default()
        };
        if let Error::UnknownRobot { exists, .. }
        | Error::UnknownRow { exists, .. }
        | Error::UnknownToken { exists, .. }
        | Error::UnknownPairing { exists, .. }
        | Error::UnknownAccount { exists, .. }
        | Error::UnknownRule { exists, .. } = self
        {
            problem.exists = exists.clone();
        }
        if let Some(
            choreographer::Error::UnknownServant { exists, .. }
            | choreographer::Error::Terms(Untenable::UnknownClass { exists, .. }),
        ) = self.of_choreographer()
        {
            problem.exists = exists.clone();
        }
        if let Some(
            catalogue::Error::UnknownService { exists, .. }
            | catalogue::Error::UnknownRevision { exists, .. }
            | catalogue::Error::UnknownArchitecture { exists, .. },
        ) = self.of_catalogue()
        {
            problem.exists = exists.clone();
        }
        if let Some(log) = self.log() {
            problem.log = log.to_vec();
        }
        let again = [
            StatusCode::SERVICE_UNAVAILABLE,
            StatusCode::TOO_MANY_REQUESTS,
        ];
        let after = match (self, self.of_choreographer()) {
            (
                Error::Unrecognised(Unrecognised::Slowed(left) | Unrecognised::SlowedSignIn(left)),
                _,
            ) => left.div_ceil(1000),
            (_, Some(choreographer::Error::BackOff { again, .. })) => {
                choreographer::seconds(*again)
            }
            (Error::RecordedLately { again, .. }, _) => *again,
            _ => RETRY_AFTER,
        };
        problem.retry_after = again.contains(&status).then_some(after);
        problem
    }

    /// The refusal of the choreographer that it passes on.
    fn of_choreographer(&self) -> Option<&choreographer::Error> {
        match self {
            Error::Choreographer(error) | Error::Push(push::Error::Choreographer(error)) => {
                Some(error)
            }
            _ => None,
        }
    }

    /// The refusal of the catalogue that it passes on.
    fn of_catalogue(&self) -> Option<&catalogue::Error> {
        match self {
            Error::Catalogue(error) | Error::Push(push::Error::Catalogue(error)) => Some(error),
            _ => match self.of_choreographer()? {
                choreographer::Error::Catalogue(error) => Some(error),
                _ => None,
            },
        }
    }

    /// The log that explains it.
    fn log(&self) -> Option<&[String]> {
        match self {
            Error::Push(push::Error::Failed { log, .. }) => Some(log),
            _ => match self.of_choreographer()? {
                choreographer::Error::Servant { log, .. } => Some(log),
                _ => None,
            },
        }
    }

    fn kind(&self) -> Kind {
        use StatusCode as S;
        match self {
            Error::UnknownRobot { .. } => (S::NOT_FOUND, "unknown-robot", "unknown robot"),
            Error::UnknownRow { .. } => (S::NOT_FOUND, "unknown-row", "unknown row"),
            Error::UnknownPath { .. } => (S::NOT_FOUND, "unknown-path", "nothing there"),
            Error::OtherMethod { .. } => {
                (S::METHOD_NOT_ALLOWED, "other-method", "method not answered")
            }
            Error::BodyTooLarge { .. } | Error::TrialTooLarge { .. } => {
                (S::PAYLOAD_TOO_LARGE, "too-large", "body too large")
            }
            Error::Memory(_) => (S::SERVICE_UNAVAILABLE, "memory", "no memory for it"),
            Error::Unfinished { .. } => (S::REQUEST_TIMEOUT, "unfinished", "body not complete"),
            Error::BadRequest(_) => (S::BAD_REQUEST, "bad-request", "bad request"),
            Error::Unstatable(_) => (S::BAD_REQUEST, "unstatable", "cannot be stated"),
            Error::WebSocketVersion => (
                S::UPGRADE_REQUIRED,
                "websocket-version",
                "other WebSocket version needed",
            ),
            Error::Unrecognised(Unrecognised::Slowed(_)) => {
                (S::TOO_MANY_REQUESTS, "guessing", "too many unknown tokens")
            }
            Error::Unrecognised(Unrecognised::SlowedSignIn(_)) => {
                (S::TOO_MANY_REQUESTS, "guessing", "too many wrong passwords")
            }
            Error::Unrecognised(Unrecognised::SessionOver) => {
                (S::UNAUTHORIZED, "unauthorised", "session over")
            }
            Error::WrongPassword => (S::UNAUTHORIZED, "wrong-password", "not signed in"),
            Error::TooManyStreams { .. } => {
                (S::TOO_MANY_REQUESTS, "too-many-streams", "too many streams")
            }
            Error::TooManyLook { .. } => (
                S::TOO_MANY_REQUESTS,
                "too-many-look",
                "too many look inside",
            ),
            Error::NotThereYet(_) => (S::CONFLICT, "not-ready", "not there yet"),
            Error::NoBlackBox(_) => (S::CONFLICT, "no-black-box", "nothing is kept"),
            Error::UnknownRecording(_) => (S::NOT_FOUND, "unknown-recording", "unknown recording"),
            Error::NotRecorded { .. } => (S::INSUFFICIENT_STORAGE, "not-recorded", "not recorded"),
            Error::RecordedLately { .. } => (
                S::TOO_MANY_REQUESTS,
                "recorded-lately",
                "recorded a moment ago",
            ),
            Error::SignInBusy | Error::Provider(oidc::Error::Busy) => {
                (S::SERVICE_UNAVAILABLE, "busy", "too many sign in")
            }
            Error::NoProvider => (S::NOT_FOUND, "no-provider", "no identity provider"),
            Error::NoRole { .. } => (S::FORBIDDEN, "no-role", "not allowed"),
            Error::Provider(error) => kind_of_provider(error),
            Error::Unauthorised(_) | Error::Unrecognised(_) => {
                (S::UNAUTHORIZED, "unauthorised", "token needed")
            }
            Error::Uncertified(_) => (S::UNAUTHORIZED, "unpaired", "robot not paired"),
            Error::Uncoded(_) => (S::UNAUTHORIZED, "pairing-code", "no pairing"),
            Error::Uncertifiable(authority::Error::Unmade { .. } | authority::Error::Io { .. }) => {
                INTERNAL
            }
            Error::Uncertifiable(authority::Error::TooLong(_)) => {
                (S::PAYLOAD_TOO_LARGE, "too-large", "body too large")
            }
            Error::Uncertifiable(_) => {
                (S::BAD_REQUEST, "no-request", "no request for a certificate")
            }
            Error::UnknownPairing { .. } => (S::NOT_FOUND, "unknown-pairing", "unknown robot"),
            Error::UnknownAccount { .. } => (S::NOT_FOUND, "unknown-account", "unknown account"),
            Error::AccountExists(_) => (S::CONFLICT, "account-exists", "name taken"),
            Error::PairingExists(_) => (S::CONFLICT, "pairing-exists", "name taken"),
            Error::PlainText { .. } => (S::BAD_REQUEST, "plain-text", "https is spoken here"),
            Error::Foreign { .. } => (S::FORBIDDEN, "foreign", "request from elsewhere"),
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
            (S::BAD_GATEWAY, "provider", "no answer of the provider")
        }
        O::Busy => (S::SERVICE_UNAVAILABLE, "busy", "too many sign in"),
        O::UnknownState | O::OtherBrowser => (S::BAD_REQUEST, "sign-in", "not signed in"),
        O::Denied { .. } => (S::FORBIDDEN, "denied", "not signed in"),
        O::Code { .. } | O::Token { .. } => (S::UNAUTHORIZED, "sign-in", "not signed in"),
    }
}

fn kind_of_push(error: &push::Error) -> Kind {
    use StatusCode as S;
    use push::Error as P;
    match error {
        P::NotAllowed(_) => (S::FORBIDDEN, "forbidden", "not allowed"),
        P::NameTaken { .. } => (S::CONFLICT, "name-taken", "name taken"),
        P::Options(_) => (S::BAD_REQUEST, "bad-request", "bad request"),
        P::Failed { .. } => (S::UNPROCESSABLE_ENTITY, "push-failed", "push failed"),
        P::TooLarge { .. } => (S::PAYLOAD_TOO_LARGE, "too-large", "archive too large"),
        P::Ending => ENDING,
        P::Choreographer(error) => kind_of_choreographer(error),
        P::Catalogue(error) => kind_of_catalogue(error),
        P::Engine(error) => kind_of_engine(error),
        P::State(_) | P::Image(_) | P::Internal(_) => INTERNAL,
    }
}

fn kind_of_choreographer(error: &choreographer::Error) -> Kind {
    use StatusCode as S;
    use choreographer::Error as C;
    match error {
        C::UnknownServant { .. } => (S::NOT_FOUND, "unknown-servant", "unknown servant"),
        C::Full(Refused::TooBig { .. }) => (S::UNPROCESSABLE_ENTITY, "too-big", "does not fit"),
        C::Full(_) => (S::SERVICE_UNAVAILABLE, "full", "no room"),
        C::Terms(untenable) => kind_of_terms(untenable),
        C::NotResized { reason, .. } => match &**reason {
            Unchanged::Untenable(untenable) => kind_of_terms(untenable),
            Unchanged::Full(_) => (S::SERVICE_UNAVAILABLE, "full", "no room"),
            Unchanged::Used { .. } => (S::CONFLICT, "in-use", "more is in use"),
            Unchanged::Many => (S::CONFLICT, "too-many", "too many state something"),
        },
        C::Place { .. } => (S::CONFLICT, "place", "no container"),
        C::Servant { .. } => (S::BAD_GATEWAY, "servant-failed", "servant failed"),
        C::NoRollout(_) => (S::NOT_FOUND, "no-rollout", "no rollout"),
        C::Rollout(_) => (S::CONFLICT, "rollout", "no such rollout"),
        C::BackOff { .. } => (
            S::SERVICE_UNAVAILABLE,
            "back-off",
            "servant fails again and again",
        ),
        C::Ending => ENDING,
        C::Catalogue(error) => kind_of_catalogue(error),
        C::Engine(error) => kind_of_engine(error),
        C::OutOfMemory { .. } => (S::UNPROCESSABLE_ENTITY, "out-of-memory", "out of memory"),
        C::Calibration(_)
        | C::Shadow(_)
        | C::Reach(reach::Error::Trial(_) | reach::Error::Linked(_)) => {
            (S::BAD_REQUEST, "bad-request", "bad request")
        }
        C::Reach(_) => (S::BAD_GATEWAY, "servant-failed", "servant failed"),
        C::State(_) | C::Internal(_) => INTERNAL,
    }
}

fn kind_of_terms(untenable: &Untenable) -> Kind {
    use StatusCode as S;
    match untenable {
        Untenable::UnknownClass { .. } => (S::BAD_REQUEST, "unknown-class", "unknown class"),
        Untenable::Capped { .. } | Untenable::Beyond { .. } => {
            (S::FORBIDDEN, "capped", "more than is allowed")
        }
        Untenable::Unmet { .. } => (S::UNPROCESSABLE_ENTITY, "unmet", "cannot be reached"),
    }
}

fn kind_of_engine(error: &servant::Error) -> Kind {
    match error {
        servant::Error::Grant(_) => (StatusCode::FORBIDDEN, "not-granted", "not granted"),
        servant::Error::Refused { .. } => (StatusCode::CONFLICT, "refused", "the servant refused"),
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
        C::UnknownArchitecture { .. } => {
            (S::NOT_FOUND, "unknown-architecture", "unknown architecture")
        }
        C::Name(NameError::Reserved(_)) => (S::CONFLICT, "reserved-name", "reserved name"),
        C::Name(_) => (S::BAD_REQUEST, "bad-name", "name not allowed"),
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
            headers.insert(
                header::SEC_WEBSOCKET_VERSION,
                HeaderValue::from_static("13"),
            );
        }
        response
    }
}

/// A problem as an HTTP answer.
pub fn respond(problem: &Problem) -> Response {
    let status = StatusCode::from_u16(problem.status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR);
    if status.is_server_error() && status != StatusCode::SERVICE_UNAVAILABLE {
        tracing::error!("answered {status}: {problem}");
    }
    let mut body = serde_json::to_vec_pretty(problem).unwrap_or_default();
    body.push(b'\n');
    let mut response = (status, [(header::CONTENT_TYPE, PROBLEM_JSON)], body).into_response();
    if let Some(seconds) = problem.retry_after {
        response
            .headers_mut()
            .insert(header::RETRY_AFTER, HeaderValue::from(seconds));
    }
    if status == StatusCode::UNAUTHORIZED {
        response
            .headers_mut()
            .insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
    }
    response
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(refused: Refused) -> Error {
        choreographer::Error::from(refused).into()
    }

    #[test]
    fn an_unknown_service_lists_those_that_exist() {
        let error = catalogue::Error::UnknownService {
            name: "nope".into(),
            exists: vec!["opencv_apps".into()],
        };
        let problem = Error::from(error).problem();
        assert_eq!(
            (problem.status, problem.kind.as_str()),
            (404, "urn:cloudroid:unknown-service")
        );
        assert!(problem.detail.contains("nope"), "{problem:?}");
        assert_eq!(problem.exists, ["opencv_apps"]);
        assert!(problem.next.is_some());
    }

    #[test]
    fn a_full_machine_says_when_to_come_again() {
        let response = refused(Refused::QueueFull { waiting: 3 }).into_response();
        assert_eq!(response.status(), 503);
        assert_eq!(response.headers()[header::RETRY_AFTER], "10");
        assert_eq!(response.headers()[header::CONTENT_TYPE], PROBLEM_JSON);
    }

    #[test]
    fn what_can_never_fit_is_not_to_be_tried_again() {
        let amount = choreographer::Amount::new(64.0, 1);
        let problem = refused(Refused::TooBig {
            wanted: amount,
            capacity: amount,
        })
        .problem();
        assert_eq!((problem.status, problem.retry_after), (422, None));
        assert!(problem.detail.contains("64 cores"), "{problem:?}");
    }

    #[test]
    fn a_reserved_name_says_so() {
        let reserved = catalogue::Error::from(NameError::Reserved("api".into()));
        let problem = Error::from(reserved).problem();
        assert_eq!(problem.status, 409);
        assert!(
            problem.detail.contains("reserved") && problem.detail.contains("api"),
            "{problem:?}"
        );
    }

    #[test]
    fn who_sends_too_much_or_at_the_wrong_time_is_told_what_to_do() {
        let after = std::time::Duration::from_secs(300);
        let limit = api::Size(1 << 20);
        for (error, word) in [
            (Error::BodyTooLarge { limit }, "send less"),
            (Error::TrialTooLarge { limit }, "[memory]"),
            (Error::Unfinished { after }, "raise unfinished"),
            (
                Error::Choreographer(choreographer::Error::Ending),
                "started again",
            ),
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
        let response = Error::from(Unrecognised::Slowed(3_001)).into_response();
        assert_eq!(response.status(), 429);
        assert_eq!(response.headers()[header::RETRY_AFTER], "4");
    }

    #[test]
    fn the_last_line_that_says_something_is_told() {
        let log = [
            "loading".to_owned(),
            "no map file".to_owned(),
            " ".to_owned(),
        ];
        assert_eq!(
            with_last_words("it ended", &log),
            "it ended; its log ends with: no map file"
        );
        assert_eq!(with_last_words("it ended", &[]), "it ended");
    }
}
