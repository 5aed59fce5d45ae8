//! What is refused before anything is sent or started: services that a recording cannot ask, and cores that no servant can have.

use std::path::Path;

use anyhow::bail;
use api::interface::Direction;
use api::{Problem, ServiceDetail};

use super::Eval;
use crate::client::{Client, escaped};

impl Eval {
    /// Refuses cores that no servant here can have, before minutes of measuring.
    pub(super) async fn check_room(&self, client: &Client) -> anyhow::Result<()> {
        for (flag, cpus) in [("--robot-cpus", self.robot_cpus), ("--cpus", self.cpus)] {
            let Some(cpus) = cpus else { continue };
            let path = format!(
                "/api/v1/services/{}/fit?cpus={cpus}",
                escaped(&self.service)
            );
            // What robots may ask for is no matter here; what cannot be said is said when it is measured.
            let fit = client.get::<api::Fit>(&path).await;
            let never = fit
                .ok()
                .and_then(|fit| fit.never)
                .filter(|why| is_too_big(why));
            if let Some(why) = never {
                return Err(Problem {
                    status: 422,
                    detail: format!("{flag} {cpus} cannot be measured, now and later: {why}"),
                    next: Some(format!("name fewer with {flag}")),
                    ..Problem::default()
                }
                .into());
            }
        }
        Ok(())
    }

    /// The service, where a recording can hold its requests.
    pub(super) async fn check(&self, client: &Client) -> anyhow::Result<ServiceDetail> {
        let name = &self.service;
        let path = Path::new(name);
        // A service may have the name of a directory that lies here.
        if name.contains('/') || matches!(&**name, "." | "..") {
            bail!(
                "{name} is a directory, and services are evaluated: publish it first with: cloudroidctl push {name}; \
                 then: cloudroidctl eval NAME --bag {}",
                self.bag.display()
            );
        }
        let address = format!("/api/v1/services/{}", escaped(name));
        let asked = client.get(&address).await;
        let service: ServiceDetail = asked.map_err(unpublished(name, path.is_dir()))?;
        let interface = &service.interface;
        if let Some(named) = &self.output {
            let outputs = interface.topics.iter();
            let outputs = outputs.filter(|topic| topic.direction == Direction::Output);
            let outputs: Vec<&str> = outputs.map(|topic| topic.name.as_str()).collect();
            if !outputs.contains(&named.as_str()) {
                return Err(unusable(format!(
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
            match calls.is_empty() {
                true => bail!("{name} has no inputs, so that there is nothing to ask it"),
                false => bail!(
                    "requests of {name} are calls and goals ({}), and a recording holds messages of topics alone: measure them at their \
                     robot with: cloudroidctl explain ROBOT; and write rows with: cloudroidctl sla set --spread",
                    calls.join(", ")
                ),
            }
        }
        Ok(service)
    }
}

/// What cannot be used as it is given.
pub(super) fn unusable(detail: String) -> anyhow::Error {
    Problem {
        status: 400,
        detail,
        ..Problem::default()
    }
    .into()
}

/// Whether it is the machine that is too small, of all reasons why a servant is never admitted.
fn is_too_big(why: &str) -> bool {
    why.contains("does not fit on this machine")
}

/// What to do about a service that is not there.
fn unpublished(name: &str, is_directory: bool) -> impl FnOnce(anyhow::Error) -> anyhow::Error {
    let next = match is_directory {
        true => format!(
            "{name} is a directory here, and services are evaluated: publish it first with: cloudroidctl push {name}; or name one of those"
        ),
        false => format!(
            "name one of those, or publish the package first: cloudroidctl push DIRECTORY --name {name} (--apt {name}, where Debian has it)"
        ),
    };
    move |error| match error.downcast::<Problem>() {
        Ok(problem) if problem.status == 404 => Problem {
            next: Some(next),
            ..problem
        }
        .into(),
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
            let problem = Problem {
                status,
                next: Some("see the list".to_owned()),
                ..Problem::default()
            };
            let told = unpublished("people", is_directory)(problem.into());
            told.downcast::<Problem>()
                .expect("a problem")
                .next
                .unwrap_or_default()
        };
        assert!(of(404, false).contains("cloudroidctl push DIRECTORY --name people"));
        assert!(of(404, true).contains("people is a directory here"));
        assert_eq!(of(403, true), "see the list");
    }
}
