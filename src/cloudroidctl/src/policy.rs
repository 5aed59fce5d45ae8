//! `policy`: rules for what principals may use of services.

use api::access::{NewRule, Rule};

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat, Table};

/// Manage the policy: which topics, services and actions robots and others may use. Changes take effect at once.
#[derive(Debug, clap::Args)]
pub struct PolicyArgs {
    #[command(subcommand)]
    verb: PolicyCommand,
}

#[derive(Debug, clap::Subcommand)]
enum PolicyCommand {
    List(ListRules),
    Allow(AllowRule),
    Rm(RemoveRules),
}

/// List the rules.
#[derive(Debug, clap::Args)]
struct ListRules;

/// Add a rule. Rules for a principal replace those of its role; anything without a rule is refused.
#[derive(Debug, clap::Args)]
struct AllowRule {
    /// Principal: the name of a token, or role:robot, role:deployer, role:viewer.
    who: String,
    /// Grants: OPERATION:NAME with publish, subscribe, call, advertise or *, such as subscribe:/camera/** or
    /// call:/detect. Without any, nothing is granted.
    grants: Vec<String>,
    /// Service that the rule applies to, or a pattern.
    #[arg(long, default_value = "*", value_name = "NAME")]
    service: String,
}

/// Remove rules by their ids.
#[derive(Debug, clap::Args)]
struct RemoveRules {
    /// Ids of rules, as shown by `policy list`.
    #[arg(required = true)]
    rules: Vec<i64>,
}

impl PolicyArgs {
    /// Sends the request and prints the rules.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let rules: Vec<Rule> = match self.verb {
            PolicyCommand::List(ListRules) => client.get("/api/v1/policy").await?,
            PolicyCommand::Allow(verb) => {
                let new = NewRule {
                    who: verb.who.parse()?,
                    services: verb.service.parse()?,
                    allow: verb.grants.iter().map(|text| text.parse()).collect::<Result<_, _>>()?,
                };
                client.post("/api/v1/policy", &new).await?
            }
            PolicyCommand::Rm(verb) => {
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

fn list(rules: &[Rule], format: OutputFormat) -> anyhow::Result<()> {
    if let OutputFormat::Json = format {
        return output::json(&rules);
    }
    let mut table = Table::new(&["RULE", "WHO", "SERVICES", "ALLOW"]);
    for rule in rules {
        let grants: Vec<String> = rule.allow.iter().map(ToString::to_string).collect();
        table.row([
            rule.id.to_string(),
            rule.who.to_string(),
            rule.services.to_string(),
            if grants.is_empty() { "nothing".into() } else { grants.join(" ") },
        ]);
    }
    table.print_list("no rules: robots and deployers have no access; grant it with: cloudroidctl policy allow")
}
