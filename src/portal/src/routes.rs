//! Route table of the portal: for each address its method, who may use it, its handler, and its entry in the OpenAPI
//! document. Router, guard and document are generated from it.

#[cfg(test)]
mod matrix;
pub mod words;

use ::access::AccessAction;
use api::access;
use axum::extract::{DefaultBodyLimit, OriginalUri};
use axum::http::Method;
use axum::response::{IntoResponse, Response};
use axum::routing::{MethodRouter, any, delete, get, patch, post, put};

use std::sync::Arc;

use utoipa::openapi::Required;

use super::{
    App, api_v1, audit, bases, calibration, dictionary, differences, events, exec, goals, history, inside, logs,
    machines, metrics, oci, openapi, page, people, policy, push, pushes, recordings, robots, shadow, stream, stubs,
    topics, underlays, viewers,
};
use crate::errors::Error;
use crate::openapi::{Operation, operation};
use crate::route_access::{Access, AccessTarget, matches_path};

use Access::{Code, Connect, May, Read, ReadOrConnect, SignIn};
use AccessAction::{Deploy, Enter, Exec, Logs, Look, Operate, See, Try};

/// Queries open to every principal, within what it may see.
const ENTER: Access = May(Enter, AccessTarget::Machine);
/// The whole machine.
const LOOK: Access = May(Look, AccessTarget::Machine);
/// Bases of images, which concern all services.
const KEEP_BASES: Access = May(Operate, AccessTarget::Machine);
/// Pairings of robots.
const PAIR: Access = May(AccessAction::Pair, AccessTarget::Machine);
/// Tokens and policy.
const ADMINISTER: Access = May(AccessAction::Administer, AccessTarget::Machine);

/// Access to the service named by `{name}`.
const fn service(action: AccessAction) -> Access {
    May(action, AccessTarget::Service("name"))
}

/// Access to the servant named by `{id}`.
const fn servant(action: AccessAction) -> Access {
    May(action, AccessTarget::Servant("id"))
}

/// One method of one address.
pub struct Route {
    /// `GET`, …, or `ANY` if the handler distinguishes methods. `GET` also answers `HEAD`.
    pub method: &'static str,
    /// Path in axum's syntax; `{…}` is one segment.
    pub path: &'static str,
    /// Callers that may use the route.
    pub access: Access,
    /// Creates the handler.
    pub handler: fn() -> MethodRouter<Arc<App>>,
    /// Entry in the OpenAPI document.
    pub operation: Option<fn() -> Operation>,
}

const fn route(
    method: &'static str,
    path: &'static str,
    access: Access,
    handler: fn() -> MethodRouter<Arc<App>>,
) -> Route {
    assert!(names_its_object(path, access), "a row's address has no parameter of the name that its access says");
    Route { method, path, access, handler, operation: None }
}

/// Returns true if the path has the parameter that names the object; otherwise the program does not compile.
const fn names_its_object(path: &str, access: Access) -> bool {
    let May(
        _,
        AccessTarget::Service(name)
        | AccessTarget::Stub(name)
        | AccessTarget::Servant(name)
        | AccessTarget::Robot(name)
        | AccessTarget::Recording(name),
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
    const fn with_operation(self, operation: fn() -> Operation) -> Self {
        Route { operation: Some(operation), ..self }
    }

    /// Returns true if a request's path matches the route.
    fn matches(&self, path: &str) -> bool {
        matches_path(self.path, path)
    }
}

/// Returns the access of the first route that matches the path.
pub fn find_access(path: &str) -> Access {
    let row = ROUTES.iter().find(|route| route.matches(path));
    row.map_or(LOOK, |route| route.access)
}

/// All routes; fixed paths precede those with a parameter in their place.
pub const ROUTES: &[Route] = &[
    route("ANY", "/", ReadOrConnect, || any(robots::root)),
    route("GET", "/healthz", Read, || get(api_v1::health)),
    route("GET", "/metrics", LOOK, || get(metrics::metrics)),
    route("ANY", "/assets", ENTER, || any(not_found)),
    route("GET", "/assets/{name}", Read, || get(page::asset)),
    route("ANY", "/api", ENTER, || any(not_found)),
    route("GET", "/api/v1/status", LOOK, || get(api_v1::status))
        .with_operation(|| operation("status", "Summary of the daemon.").answers::<api::Status>()),
    route("GET", "/api/v1/doctor", LOOK, || get(api_v1::doctor)).with_operation(|| {
        operation("doctor", "Checks what this machine needs to run servants.").answers::<api::Doctor>()
    }),
    route("GET", "/api/v1/clock", ENTER, || get(api_v1::clock)).with_operation(|| {
        operation("clock", "The daemon's clock, to compare another clock with.").answers::<api::Clock>()
    }),
    route("GET", "/api/v1/events", ENTER, || get(events::events)).with_operation(|| {
        operation("events", "Events, oldest first.").asks::<events::EventQuery>().lists::<api::Event>()
    }),
    route("GET", "/api/v1/events/follow", ENTER, || get(events::follow)).with_operation(|| {
        operation(
            "followEvents",
            "Events, oldest first, and new ones as they happen. With since=N, no event after N is missed.",
        )
        .asks::<events::EventQuery>()
        .streams::<api::Event>()
    }),
    route("GET", "/api/v1/stream", ENTER, || get(stream::stream)).with_operation(|| {
        operation(
            "stream",
            "Machine, services, servants and events as server-sent events: one `snapshot`, then `update` for each \
                change.",
        )
        .sends::<api::stream::Update>()
    }),
    route("GET", "/api/v1/history/servants", ENTER, || get(history::servants)).with_operation(|| {
        operation(
            "servantsHistory",
            "History of servants in the last day, ended ones included, most recently requested first.",
        )
        .asks::<history::ServantHistoryQuery>()
        .lists::<api::history::ServantHistory>()
    }),
    route("GET", "/api/v1/history/machine", LOOK, || get(history::machine)).with_operation(|| {
        operation("machineHistory", "History of the machine in the last day.")
            .asks::<history::TimeQuery>()
            .answers::<api::history::MachineHistory>()
    }),
    route("GET", "/api/v1/services", ENTER, || get(api_v1::services))
        .with_operation(|| operation("services", "All services.").lists::<api::ServiceSummary>()),
    route("GET", "/api/v1/services/{name}", service(See), || get(api_v1::service)).with_operation(|| {
        operation("service", "A service with its interface and revisions.").answers::<api::ServiceDetail>()
    }),
    route("DELETE", "/api/v1/services/{name}", service(Deploy), || delete(api_v1::remove_service)).with_operation(
        || {
            operation("removeService", "Removes the service, its servants, its images and its recordings.")
                .answers::<api::Stopped>()
        },
    ),
    route("GET", "/api/v1/services/{name}/interface", service(See), || get(api_v1::interface))
        .with_operation(|| operation("interface", "The interface with all message definitions.").answers_object()),
    route("GET", "/api/v1/services/{name}/record", service(Deploy), || get(api_v1::record)).with_operation(|| {
        operation(
            "serviceRecord",
            "Metadata of a revision that is not in its image, so that another server can publish both.",
        )
        .asks::<api_v1::RevisionQuery>()
        .answers_object()
    }),
    route("GET", "/api/v1/services/{name}/differences", service(See), || get(differences::differences)).with_operation(
        || {
            operation("differences", "Differences between two revisions.")
                .asks::<differences::DifferencesQuery>()
                .answers::<api::differences::Differences>()
        },
    ),
    route("GET", "/api/v1/services/{name}/fit", service(See), || get(api_v1::fit)).with_operation(|| {
        operation("fit", "Whether one more servant would fit, how many more would, and what it would cost the others.")
            .asks::<dictionary::StatedQuery>()
            .answers::<api::Fit>()
    }),
    route("POST", "/api/v1/services/{name}/rollback", service(Deploy), || post(api_v1::rollback)).with_operation(
        || {
            operation("rollback", "Makes an earlier revision the current one.")
                .takes::<api::Rollback>(Required::False)
                .answers::<api::ServiceDetail>()
        },
    ),
    route("GET", "/api/v1/services/{name}/rollout", service(See), || get(api_v1::rollout))
        .with_operation(|| operation("rollout", "The rollout of a service.").answers::<api::Rollout>()),
    route("POST", "/api/v1/services/{name}/rollout", service(Deploy), || post(api_v1::order_rollout)).with_operation(
        || {
            operation("orderRollout", "Starts a rollout, promotes its canary, or aborts it.")
                .takes::<api::rollout::RolloutOrder>(Required::True)
                .answers::<api::Rollout>()
        },
    ),
    route("POST", "/api/v1/services/{name}/trial", service(Try), || post(api_v1::trial)).with_operation(|| {
        operation(
            "trial",
            "Runs a service on a recording (rosbag 2.0) or a picture (PNG) and returns its outputs and response times.",
        )
        .asks::<api_v1::TrialQuery>()
        .takes_file("application/octet-stream", "The recording or the picture.", Required::True)
        .answers::<api::trial::Trial>()
    }),
    route("POST", "/api/v1/services/{name}/calibration", service(Try), || {
        post(calibration::calibration).layer(DefaultBodyLimit::disable())
    })
    .with_operation(|| {
        operation(
            "calibrate",
            "Replays recorded requests at several limits and proposes rows for the SLA table without writing them. The \
                last line is `done` or `error`.",
        )
        .asks_json::<api::CalibrationOptions>("options", "Options of the calibration.")
        .takes_file(
            "application/octet-stream",
            "A recording (rosbag 2.0), or pictures (concatenated PNG files); empty with `live`.",
            Required::False,
        )
        .streams::<api::CalibrationEvent>()
    }),
    route("POST", "/api/v1/services/{name}/shadow", service(Try), || post(shadow::shadow)).with_operation(|| {
        operation(
            "shadow",
            "Mirrors a robot's requests to a candidate revision, whose answers are only compared. The last line is \
                `done` or `error`.",
        )
        .takes::<api::ShadowOptions>(Required::True)
        .streams::<api::ShadowEvent>()
    }),
    route("GET", "/api/v1/services/{name}/sla", service(See), || get(dictionary::rows)).with_operation(|| {
        operation("dictionary", "The service's SLA table: the limits that each SLA needs.")
            .lists::<api::dictionary::Row>()
    }),
    route("PUT", "/api/v1/services/{name}/sla", service(Deploy), || put(dictionary::write)).with_operation(|| {
        operation("writeDictionary", "Writes rows of the SLA table, all or none.")
            .takes::<api::dictionary::NewRows>(Required::True)
            .lists::<api::dictionary::Row>()
    }),
    route("GET", "/api/v1/services/{name}/sla/explain", service(See), || get(dictionary::explain)).with_operation(
        || {
            operation(
                "explainSla",
                "The limits that a robot with these terms would get, and why. Auxiliary parameters are aux.KEY=VALUE.",
            )
            .asks::<dictionary::StatedQuery>()
            .answers::<api::dictionary::Explained>()
        },
    ),
    route("DELETE", "/api/v1/services/{name}/sla/{id}", service(Deploy), || delete(dictionary::remove)).with_operation(
        || {
            operation("removeFromDictionary", "Removes a row of the SLA table; returns the remaining rows.")
                .lists::<api::dictionary::Row>()
        },
    ),
    route("GET", "/api/v1/servants", ENTER, || get(api_v1::servants))
        .with_operation(|| operation("servants", "All servants.").lists::<api::Servant>()),
    route("DELETE", "/api/v1/servants", May(Operate, AccessTarget::Handler), || delete(api_v1::stop_servants))
        .with_operation(|| {
            operation("stopServants", "Stops all servants, or those of one service.")
                .asks::<api_v1::ServiceQuery>()
                .answers::<api::Stopped>()
        }),
    route("GET", "/api/v1/servants/{id}", servant(See), || get(api_v1::servant))
        .with_operation(|| operation("servant", "One servant.").answers::<api::Servant>()),
    route("PATCH", "/api/v1/servants/{id}", servant(Operate), || patch(api_v1::set_limits)).with_operation(|| {
        operation("setLimits", "Changes the given limits of a running servant.")
            .takes::<api::Limits>(Required::True)
            .answers::<api::Servant>()
    }),
    route("DELETE", "/api/v1/servants/{id}", servant(Operate), || delete(api_v1::stop_servant))
        .with_operation(|| operation("stopServant", "Ends a servant.").answers::<api::Stopped>()),
    route("GET", "/api/v1/servants/{id}/logs", servant(Logs), || get(logs::read)).with_operation(|| {
        operation("logs", "Output of its nodes, also after its end while the log is kept.")
            .asks::<logs::LogQuery>()
            .streams::<api::LogLine>()
    }),
    route("GET", "/api/v1/logs", ENTER, || get(logs::list)).with_operation(|| {
        operation("keptLogs", "Ended servants whose logs are kept, newest first.")
            .asks::<logs::KeptLogQuery>()
            .lists::<api::KeptLog>()
    }),
    route("GET", "/api/v1/servants/{id}/exec", servant(Exec), || get(exec::open_exec)).with_operation(|| {
        operation(
            "exec",
            "Runs a program in a servant and opens a WebSocket of its streams (subprotocol `exec.v1.cloudroid`).",
        )
        .asks::<exec::ExecQuery>()
        .becomes_a_websocket()
    }),
    route("GET", "/api/v1/servants/{id}/inside", servant(See), || get(inside::open_inside)).with_operation(|| {
        operation("inside", "Opens a WebSocket into a servant that speaks rosbridge, besides its robot.")
            .becomes_a_websocket()
    }),
    route("GET", "/api/v1/servants/{id}/topics", servant(See), || get(topics::topics)).with_operation(|| {
        operation(
            "topics",
            "Message rates of all topics of a servant, a line each second. The daemon subscribes to all topics \
                meanwhile.",
        )
        .streams::<api::topics::PublishedTopics>()
    }),
    route("GET", "/api/v1/servants/{id}/goals", servant(See), || get(goals::goals)).with_operation(|| {
        operation("goals", "Goals of a servant's actions and their outcome, newest first.").lists::<api::goals::Goal>()
    }),
    route("POST", "/api/v1/servants/{id}/recording", servant(Operate), || post(recordings::take)).with_operation(
        || {
            operation("takeRecording", "Saves the messages of the last seconds of a servant (ring-buffer recording).")
                .answers::<api::recordings::Recording>()
        },
    ),
    route("GET", "/api/v1/recordings", ENTER, || get(recordings::list)).with_operation(|| {
        operation("recordings", "Ring-buffer recordings, newest first.")
            .asks::<recordings::RecordingQuery>()
            .lists::<api::recordings::Recording>()
    }),
    route("GET", "/api/v1/recordings/{number}", May(See, AccessTarget::Recording("number")), || get(recordings::file))
        .with_operation(|| {
            operation("recording", "A ring-buffer recording (MCAP).").answers_file("application/octet-stream")
        }),
    route("DELETE", "/api/v1/recordings/{number}", May(Operate, AccessTarget::Recording("number")), || {
        delete(recordings::remove)
    })
    .with_operation(|| {
        operation("removeRecording", "Removes a ring-buffer recording; returns the remaining ones.")
            .lists::<api::recordings::Recording>()
    }),
    route("GET", "/api/v1/back-offs", ENTER, || get(api_v1::back_offs)).with_operation(|| {
        operation("backOffs", "Servants that failed repeatedly, and when each may be started again.")
            .lists::<api::BackOff>()
    }),
    route("GET", "/api/v1/robots/{name}/explain", May(See, AccessTarget::Robot("name")), || get(api_v1::explain))
        .with_operation(|| {
            operation("explain", "Explains why a robot is slow or uses its local original.")
                .answers::<api::explain::Explanation>()
        }),
    route("GET", "/api/v1/audit", ADMINISTER, || get(audit::records::audit)).with_operation(|| {
        operation("audit", "Audit log, oldest first.").asks::<audit::records::AuditQuery>().streams::<access::Audited>()
    }),
    route("GET", "/api/v1/whoami", ENTER, || get(policy::whoami)).with_operation(|| {
        operation("whoami", "The caller, as the daemon identified it, and what it may do.")
            .asks::<policy::WhoamiQuery>()
            .answers::<access::Whoami>()
    }),
    route("GET", "/api/v1/session", SignIn, || get(people::session))
        .with_operation(|| operation("session", "The current session, if any.").answers::<api::people::Session>()),
    route("POST", "/api/v1/session", SignIn, || post(people::sign_in)).with_operation(|| {
        operation("signIn", "Signs in with a password and sets the session cookie.")
            .takes::<api::people::SignIn>(Required::True)
            .answers::<api::people::Session>()
    }),
    route("DELETE", "/api/v1/session", ENTER, || delete(people::sign_out)).with_operation(|| {
        operation("signOut", "Ends the current session, or all sessions of the account.")
            .asks::<people::SignOutQuery>()
            .answers_nothing()
    }),
    route("GET", "/api/v1/oidc/login", Read, || get(people::provider::login)).with_operation(|| {
        operation("oidcLogin", "Redirects the browser to the identity provider to sign in.")
            .asks::<people::provider::LoginQuery>()
            .redirects()
    }),
    route("GET", "/api/v1/oidc/callback", Read, || get(people::provider::callback)).with_operation(|| {
        operation("oidcCallback", "Completes the sign-in at the identity provider and sets the session cookie.")
            .asks::<people::provider::CallbackQuery>()
            .answers_page()
    }),
    route("GET", "/api/v1/sessions", ADMINISTER, || get(people::sessions))
        .with_operation(|| operation("sessions", "All sessions.").lists::<api::people::SessionLine>()),
    route("GET", "/api/v1/accounts", ADMINISTER, || get(people::accounts))
        .with_operation(|| operation("accounts", "All accounts.").lists::<api::people::Account>()),
    route("POST", "/api/v1/accounts", ADMINISTER, || post(people::create)).with_operation(|| {
        operation("createAccount", "Creates an account; returns all accounts.")
            .takes::<api::people::NewAccount>(Required::True)
            .lists::<api::people::Account>()
    }),
    route("PATCH", "/api/v1/accounts/{name}", ADMINISTER, || patch(people::change)).with_operation(|| {
        operation("changeAccount", "Changes an account and ends its sessions; returns all accounts.")
            .takes::<api::people::AccountChange>(Required::True)
            .lists::<api::people::Account>()
    }),
    route("DELETE", "/api/v1/accounts/{name}", ADMINISTER, || delete(people::remove)).with_operation(|| {
        operation("removeAccount", "Removes an account and ends its sessions; returns the remaining ones.")
            .lists::<api::people::Account>()
    }),
    route("DELETE", "/api/v1/accounts/{name}/sessions", ADMINISTER, || delete(people::end_sessions)).with_operation(
        || {
            operation("endSessions", "Ends all sessions of an account; returns the remaining sessions.")
                .lists::<api::people::SessionLine>()
        },
    ),
    route("GET", "/api/v1/tokens", ADMINISTER, || get(policy::tokens)).with_operation(|| {
        operation("tokens", "All tokens without their secrets, revoked ones included.").lists::<access::Token>()
    }),
    route("POST", "/api/v1/tokens", ADMINISTER, || post(policy::create)).with_operation(|| {
        operation("createToken", "Creates a token. Its secret is returned only here.")
            .takes::<access::NewToken>(Required::True)
            .answers::<access::Secret>()
    }),
    route("DELETE", "/api/v1/tokens/{name}", ADMINISTER, || delete(policy::revoke)).with_operation(|| {
        operation(
            "revokeToken",
            "Revokes a token and closes its connections; returns all \
            tokens.",
        )
        .lists::<access::Token>()
    }),
    route("POST", "/api/v1/tokens/{name}/rotate", ADMINISTER, || post(policy::rotate)).with_operation(|| {
        operation("rotateToken", "Replaces the secret of a token and closes connections that use the old one.")
            .answers::<access::Secret>()
    }),
    route("GET", "/api/v1/policy", ADMINISTER, || get(policy::rules)).with_operation(|| {
        operation("policy", "Policy rules: what principals may use of services.").lists::<access::Rule>()
    }),
    route("POST", "/api/v1/policy", ADMINISTER, || post(policy::add_rule)).with_operation(|| {
        operation("addRule", "Adds a rule, which applies at once; returns all rules.")
            .takes::<access::NewRule>(Required::True)
            .lists::<access::Rule>()
    }),
    route("DELETE", "/api/v1/policy/{id}", ADMINISTER, || delete(policy::remove_rule)).with_operation(|| {
        operation("removeRule", "Removes a rule, which applies at once; returns the remaining rules.")
            .lists::<access::Rule>()
    }),
    route("GET", "/api/v1/pairings", PAIR, || get(machines::list)).with_operation(|| {
        operation("pairings", "Paired robots, and robots with a pending pairing code.")
            .lists::<api::machines::Pairing>()
    }),
    route("POST", "/api/v1/pairings", PAIR, || post(machines::begin)).with_operation(|| {
        operation("beginPairing", "Creates a pairing code for a robot. It is returned only here.")
            .takes::<api::machines::NewPairing>(Required::True)
            .answers::<api::machines::PairingMade>()
    }),
    route("DELETE", "/api/v1/pairings/{name}", PAIR, || delete(machines::unpair)).with_operation(|| {
        operation("unpair", "Unpairs a robot and closes its connections; returns the remaining pairings.")
            .lists::<api::machines::Pairing>()
    }),
    route("DELETE", "/api/v1/pairings/{name}/code", PAIR, || delete(machines::cancel)).with_operation(|| {
        operation("cancelPairing", "Revokes a robot's pairing code; returns the remaining pairings.")
            .lists::<api::machines::Pairing>()
    }),
    route("POST", "/api/v1/pair", Code, || post(machines::pair)).with_operation(|| {
        operation("pair", "Issues a certificate for the key of a robot that presents its pairing code.")
            .takes::<api::machines::Pair>(Required::True)
            .answers::<api::machines::RobotCertificate>()
    }),
    route("POST", "/api/v1/renew", ENTER, || post(machines::renew)).with_operation(|| {
        operation("renew", "Renews the certificate of the calling robot for its key.")
            .takes::<api::machines::Renew>(Required::True)
            .answers::<api::machines::RobotCertificate>()
    }),
    route("POST", "/api/v1/push", May(Deploy, AccessTarget::Handler), || {
        post(push::push).layer(DefaultBodyLimit::disable())
    })
    .with_operation(|| {
        operation(
            "push",
            "Builds an image of a package and publishes it. From `accepted` on it continues without the client. The \
                last line is `done` or `error`.",
        )
        .asks_json::<api::PushOptions>("options", "Options of the push.")
        .takes_file("application/x-tar", "A tar archive, optionally gzipped; empty with `apt`.", Required::False)
        .streams::<api::PushEvent>()
    }),
    route("GET", "/api/v1/bases", ENTER, || get(bases::bases)).with_operation(|| {
        operation("bases", "Bases of images: operating system and ROS.").lists::<api::bases::BaseSummary>()
    }),
    route("POST", "/api/v1/bases", KEEP_BASES, || post(bases::import).layer(DefaultBodyLimit::disable()))
        .with_operation(|| {
            operation("importBase", "Imports an exported base, in place of that of the same name.")
                .takes_file(api::bases::BASE_ARCHIVE, "A file of exportBase.", Required::True)
                .answers::<api::bases::BaseDetail>()
        }),
    route("GET", "/api/v1/bases/{name}", ENTER, || get(bases::base))
        .with_operation(|| operation("base", "A base with its packages.").answers::<api::bases::BaseDetail>()),
    route("PUT", "/api/v1/bases/{name}", KEEP_BASES, || put(bases::make).layer(DefaultBodyLimit::disable()))
        .with_operation(|| {
            operation("makeBase", "Makes a base from an image or a root file system, whose layers are kept.")
                .asks::<bases::NewBaseQuery>()
                .takes_file(
                    api::bases::BASE_ARCHIVE,
                    "An OCI image layout or docker archive as tar; or the root file system as tar, gzip or zstd.",
                    Required::True,
                )
                .answers::<api::bases::BaseDetail>()
        }),
    route("DELETE", "/api/v1/bases/{name}", KEEP_BASES, || delete(bases::remove)).with_operation(|| {
        operation("removeBase", "Removes an imported base; one with a definition is set up by the next push.")
            .answers::<api::bases::BaseDetail>()
    }),
    route("GET", "/api/v1/bases/{name}/archive", KEEP_BASES, || get(bases::export)).with_operation(|| {
        operation("exportBase", "The layers of a base as a tar archive of an OCI image layout, for another server.")
            .answers_file(api::bases::BASE_ARCHIVE)
    }),
    route("GET", "/api/v1/underlays", ENTER, || get(underlays::list)).with_operation(|| {
        operation("underlays", "Underlays: compiled workspaces that packages are built upon.").lists::<api::Underlay>()
    }),
    route("DELETE", "/api/v1/underlays/{name}", May(Deploy, AccessTarget::Handler), || delete(underlays::remove))
        .with_operation(|| {
            operation("removeUnderlay", "Removes an underlay, unless services stand on it.").answers::<api::Underlay>()
        }),
    route("GET", "/api/v1/pushes", ENTER, || get(pushes::list)).with_operation(|| {
        operation("pushes", "Pushes that run and those that ended lately, newest first.").lists::<api::PushStatus>()
    }),
    route("GET", "/api/v1/pushes/{number}/output", May(Logs, AccessTarget::Handler), || get(pushes::output))
        .with_operation(|| {
            operation("pushOutput", "Events of a push. The last line of one that has ended is as of `push`.")
                .asks::<pushes::PushOutputQuery>()
                .streams::<api::PushEvent>()
        }),
    route("DELETE", "/api/v1/pushes/{number}", May(Deploy, AccessTarget::Handler), || delete(pushes::cancel))
        .with_operation(|| {
            operation("cancelPush", "Cancels a running push, which ends when nothing is left of it.")
                .answers::<api::PushStatus>()
        }),
    route("GET", "/api/v1/openapi.json", ENTER, || get(openapi::serve))
        .with_operation(|| operation("openapi", "This document.").answers_object()),
    route("GET", "/v2", ENTER, || get(oci::version)),
    route("GET", "/v2/", ENTER, || get(oci::version)),
    route("GET", "/v2/_catalog", ENTER, || get(oci::catalog)),
    route("GET", "/v2/{name}/tags/list", service(See), || get(oci::tags)),
    route("GET", "/v2/{name}/manifests/{reference}", service(See), || get(oci::manifest)),
    route("GET", "/v2/{name}/blobs/{digest}", service(See), || get(oci::blob)),
    route("GET", "/stubs", ENTER, || get(stubs::list)),
    route("GET", "/stubs/{file}", May(See, AccessTarget::Stub("file")), || get(stubs::archive)),
    route("GET", "/foxglove/{id}", servant(See), || get(viewers::viewer)),
    route("ANY", "/{service}", Connect, || any(robots::service)),
    route("ANY", "/{service}/", Connect, || any(robots::service_with_slash)),
];

/// Responds to paths without a route: 404.
pub async fn not_found(uri: OriginalUri) -> Response {
    if uri.path().starts_with("/v2/") {
        return oci::refuse_unsupported(uri).await;
    }
    Error::UnknownPath { path: uri.path().to_owned() }.into_response()
}

/// Responds to methods that a path does not support: 405. The router adds the supported methods.
pub async fn other_method(method: Method, OriginalUri(uri): OriginalUri) -> Response {
    if uri.path().starts_with("/v2/") {
        return oci::other_method(&method, &uri);
    }
    Error::OtherMethod { method: method.to_string(), path: uri.path().to_owned() }.into_response()
}
