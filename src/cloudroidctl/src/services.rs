//! `services`: lists published services.

use api::{Group, ServiceDetail, ServiceSummary, Shared};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputChoice, OutputFormat, Table, count};

/// List the published services, or show one with its interface and revisions.
#[derive(Debug, clap::Args)]
pub struct ServicesArgs {
    /// Show only this service, with all details.
    service: Option<String>,
}

impl ServicesArgs {
    /// Sends the request and prints the services.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.service {
            Some(name) => {
                let service: ServiceDetail = client.get(&format!("/api/v1/services/{}", percent_encode(&name))).await?;
                match format {
                    OutputFormat::Json => output::json(&service),
                    OutputFormat::Table if OutputChoice::current() == OutputChoice::Name => {
                        output::line(&service.summary.name)
                    }
                    OutputFormat::Table => show(&service),
                }
            }
            None => {
                let services: Vec<ServiceSummary> = client.get("/api/v1/services").await?;
                match format {
                    OutputFormat::Json => output::json(&services),
                    OutputFormat::Table => list(&services),
                }
            }
        }
    }
}

fn list(services: &[ServiceSummary]) -> anyhow::Result<()> {
    let headings = ["SERVICE", "REVISION", "PUBLISHED", "SERVANTS", "LIMITS", "ADDRESS"];
    let mut table = Table::new(&headings).hide_unless_wide(&["LIMITS"]);
    for service in services {
        table.row([
            service.name.clone(),
            service.revision.to_string(),
            output::age(service.published) + " ago",
            service.servants.to_string(),
            output::limits(&service.limits),
            service.address.clone(),
        ]);
    }
    table.print_list("no services; publish one with: cloudroidctl push PATH, or push --apt NAME")
}

/// Prints the details of a service. Also used at the end of a push.
pub fn show(service: &ServiceDetail) -> anyhow::Result<()> {
    let summary = &service.summary;
    output::line(&format!("{}, revision {}: {}", summary.name, summary.revision, summary.address))?;
    let mut nodes = Table::new(&["NODE", "PROGRAM"]);
    for node in &service.nodes {
        nodes.row([node.name.clone(), node.argv.join(" ")]);
    }
    let mut topics = Table::new(&["TOPIC", "TYPE", "DIRECTION", ""]);
    for topic in &service.interface.topics {
        let direction = match topic.direction {
            api::interface::Direction::Input => "input",
            api::interface::Direction::Output => "output",
        };
        let marks = [(topic.latched, "latched"), (topic.lazy, "lazy")];
        let marks = marks.iter().filter(|(set, _)| *set);
        let marks = marks.map(|(_, mark)| (*mark).to_owned());
        let qos = topic.qos.map(|qos| qos.to_string());
        let marks: Vec<String> = marks.chain(qos).collect();
        topics.row([topic.name.clone(), topic.type_name.clone(), direction.to_owned(), marks.join(", ")]);
    }
    let mut services = Table::new(&["SERVICE", "TYPE"]);
    for entry in &service.interface.services {
        services.row([entry.name.clone(), entry.type_name.clone()]);
    }
    let mut actions = Table::new(&["ACTION", "TYPE"]);
    for entry in &service.interface.actions {
        actions.row([entry.name.clone(), entry.type_name.clone()]);
    }
    let mut requests = Table::new(&["REQUEST", "ANSWERED ON", "BY", ""]);
    for entry in &service.interface.requests {
        requests.row([entry.input.clone(), entry.outputs.join(", "), entry.by.clone(), entry.reason.clone()]);
    }
    let mut needs = Table::new(&["NEEDS", "CALLED BY"]);
    for entry in &service.interface.needs {
        needs.row([entry.name.clone(), entry.nodes.join(", ")]);
    }
    let mut lifecycle = Table::new(&["LIFECYCLE NODE"]);
    for node in &service.interface.lifecycle {
        lifecycle.row([node.clone()]);
    }
    let mut parameters = Table::new(&["PARAMETER", "VALUE", ""]);
    for entry in &service.interface.parameters {
        parameters.row([
            entry.name.clone(),
            entry.value.as_ref().map(shorten).unwrap_or_default(),
            entry.descriptor.as_ref().map(ToString::to_string).unwrap_or_default(),
        ]);
    }
    let mut revisions = Table::new(&["REVISION", "PUBLISHED", "", "SOURCE", "IMAGE"]);
    for revision in &service.revisions {
        revisions.row([
            revision.number.to_string(),
            output::age(revision.published) + " ago",
            if revision.current { "current" } else { "" }.to_owned(),
            revision.source.clone(),
            revision.image.chars().take("sha256:".len() + 12).collect(),
        ]);
    }
    if let Some(shared) = &service.shared {
        output::line(&shared_in_words(shared))?;
    }
    for group in &service.groups {
        output::line(&group_in_words(group))?;
    }
    for table in [&nodes, &topics, &requests, &services, &needs, &actions, &lifecycle, &parameters, &revisions] {
        if !table.is_empty() {
            output::line("")?;
            table.print()?;
        }
    }
    Ok(())
}

fn shared_in_words(shared: &Shared) -> String {
    let mut words = format!("robots share {} to {}", shared.min, count(shared.max, "servant"));
    if shared.replicas > 1 {
        words += &format!(", {} per call", shared.replicas);
    } else if shared.idempotent {
        words += ", requests are retried";
    }
    words
}

fn group_in_words(group: &Group) -> String {
    let Group { revision, robots, answered, failed, asked_again, wasted, waiting, .. } = group;
    let ready = group.servants.iter().filter(|one| one.ready && !one.retiring).count();
    let under_way: usize = group.servants.iter().map(|one| one.under_way).sum();
    let mut words = format!(
        "revision {revision}: {}, {ready} of {} ready; {} in progress, {waiting} waiting; {answered} answered, \
            {failed} failed, {asked_again} retried",
        count(*robots, "robot"),
        count(group.servants.len(), "servant"),
        count(under_way, "request"),
    );
    if *wasted > 0 {
        words += &format!("; {wasted} of {} answers unused", answered + wasted);
    }
    if let Some(mean) = group.mean_ms {
        words += &format!("; mean {mean:.1} ms");
    }
    words
}

fn shorten(value: &serde_json::Value) -> String {
    let text = value.to_string();
    if text.chars().count() <= 60 { text } else { text.chars().take(57).chain("...".chars()).collect() }
}
