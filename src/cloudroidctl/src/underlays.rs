//! `underlays`: compiled workspaces that other packages are compiled and run upon.

use api::{StandingService, Underlay};

use crate::client::{DaemonClient, percent_encode};
use crate::output::{self, OutputFormat, Table};

/// List and remove underlays, which packages are compiled and run upon.
///
/// `cloudroidctl push WORKSPACE --as-underlay NAME` publishes one; `cloudroidctl push PACKAGE --on NAME` stands on it.
#[derive(Debug, clap::Args)]
pub struct UnderlaysArgs {
    #[command(subcommand)]
    verb: Option<UnderlaysCommand>,
}

#[derive(Debug, clap::Subcommand)]
enum UnderlaysCommand {
    List(ListUnderlays),
    #[command(visible_alias = "remove")]
    Rm(RemoveUnderlay),
}

/// List underlays, and the services that stand on them (the default).
#[derive(Debug, clap::Args)]
struct ListUnderlays {}

/// Remove an underlay on which no service stands.
#[derive(Debug, clap::Args)]
struct RemoveUnderlay {
    /// Name of the underlay.
    name: String,
}

impl UnderlaysArgs {
    /// Sends the request and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb.unwrap_or(UnderlaysCommand::List(ListUnderlays {})) {
            UnderlaysCommand::List(_) => list(&client.get::<Vec<Underlay>>("/api/v1/underlays").await?, format),
            UnderlaysCommand::Rm(verb) => {
                let path = format!("/api/v1/underlays/{}", percent_encode(&verb.name));
                let removed: Underlay = client.delete(&path).await?;
                match format {
                    OutputFormat::Json => output::json(&removed),
                    OutputFormat::Table => output::line(&format!("underlay {} is removed", removed.name)),
                }
            }
        }
    }
}

fn list(all: &[Underlay], format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(&all);
    }
    let mut table = Table::new(&["NAME", "REVISION", "BASE", "PACKAGES", "SIZE", "SERVICES"]);
    for one in all {
        table.row([
            one.name.clone(),
            one.revision.to_string(),
            one.base.clone(),
            one.packages.len().to_string(),
            one.bytes.to_string(),
            format_services(&one.services, one.revision),
        ]);
    }
    table.print_list("no underlays")
}

/// Names the services, those on an earlier revision with its number.
fn format_services(services: &[StandingService], revision: u64) -> String {
    let name = |one: &StandingService| match one.on {
        on if on == revision => one.service.clone(),
        on => format!("{} (revision {on})", one.service),
    };
    let names: Vec<String> = services.iter().map(name).collect();
    if names.is_empty() { "-".to_owned() } else { names.join(", ") }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        underlays: UnderlaysArgs,
    }

    #[test]
    fn without_a_verb_underlays_are_listed() {
        let parse =
            |words: &[&str]| Line::try_parse_from([&["underlays"][..], words].concat()).map(|line| line.underlays.verb);
        assert!(matches!(parse(&[]), Ok(None)) && matches!(parse(&["list"]), Ok(Some(UnderlaysCommand::List(_)))));
        for verb in ["rm", "remove"] {
            let Ok(Some(UnderlaysCommand::Rm(verb))) = parse(&[verb, "maps"]) else { panic!("{verb}") };
            assert_eq!(verb.name, "maps");
        }
        assert!(parse(&["rm"]).is_err());
    }

    #[test]
    fn services_on_an_earlier_revision_are_told_apart() {
        let on = |service: &str, on| StandingService { service: service.to_owned(), on };
        assert_eq!(format_services(&[on("nav", 2), on("slam", 1)], 2), "nav, slam (revision 1)");
        assert_eq!(format_services(&[], 2), "-");
    }
}
