use std::collections::BTreeMap;

use api::{Limits, Stated};

/// Whom a servant is asked for, of which service, and on which terms.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ServantRequest {
    /// The service.
    pub service: String,
    /// The robot.
    pub robot: String,
    /// The robot named no name: nobody can come back to its servant.
    pub anonymous: bool,
    /// A stub asks, which stands for this node; a new servant begins without nodes, since stubs start them one by one. None:
    /// a rosbridge client.
    pub stub: Option<String>,
    /// What is stated. Where it is nothing, what was stated before stays.
    pub stated: Stated,
    /// Limits that this daemon sets from the start on, whatever robots may ask for: of what it measures.
    pub set: Limits,
}

impl ServantRequest {
    /// By a rosbridge client that states nothing.
    pub fn new(service: &str, robot: &str) -> ServantRequest {
        ServantRequest {
            service: service.to_owned(),
            robot: robot.to_owned(),
            ..ServantRequest::default()
        }
    }

    /// The same for a robot that named no name.
    pub fn anonymous(self) -> ServantRequest {
        ServantRequest {
            anonymous: true,
            ..self
        }
    }

    /// The same by the stub of `node`.
    pub fn by_stub(self, node: &str) -> ServantRequest {
        ServantRequest {
            stub: Some(node.to_owned()),
            ..self
        }
    }

    /// The same with what is stated.
    pub fn stating(self, stated: Stated) -> ServantRequest {
        ServantRequest { stated, ..self }
    }

    /// The same with limits that this daemon sets.
    pub(crate) fn setting(self, set: Limits) -> ServantRequest {
        ServantRequest { set, ..self }
    }

    /// Who states it, of all clients of one robot: the stub's node, or nobody's name.
    pub(crate) fn who(&self) -> &str {
        self.stub.as_deref().unwrap_or_default()
    }

    /// What is stated, by whom; nothing where nothing is.
    pub(crate) fn statement(&self) -> BTreeMap<String, Stated> {
        let some = (!self.stated.is_empty()).then(|| (self.who().to_owned(), self.stated.clone()));
        some.into_iter().collect()
    }
}

/// Whether a servant of this name serves no robot, but a purpose of this daemon: its measurement (`~try-…`, `~calibrate-…`), or
/// many robots (`~group-…`). Robots that name no name are given one without a dash.
pub(crate) fn serves_no_robot(robot: &str, anonymous: bool) -> bool {
    anonymous && robot.contains('-')
}
