//! Callers that may use a route, and the object that it is about.

use access::AccessAction;
use axum::http::Method;

/// Callers that may use a route, where tokens exist.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Access {
    /// Callers that may perform this action on this object.
    May(AccessAction, AccessTarget),
    /// Anybody, read-only.
    Read,
    /// Whoever presents a pairing code.
    Code,
    /// Anybody, to query the session or to sign in.
    SignIn,
    /// Any robot; its first message must be rosbridge's `auth`.
    Connect,
    /// Anybody, read-only, and any robot.
    ReadOrConnect,
}

/// The object of a route, and the path parameter that names it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum AccessTarget {
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
    /// Named by the query or the body: the handler decides.
    Handler,
}

/// Returns the access of the route that serves a path.
pub type FindAccess = fn(&str) -> Access;

/// Describes a request, by its method and path, for the audit log.
pub type DescribeRequest = fn(&Method, &str) -> String;

/// Returns true if a request's path matches a path of the route table.
pub fn matches_path(pattern: &str, path: &str) -> bool {
    let mut segments = path.split('/');
    pattern.split('/').all(|expected| {
        segments.next().is_some_and(|segment| segment == expected || (expected.starts_with('{') && !segment.is_empty()))
    }) && segments.next().is_none()
}
