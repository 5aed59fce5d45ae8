//! `policy`: what principals may use of services.

use api::access::{NewRule, Rule};

use crate::client::Client;
use crate::output::{self, Format, Table};

/// Say what robots and others may use of a service: which topics, services and actions. Changes hold at once.
#[derive(Debug, clap::Args)]
pub struct Policy {
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, clap::Subcommand)]
enum Verb {
    List(List),
    Allow(Allow),
    Rm(Rm),
}

/// List the rules.
#[derive(Debug, clap::Args)]
struct List;

/// Write a rule. One that names a principal stands in place of those of its role; what no rule grants is refused.
#[derive(Debug, clap::Args)]
struct Allow {
    /// For whom: the name of a token, or role:robot, role:deployer, role:viewer.
    who: String,
    /// What: OPERATION:NAME with publish, subscribe, call, advertise or *, such as subscribe:/camera/** or call:/detect. None
    /// grants nothing.
    grants: Vec<String>,
    /// Service for which it is, or a pattern.
    #[arg(long, default_value = "*", value_name = "NAME")]
    service: String,
}

/// Remove rules by their numbers.
#[derive(Debug, clap::Args)]
struct Rm {
    /// Numbers of rules, as `policy list` shows them.
    #[arg(required = true)]
    rules: Vec<i64>,
}

impl Policy {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let rules: Vec<Rule> = match self.verb {
            Verb::List(List) => client.get("/api/v1/policy").await?,
            Verb::Allow(verb) => {
                let new = NewRule {
                    who: verb.who.parse()?,
                    services: verb.service.parse()?,
                    allow: verb
                        .grants
                        .iter()
                        .map(|text| text.parse())
                        .collect::<Result<_, _>>()?,
                };
                client.post("/api/v1/policy", &new).await?
            }
            Verb::Rm(verb) => {
                let mut left = Vec::new();
                for rule in &verb.rules {
                    left = client.delete(&format!("/api/v1/policy/{rule}")).await?;
                }
                left
            }
        };
        list(&rules, format)
    }
}

fn list(rules: &[Rule], format: Format) -> anyhow::Result<()> {
    if let Format::Json = format {
        return output::json(&rules);
    }
    let mut table = Table::new(&["RULE", "WHO", "SERVICES", "ALLOW"]);
    for rule in rules {
        let grants: Vec<String> = rule.allow.iter().map(ToString::to_string).collect();
        table.row([
            rule.id.to_string(),
            rule.who.to_string(),
            rule.services.to_string(),
            match grants.is_empty() {
                true => "nothing".into(),
                false => grants.join(" "),
            },
        ]);
    }
    match table.is_empty() {
        true => output::line(
            "there are no rules: robots and deployers may use nothing; grant something with: cloudroidctl policy allow",
        ),
        false => table.print(),
    }
}
