//! Permissions of a caller: what it may do to a service, and for which robot.

use std::sync::Arc;

use access::decide::can_use_class;
use access::{AccessAction, AccessObject, Role, decide};
use choreographer::Handle;

use crate::app::App;
use crate::caller::Caller;
use crate::errors::Error;

/// Class of robots that name none.
const DEFAULT: &str = "default";

impl Caller {
    /// Checks whether the caller may perform the action on the object.
    pub fn check_access(&self, action: AccessAction, object: &AccessObject<'_>) -> Result<(), Error> {
        Ok(decide(&self.who.principal, action, object)?)
    }

    /// Returns true if the caller may see the service.
    pub fn can_see(&self, app: &App, service: &str) -> bool {
        self.who.principal.sees_all() || self.check_service_access(app, AccessAction::See, service, None).is_ok()
    }

    /// Waits until responses about a service must end: the daemon stops, or the caller's credential has become
    /// invalid.
    pub fn wait_for_end(&self, app: &Arc<App>, service: &str) -> impl Future<Output = ()> + Send + use<> {
        let (app, who, service) = (Arc::clone(app), self.who.clone(), service.to_owned());
        async move {
            tokio::select! {
                () = app.ending.cancelled() => {}
                _ = app.principals.wait_for_end(&who, &service, false) => {}
            }
        }
    }

    /// Returns true if the caller may see the servant: a robot sees only its own.
    pub fn can_see_servant(&self, app: &App, handle: &Handle) -> bool {
        self.can_act_for_robot(&handle.robot) && self.can_see(app, handle.service())
    }

    /// Returns the robot that the caller is, if it is a named robot.
    pub fn own_robot(&self) -> Option<&str> {
        let principal = &self.who.principal;
        let own = principal.scope.robot.as_deref();
        own.filter(|_| principal.has_role(Role::Robot))
    }

    /// Returns true unless the caller is another robot.
    pub fn can_act_for_robot(&self, robot: &str) -> bool {
        self.own_robot().is_none_or(|own| own == robot)
    }

    /// Returns true if the caller may perform the action on what belongs to a robot at a service; robots are limited
    /// to their own.
    pub fn is_allowed_for_robot(&self, app: &App, action: AccessAction, service: &str, robot: &str) -> bool {
        self.can_act_for_robot(robot) && self.check_service_access(app, action, service, None).is_ok()
    }

    /// Checks whether the caller may perform the action on a service, as a robot if one is named.
    pub fn check_service_access(
        &self,
        app: &App,
        action: AccessAction,
        service: &str,
        robot: Option<&str>,
    ) -> Result<(), Error> {
        // Only a deployer's permissions depend on the owner of the service.
        let (exists, owner) = if self.who.principal.has_role(Role::Deployer) {
            match app.state.service_owner(service)? {
                Some(owner) => (true, owner),
                None => (false, None),
            }
        } else {
            (true, None)
        };
        let object = AccessObject { service: Some(service), exists, owner: owner.as_deref(), robot };
        self.check_access(action, &object)
    }

    /// Returns the actions that the caller may perform: on the machine, and at the service or, without one, at a
    /// service of its own.
    pub fn permitted_actions(&self, app: &App, service: Option<&str>) -> Vec<AccessAction> {
        let principal = &self.who.principal;
        let robot = principal.scope.robot.as_deref();
        let check = |action: AccessAction| match (action, service) {
            (AccessAction::Enter | AccessAction::Look | AccessAction::Pair | AccessAction::Administer, _) => {
                self.check_access(action, &AccessObject::MACHINE)
            }
            (_, Some(service)) => self.check_service_access(app, action, service, robot),
            (_, None) => {
                let own = AccessObject { robot, ..AccessObject::service("", Some(&principal.name)) };
                self.check_access(action, &own)
            }
        };
        AccessAction::ALL.into_iter().filter(|action| check(*action).is_ok()).collect()
    }

    /// Checks whether the caller may use a class of the configuration.
    pub fn check_class(&self, class: &str) -> Result<(), Error> {
        if class == DEFAULT || can_use_class(&self.who.principal, class) {
            Ok(())
        } else {
            Err(Error::Forbidden { what: format!("{} may not use class {class}", self.who.principal.name) })
        }
    }
}

/// Refuses an unknown service. A caller that may not see all services is shown only those it may see.
pub fn check_service_known(app: &App, caller: &Caller, service: &str) -> Result<(), Error> {
    if caller.who.principal.sees_all() || app.state.service_package(service)?.is_some() {
        return Ok(());
    }
    let mut refusal = app.catalogue.unknown_service(service)?;
    if let catalogue::Error::UnknownService { exists, .. } = &mut refusal {
        exists.retain(|name| caller.can_see(app, name));
    }
    Err(refusal.into())
}
