//! Checks before anything is sent or started: services that cannot be evaluated with a recording, and numbers of cores
//! that no servant can have.

use std::path::Path;

use anyhow::bail;
use api::interface::Direction;
use api::{Problem, ServiceDetail};

use super::EvalArgs;
use crate::client::{DaemonClient, percent_encode};

impl EvalArgs {
    /// Refuses numbers of cores that no servant can have here, before minutes are spent on measuring.
    pub(super) async fn check_capacity(&self, client: &DaemonClient) -> anyhow::Result<()> {
        for (flag, cpus) in [("--robot-cpus", self.robot_cpus), ("--cpus", self.cpus)] {
            let Some(cpus) = cpus else { continue };
            let path = format!("/api/v1/services/{}/fit?cpus={cpus}", percent_encode(&self.service));
            // Caps for robots do not apply here; any other error is reported by the measurement itself.
            let fit = client.get::<api::Fit>(&path).await;
            let never = fit.ok().and_then(|fit| fit.never).filter(|why| exceeds_machine(why));
            if let Some(why) = never {
                return Err(Problem {
                    status: 422,
                    detail: format!("{flag} {cpus} can never be measured on this machine: {why}"),
                    next: Some(format!("pass fewer cores with {flag}")),
                    ..Problem::default()
                }
                .into());
            }
        }
        Ok(())
    }

    /// Returns the service, if its requests can be in a recording.
    pub(super) async fn check(&self, client: &DaemonClient) -> anyhow::Result<ServiceDetail> {
        let name = &self.service;
        let path = Path::new(name);
        // A service may have the same name as a local directory.
        if name.contains('/') || matches!(&**name, "." | "..") {
            bail!(
                "{name} is a directory, not a service: publish it first with: cloudroidctl push {name}; then: \
                    cloudroidctl eval NAME --bag {}",
                self.bag.display()
            );
        }
        let address = format!("/api/v1/services/{}", percent_encode(name));
        let asked = client.get(&address).await;
        let service: ServiceDetail = asked.map_err(explain_not_found(name, path.is_dir()))?;
        let interface = &service.interface;
        if let Some(named) = &self.output {
            let outputs = interface.topics.iter();
            let outputs = outputs.filter(|topic| topic.direction == Direction::Output);
            let outputs: Vec<&str> = outputs.map(|topic| topic.name.as_str()).collect();
            if !outputs.contains(&named.as_str()) {
                return Err(invalid_input(format!(
                    "{name} has no output {named}; its outputs are: {}",
                    outputs.join(", ")
                )));
            }
        }
        let is_fed = |topic: &api::interface::Topic| topic.direction == Direction::Input;
        if !interface.topics.iter().any(is_fed) {
            let calls: Vec<&str> = interface
                .services
                .iter()
                .map(|service| service.name.as_str())
                .chain(interface.actions.iter().map(|action| action.name.as_str()))
                .collect();
            if calls.is_empty() {
                bail!("{name} has no inputs, so no request can be sent to it")
            } else {
                bail!(
                    "the requests of {name} are service calls and action goals ({}), but a recording has topic \
                        messages only: measure them on their robot with: cloudroidctl explain ROBOT; and write entries \
                        with: cloudroidctl sla set --spread",
                    calls.join(", ")
                )
            }
        }
        Ok(service)
    }
}

/// Returns the problem for invalid input.
pub(super) fn invalid_input(detail: String) -> anyhow::Error {
    Problem { status: 400, detail, ..Problem::default() }.into()
}

/// Returns whether a servant is never admitted because the machine is too small.
fn exceeds_machine(why: &str) -> bool {
    why.contains("does not fit on this machine")
}

/// Returns a function that adds advice to the error about an unknown service.
fn explain_not_found(name: &str, is_directory: bool) -> impl FnOnce(anyhow::Error) -> anyhow::Error {
    let next = if is_directory {
        format!(
            "{name} is a directory here, not a service: publish it first with: cloudroidctl push {name}; or name one \
                of those"
        )
    } else {
        format!(
            "name one of those, or publish the package first: cloudroidctl push DIRECTORY --name {name} (--apt {name}, \
                if Debian has it)"
        )
    };
    move |error| match error.downcast::<Problem>() {
        Ok(problem) if problem.status == 404 => Problem { next: Some(next), ..problem }.into(),
        Ok(problem) => problem.into(),
        Err(error) => error,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_service_is_to_be_pushed() {
        let of = |status, is_directory| {
            let problem = Problem { status, next: Some("see the list".to_owned()), ..Problem::default() };
            let told = explain_not_found("people", is_directory)(problem.into());
            told.downcast::<Problem>().expect("a problem").next.unwrap_or_default()
        };
        assert!(of(404, false).contains("cloudroidctl push DIRECTORY --name people"));
        assert!(of(404, true).contains("people is a directory here"));
        assert_eq!(of(403, true), "see the list");
    }
}
