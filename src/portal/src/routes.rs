//! Every address that the portal answers, in one table: its method, who is answered there, its handler, and what the
//! OpenAPI document says of it. Router, guard and document are made of it.

#[cfg(test)]
mod matrix;

use ::access::Action;
use api::access;
use axum::extract::{DefaultBodyLimit, OriginalUri};
use axum::http::Method;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, any, delete, get, patch, post, put};

use std::sync::Arc;

use utoipa::openapi::Required;

use super::{
    App, api_v1, audit, calibration, dictionary, differences, events, goals, history, inside,
    machines, metrics, oci, openapi, page, people, policy, push, recordings, robots, shadow,
    stream, stubs, topics, viewers,
};
use crate::errors::Error;
use crate::openapi::{Operation, operation};

/// Who is answered where there are tokens.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Who may do this to that.
    May(Action, Of),
    /// Anyone who reads.
    Read,
    /// Who shows a pairing code.
    Code,
    /// Anyone who reads who is signed in, or signs in.
    SignIn,
    /// Any robot that connects: its first message must be rosbridge's `auth`.
    Connect,
    /// Anyone who reads, and any robot that connects.
    ReadOrConnect,
}

/// To what an address leads: the parameter that names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Of {
    /// The machine, or all services.
    Machine,
    /// A service.
    Service(&'static str),
    /// The service of a stub's archive.
    Stub(&'static str),
    /// The service of a servant.
    Servant(&'static str),
    /// A robot.
    Robot(&'static str),
    /// The service and the robot of a recording.
    Recording(&'static str),
    /// What the query or the body names: the handler decides.
    Handler,
}

use Access::{Code, Connect, May, Read, ReadOrConnect, SignIn};
use Action::{Deploy, Enter, Logs, Look, Operate, See, Try};

/// What each principal is told, as far as it may see it.
const ENTER: Access = May(Enter, Of::Machine);
/// The whole machine.
const LOOK: Access = May(Look, Of::Machine);
/// Pairings of robots.
const PAIR: Access = May(Action::Pair, Of::Machine);
/// Tokens and policy.
const ADMINISTER: Access = May(Action::Administer, Of::Machine);

/// To the service that `{name}` names.
const fn service(action: Action) -> Access {
    May(action, Of::Service("name"))
}

/// To the servant that `{id}` names.
const fn servant(action: Action) -> Access {
    May(action, Of::Servant("id"))
}

/// One method at one address.
pub struct Route {
    /// `GET`, …, or `ANY` where the handler tells methods apart. `GET` answers `HEAD`, too.
    pub method: &'static str,
    /// Its address as axum writes it; `{…}` is one segment.
    pub path: &'static str,
    /// Whom it answers.
    pub access: Access,
    /// Makes its handler.
    pub handler: fn() -> MethodRouter<Arc<App>>,
    /// What the OpenAPI document says of it.
    pub operation: Option<fn() -> Operation>,
}

const fn at(
    method: &'static str,
    path: &'static str,
    access: Access,
    handler: fn() -> MethodRouter<Arc<App>>,
) -> Route {
    assert!(
        names_its_object(path, access),
        "a row's address has no parameter of the name that its access says"
    );
    Route {
        method,
        path,
        access,
        handler,
        operation: None,
    }
}

/// Whether what is to be looked up is in the address. Where it is not, the program does not compile.
const fn names_its_object(path: &str, access: Access) -> bool {
    let May(
        _,
        Of::Service(name)
        | Of::Stub(name)
        | Of::Servant(name)
        | Of::Robot(name)
        | Of::Recording(name),
    ) = access
    else {
        return true;
    };
    let (path, name) = (path.as_bytes(), name.as_bytes());
    let mut start = 0;
    while start + name.len() + 2 <= path.len() {
        let mut same = path[start] == b'{' && path[start + 1 + name.len()] == b'}';
        let mut at = 0;
        while same && at < name.len() {
            same = path[start + 1 + at] == name[at];
            at += 1;
        }
        if same {
            return true;
        }
        start += 1;
    }
    false
}

impl Route {
    const fn described(self, operation: fn() -> Operation) -> Self {
        Route {
            operation: Some(operation),
            ..self
        }
    }

    /// Whether a path is one of its address, as it stands in the request.
    fn leads(&self, path: &str) -> bool {
        let mut segments = path.split('/');
        self.path.split('/').all(|expected| {
            segments.next().is_some_and(|segment| {
                segment == expected || (expected.starts_with('{') && !segment.is_empty())
            })
        }) && segments.next().is_none()
    }
}

/// Who is answered at a path: whom the first row says that leads there.
pub fn access(path: &str) -> Access {
    let row = ROUTES.iter().find(|route| route.leads(path));
    row.map_or(LOOK, |route| route.access)
}

/// All routes: a fixed address before those with a name in its place.
pub const ROUTES: &[Route] = &[
    at("ANY", "/", ReadOrConnect, || any(robots::root)),
    at("GET", "/healthz", Read, || get(api_v1::health)),
    at("GET", "/metrics", LOOK, || get(metrics::metrics)),
    at("ANY", "/assets", ENTER, || any(nothing)),
    at("GET", "/assets/{name}", Read, || get(page::asset)),
    at("ANY", "/api", ENTER, || any(nothing)),
    at("GET", "/api/v1/status", LOOK, || get(api_v1::status))
        .described(|| operation("status", "The daemon at a glance.").answers::<api::Status>()),
    at("GET", "/api/v1/doctor", LOOK, || get(api_v1::doctor)).described(|| {
        operation(
            "doctor",
            "What this machine needs, and whether it is there.",
        )
        .answers::<api::Doctor>()
    }),
    at("GET", "/api/v1/clock", ENTER, || get(api_v1::clock)).described(|| {
        operation(
            "clock",
            "The daemon's clock, for comparing another with it.",
        )
        .answers::<api::Clock>()
    }),
    at("GET", "/api/v1/events", ENTER, || get(events::events)).described(|| {
        operation("events", "The journal, oldest first.")
            .asks::<events::Which>()
            .lists::<api::Event>()
    }),
    at("GET", "/api/v1/events/follow", ENTER, || get(events::follow)).described(|| {
        operation(
            "followEvents",
            "The journal, oldest first, and what comes to it from now on. With since=N, none after N is missed.",
        )
        .asks::<events::Which>()
        .streams::<api::Event>()
    }),
    at("GET", "/api/v1/stream", ENTER, || get(stream::stream)).described(|| {
        operation(
            "stream",
            "Machine, services, servants and events as they change: an event snapshot, then events update.",
        )
        .sends::<api::stream::Update>()
    }),
    at("GET", "/api/v1/history/servants", ENTER, || {
        get(history::servants)
    })
    .described(|| {
        operation(
            "servantsHistory",
            "What servants did in the last day, those that have ended included: the last asked for first.",
        )
        .asks::<history::Whose>()
        .lists::<api::history::ServantHistory>()
    }),
    at("GET", "/api/v1/history/machine", LOOK, || get(history::machine)).described(|| {
        operation("machineHistory", "What the machine did in the last day.")
            .asks::<history::When>()
            .answers::<api::history::MachineHistory>()
    }),
    at("GET", "/api/v1/services", ENTER, || get(api_v1::services))
        .described(|| operation("services", "All services.").lists::<api::ServiceSummary>()),
    at("GET", "/api/v1/services/{name}", service(See), || {
        get(api_v1::service)
    })
    .described(|| {
        operation("service", "One service with its interface and revisions.")
            .answers::<api::ServiceDetail>()
    }),
    at("DELETE", "/api/v1/services/{name}", service(Deploy), || {
        delete(api_v1::remove_service)
    })
    .described(|| {
        operation(
            "removeService",
            "Removes the service, its servants, its images and its recordings.",
        )
        .answers::<api::Stopped>()
    }),
    at("GET", "/api/v1/services/{name}/interface", service(See), || {
        get(api_v1::interface)
    })
    .described(|| operation("interface", "The interface with all definitions.").answers_object()),
    at("GET", "/api/v1/services/{name}/record", service(Deploy), || {
        get(api_v1::record)
    })
    .described(|| {
        operation(
            "serviceRecord",
            "What of a revision is not in its image, for another server to publish both.",
        )
        .asks::<api_v1::OfRevision>()
        .answers_object()
    }),
    at("GET", "/api/v1/services/{name}/differences", service(See), || {
        get(differences::differences)
    })
    .described(|| {
        operation("differences", "What differs between two of its revisions.")
            .asks::<differences::Between>()
            .answers::<api::differences::Differences>()
    }),
    at("GET", "/api/v1/services/{name}/fit", service(See), || {
        get(api_v1::fit)
    })
    .described(|| {
        operation(
            "fit",
            "Whether one more servant would fit, what it would cost the others, and how many more would.",
        )
        .asks::<api_v1::Statement>()
        .answers::<api::Fit>()
    }),
    at("POST", "/api/v1/services/{name}/rollback", service(Deploy), || {
        post(api_v1::rollback)
    })
    .described(|| {
        operation("rollback", "Makes an earlier revision the current one.")
            .takes::<api::Rollback>(Required::False)
            .answers::<api::ServiceDetail>()
    }),
    at("GET", "/api/v1/services/{name}/rollout", service(See), || {
        get(api_v1::rollout)
    })
    .described(|| {
        operation("rollout", "How a service comes to its next revision.")
            .answers::<api::Rollout>()
    }),
    at("POST", "/api/v1/services/{name}/rollout", service(Deploy), || {
        post(api_v1::order_rollout)
    })
    .described(|| {
        operation(
            "orderRollout",
            "Begins a rollout, promotes its canary, or takes it back.",
        )
        .takes::<api::rollout::RolloutOrder>(Required::True)
        .answers::<api::Rollout>()
    }),
    at("POST", "/api/v1/services/{name}/trial", service(Try), || {
        post(api_v1::trial)
    })
    .described(|| {
        operation(
            "trial",
            "What a service makes of a recording (rosbag 2.0) or a picture (PNG), and how fast.",
        )
        .asks::<api_v1::With>()
        .takes_file(
            "application/octet-stream",
            "The recording or the picture.",
            Required::True,
        )
        .answers::<api::trial::Trial>()
    }),
    at("POST", "/api/v1/services/{name}/calibration", service(Try), || {
        post(calibration::calibration).layer(DefaultBodyLimit::disable())
    })
    .described(|| {
        operation(
            "calibrate",
            "Replays recorded requests at several limits and proposes rows of the dictionary; writes none. The last line is \
             done or error.",
        )
        .asks_json::<api::CalibrationOptions>("options", "What to measure, and with what.")
        .takes_file(
            "application/octet-stream",
            "A recording (rosbag 2.0), or pictures (PNG files, one behind the other); empty with live.",
            Required::False,
        )
        .streams::<api::CalibrationEvent>()
    }),
    at("POST", "/api/v1/services/{name}/shadow", service(Try), || {
        post(shadow::shadow)
    })
    .described(|| {
        operation(
            "shadow",
            "Gives a robot's requests to a candidate, too, which answers nobody, and compares the answers. The last line is done or \
             error.",
        )
        .takes::<api::ShadowOptions>(Required::True)
        .streams::<api::ShadowEvent>()
    }),
    at("GET", "/api/v1/services/{name}/sla", service(See), || {
        get(dictionary::rows)
    })
    .described(|| {
        operation(
            "dictionary",
            "Rows of the service's dictionary: what a measure of an SLA costs.",
        )
        .lists::<api::dictionary::Row>()
    }),
    at("PUT", "/api/v1/services/{name}/sla", service(Deploy), || {
        put(dictionary::write)
    })
    .described(|| {
        operation("writeDictionary", "Writes rows, all or none.")
            .takes::<api::dictionary::NewRows>(Required::True)
            .lists::<api::dictionary::Row>()
    }),
    at("GET", "/api/v1/services/{name}/sla/explain", service(See), || {
        get(dictionary::explain)
    })
    .described(|| {
        operation(
            "explainSla",
            "What a robot would get that states this, and why. Auxiliary parameters are aux.KEY=VALUE.",
        )
        .asks::<dictionary::Stating>()
        .answers::<api::dictionary::Explained>()
    }),
    at("DELETE", "/api/v1/services/{name}/sla/{id}", service(Deploy), || {
        delete(dictionary::remove)
    })
    .described(|| {
        operation("removeFromDictionary", "Removes a row; gives those that are left.")
            .lists::<api::dictionary::Row>()
    }),
    at("GET", "/api/v1/servants", ENTER, || get(api_v1::servants))
        .described(|| operation("servants", "All servants.").lists::<api::Servant>()),
    at("DELETE", "/api/v1/servants", May(Operate, Of::Handler), || {
        delete(api_v1::stop_servants)
    })
    .described(|| {
        operation(
            "stopServants",
            "Ends all servants, or those of one service.",
        )
        .asks::<api_v1::OfService>()
        .answers::<api::Stopped>()
    }),
    at("GET", "/api/v1/servants/{id}", servant(See), || {
        get(api_v1::servant)
    })
    .described(|| operation("servant", "One servant.").answers::<api::Servant>()),
    at("PATCH", "/api/v1/servants/{id}", servant(Operate), || {
        patch(api_v1::set_limits)
    })
    .described(|| {
        operation(
            "setLimits",
            "Changes the limits that are given, while the servant runs.",
        )
        .takes::<api::Limits>(Required::True)
        .answers::<api::Servant>()
    }),
    at("DELETE", "/api/v1/servants/{id}", servant(Operate), || {
        delete(api_v1::stop_servant)
    })
    .described(|| operation("stopServant", "Ends a servant.").answers::<api::Stopped>()),
    at("GET", "/api/v1/servants/{id}/logs", servant(Logs), || {
        get(api_v1::logs)
    })
    .described(|| {
        operation("logs", "What its nodes printed.")
            .asks::<api_v1::Part>()
            .streams::<api::LogLine>()
    }),
    at("GET", "/api/v1/servants/{id}/inside", servant(See), || {
        get(inside::inside)
    })
    .described(|| {
        operation("inside", "Looks into a servant: a WebSocket that speaks rosbridge beside its robot.")
            .becomes_a_websocket()
    }),
    at("GET", "/api/v1/servants/{id}/topics", servant(See), || {
        get(topics::topics)
    })
    .described(|| {
        operation(
            "topics",
            "What is published on each topic of a servant: a line each second. To count it, all of it is heard beside its robot.",
        )
        .streams::<api::topics::PublishedTopics>()
    }),
    at("GET", "/api/v1/servants/{id}/goals", servant(See), || {
        get(goals::goals)
    })
    .described(|| {
        operation("goals", "What became of the goals of a servant's actions, the newest first.")
            .lists::<api::goals::Goal>()
    }),
    at("POST", "/api/v1/servants/{id}/recording", servant(Operate), || {
        post(recordings::take)
    })
    .described(|| {
        operation("takeRecording", "Writes a file of what flowed in a servant in the last seconds.")
            .answers::<api::recordings::Recording>()
    }),
    at("GET", "/api/v1/recordings", ENTER, || get(recordings::list)).described(|| {
        operation("recordings", "Files of the last seconds of servants, the newest first.")
            .asks::<recordings::Which>()
            .lists::<api::recordings::Recording>()
    }),
    at("GET", "/api/v1/recordings/{number}", May(See, Of::Recording("number")), || {
        get(recordings::file)
    })
    .described(|| {
        operation("recording", "Such a file (MCAP).").answers_file("application/octet-stream")
    }),
    at("DELETE", "/api/v1/recordings/{number}", May(Operate, Of::Recording("number")), || {
        delete(recordings::remove)
    })
    .described(|| {
        operation("removeRecording", "Removes such a file; gives those that are left.")
            .lists::<api::recordings::Recording>()
    }),
    at("GET", "/api/v1/back-offs", ENTER, || get(api_v1::back_offs)).described(|| {
        operation(
            "backOffs",
            "Whose servants have failed again and again, and when each is started again at the earliest.",
        )
        .lists::<api::BackOff>()
    }),
    at("GET", "/api/v1/robots/{name}/explain", May(See, Of::Robot("name")), || {
        get(api_v1::explain)
    })
    .described(|| {
        operation(
            "explain",
            "Why a robot is slow, or on its local original, now.",
        )
        .answers::<api::explain::Explanation>()
    }),
    at("GET", "/api/v1/audit", ADMINISTER, || get(audit::audit)).described(|| {
        operation("audit", "Who did what to what from where, oldest first.")
            .asks::<audit::Which>()
            .streams::<access::Audited>()
    }),
    at("GET", "/api/v1/whoami", ENTER, || get(policy::whoami))
        .described(|| operation("whoami", "Who asks, as the daemon knows it.").answers::<access::Whoami>()),
    at("GET", "/api/v1/session", SignIn, || get(people::session)).described(|| {
        operation("session", "Who is signed in, if anybody is.").answers::<api::people::Session>()
    }),
    at("POST", "/api/v1/session", SignIn, || post(people::sign_in)).described(|| {
        operation("signIn", "Signs in by a password. The session is told by a cookie.")
            .takes::<api::people::SignIn>(Required::True)
            .answers::<api::people::Session>()
    }),
    at("DELETE", "/api/v1/session", ENTER, || delete(people::sign_out)).described(|| {
        operation("signOut", "Ends the session that is shown, or all of that person.")
            .asks::<people::Ending>()
            .answers_nothing()
    }),
    at("GET", "/api/v1/oidc/login", Read, || get(people::provider::login)).described(|| {
        operation("oidcLogin", "Sends a browser to the identity provider, where somebody signs in.")
            .asks::<people::provider::Beginning>()
            .leads_on()
    }),
    at("GET", "/api/v1/oidc/callback", Read, || get(people::provider::callback)).described(|| {
        operation("oidcCallback", "Signs in whoever comes back from the identity provider: its session is told by a cookie.")
            .asks::<people::provider::ComingBack>()
            .answers_page()
    }),
    at("GET", "/api/v1/sessions", ADMINISTER, || get(people::sessions)).described(|| {
        operation("sessions", "All sessions of people.").lists::<api::people::SessionLine>()
    }),
    at("GET", "/api/v1/accounts", ADMINISTER, || get(people::accounts)).described(|| {
        operation("accounts", "All accounts of people.").lists::<api::people::Account>()
    }),
    at("POST", "/api/v1/accounts", ADMINISTER, || post(people::create)).described(|| {
        operation("createAccount", "Makes an account; gives all there are.")
            .takes::<api::people::NewAccount>(Required::True)
            .lists::<api::people::Account>()
    }),
    at("PATCH", "/api/v1/accounts/{name}", ADMINISTER, || patch(people::change)).described(|| {
        operation("changeAccount", "Changes an account and ends its sessions; gives all there are.")
            .takes::<api::people::AccountChange>(Required::True)
            .lists::<api::people::Account>()
    }),
    at("DELETE", "/api/v1/accounts/{name}", ADMINISTER, || delete(people::remove)).described(|| {
        operation("removeAccount", "Removes an account and ends its sessions; gives those that are left.")
            .lists::<api::people::Account>()
    }),
    at("DELETE", "/api/v1/accounts/{name}/sessions", ADMINISTER, || delete(people::end_sessions)).described(|| {
        operation("endSessions", "Ends all sessions of a person; gives those of others.")
            .lists::<api::people::SessionLine>()
    }),
    at("GET", "/api/v1/tokens", ADMINISTER, || get(policy::tokens)).described(|| {
        operation("tokens", "All tokens there ever were, without their secrets.").lists::<access::Token>()
    }),
    at("POST", "/api/v1/tokens", ADMINISTER, || post(policy::create)).described(|| {
        operation("createToken", "Makes a token. Its secret is told here and never again.")
            .takes::<access::NewToken>(Required::True)
            .answers::<access::Secret>()
    }),
    at("DELETE", "/api/v1/tokens/{name}", ADMINISTER, || delete(policy::revoke)).described(|| {
        operation("revokeToken", "Ends a token and what shows it; gives all tokens.").lists::<access::Token>()
    }),
    at("POST", "/api/v1/tokens/{name}/rotate", ADMINISTER, || post(policy::rotate)).described(|| {
        operation("rotateToken", "Gives a token another secret; what shows the old one ends.")
            .answers::<access::Secret>()
    }),
    at("GET", "/api/v1/policy", ADMINISTER, || get(policy::rules)).described(|| {
        operation("policy", "Rules that say what principals may use of services.").lists::<access::Rule>()
    }),
    at("POST", "/api/v1/policy", ADMINISTER, || post(policy::add_rule)).described(|| {
        operation("addRule", "Writes a rule; it holds at once. Gives all rules.")
            .takes::<access::NewRule>(Required::True)
            .lists::<access::Rule>()
    }),
    at("DELETE", "/api/v1/policy/{id}", ADMINISTER, || delete(policy::remove_rule)).described(|| {
        operation("removeRule", "Removes a rule; that holds at once. Gives those that are left.")
            .lists::<access::Rule>()
    }),
    at("GET", "/api/v1/pairings", PAIR, || get(machines::list)).described(|| {
        operation("pairings", "Robots that are paired, and those for which a pairing code waits.")
            .lists::<api::machines::Pairing>()
    }),
    at("POST", "/api/v1/pairings", PAIR, || post(machines::begin)).described(|| {
        operation("beginPairing", "Makes a pairing code for a robot. It is told here and never again.")
            .takes::<api::machines::NewPairing>(Required::True)
            .answers::<api::machines::PairingMade>()
    }),
    at("DELETE", "/api/v1/pairings/{name}", PAIR, || delete(machines::unpair)).described(|| {
        operation("unpair", "Ends a robot's pairing and its connections; gives those that are left.")
            .lists::<api::machines::Pairing>()
    }),
    at("DELETE", "/api/v1/pairings/{name}/code", PAIR, || delete(machines::cancel)).described(|| {
        operation("cancelPairing", "Takes a robot's pairing code back; gives those that are left.")
            .lists::<api::machines::Pairing>()
    }),
    at("POST", "/api/v1/pair", Code, || post(machines::pair)).described(|| {
        operation("pair", "Gives a robot that shows its pairing code a certificate of its key.")
            .takes::<api::machines::Pair>(Required::True)
            .answers::<api::machines::RobotCertificate>()
    }),
    at("POST", "/api/v1/renew", ENTER, || post(machines::renew)).described(|| {
        operation("renew", "Gives the paired robot that asks another certificate of its key.")
            .takes::<api::machines::Renew>(Required::True)
            .answers::<api::machines::RobotCertificate>()
    }),
    at("POST", "/api/v1/push", May(Deploy, Of::Handler), || {
        post(push::push).layer(DefaultBodyLimit::disable())
    })
    .described(|| {
        operation(
            "push",
            "Builds an image of a package and publishes it. The last line is done or error.",
        )
        .asks_json::<api::PushOptions>("options", "What to make of the archive.")
        .takes_file(
            "application/x-tar",
            "A tar archive, gzipped or not; empty with apt.",
            Required::False,
        )
        .streams::<api::PushEvent>()
    }),
    at("GET", "/api/v1/openapi.json", ENTER, || get(openapi::serve))
        .described(|| operation("openapi", "This document.").answers_object()),
    at("GET", "/v2", ENTER, || get(oci::version)),
    at("GET", "/v2/", ENTER, || get(oci::version)),
    at("GET", "/v2/_catalog", ENTER, || get(oci::catalog)),
    at("GET", "/v2/{name}/tags/list", service(See), || get(oci::tags)),
    at("GET", "/v2/{name}/manifests/{reference}", service(See), || {
        get(oci::manifest)
    }),
    at("GET", "/v2/{name}/blobs/{digest}", service(See), || get(oci::blob)),
    at("GET", "/stubs", ENTER, || get(stubs::list)),
    at("GET", "/stubs/{file}", May(See, Of::Stub("file")), || get(stubs::archive)),
    at("GET", "/foxglove/{id}", servant(See), || get(viewers::viewer)),
    at("ANY", "/{service}", Connect, || any(robots::service)),
    at("ANY", "/{service}/", Connect, || {
        any(robots::service_with_slash)
    }),
];

/// Answers paths that are in no row: 404.
pub async fn nothing(uri: OriginalUri) -> Response {
    if uri.path().starts_with("/v2/") {
        return oci::nothing(uri).await;
    }
    Error::UnknownPath {
        path: uri.path().to_owned(),
    }
    .into_response()
}

/// Answers methods that no row has of a path that is in one: 405. Which it has is added by the router.
pub async fn other_method(method: Method, OriginalUri(uri): OriginalUri) -> Response {
    if uri.path().starts_with("/v2/") {
        return oci::other_method(&method, &uri);
    }
    Error::OtherMethod {
        method: method.to_string(),
        path: uri.path().to_owned(),
    }
    .into_response()
}
