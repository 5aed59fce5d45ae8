use std::collections::BTreeMap;

use api::{Limits, Stated};

/// A request for a servant: service, robot and terms.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ServantRequest {
    /// The service.
    pub service: String,
    /// The robot.
    pub robot: String,
    /// The robot gave no name and cannot come back to its servant.
    pub anonymous: bool,
    /// The node of the requesting stub; a new servant starts without nodes, since stubs start them one by one. `None`
    /// for a rosbridge client.
    pub stub: Option<String>,
    /// The statement; an empty one keeps the earlier statement.
    pub stated: Stated,
    /// Limits that this daemon sets from the start, regardless of caps on robots; used for measurements.
    pub set: Limits,
}

impl ServantRequest {
    /// Creates a request of a rosbridge client without a statement.
    pub fn new(service: &str, robot: &str) -> ServantRequest {
        ServantRequest { service: service.to_owned(), robot: robot.to_owned(), ..ServantRequest::default() }
    }

    /// Marks the robot as one without a name.
    pub fn anonymous(self) -> ServantRequest {
        ServantRequest { anonymous: true, ..self }
    }

    /// Sets the stub's node.
    pub fn with_stub(self, node: &str) -> ServantRequest {
        ServantRequest { stub: Some(node.to_owned()), ..self }
    }

    /// Sets the statement.
    pub fn with_stated(self, stated: Stated) -> ServantRequest {
        ServantRequest { stated, ..self }
    }

    /// Sets limits that this daemon imposes.
    pub(crate) fn with_limits(self, set: Limits) -> ServantRequest {
        ServantRequest { set, ..self }
    }

    /// Returns the name of the requesting client: the stub's node, or an empty name.
    pub(crate) fn client(&self) -> &str {
        self.stub.as_deref().unwrap_or_default()
    }

    /// Returns the statement by client; empty without a statement.
    pub(crate) fn statement(&self) -> BTreeMap<String, Stated> {
        let some = (!self.stated.is_empty()).then(|| (self.client().to_owned(), self.stated.clone()));
        some.into_iter().collect()
    }
}

/// Returns true if a servant with this name serves no robot but a purpose of the daemon: a measurement (`~try-…`,
/// `~calibrate-…`), or a group (`~group-…`). Robots without a name are given one without a dash.
pub(crate) fn serves_no_robot(robot: &str, anonymous: bool) -> bool {
    anonymous && robot.contains('-')
}
