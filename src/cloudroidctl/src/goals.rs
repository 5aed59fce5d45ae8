//! `goals`: the goals of a servant's actions and their outcomes.

use api::goals::Goal;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat, Table};

/// Print the goals that were sent to a servant's actions and their outcomes, newest first.
#[derive(Debug, clap::Args)]
pub struct GoalsArgs {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
}

impl GoalsArgs {
    /// Sends the request and prints the goals.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let servant = inside::resolve_servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}/goals", percent_encode(&servant));
        let goals: Vec<Goal> = client.get(&path).await?;
        if format == OutputFormat::Json {
            return output::json(&goals);
        }
        if goals.is_empty() {
            output::eprint_line("no goals yet, or the service has no actions");
            return Ok(());
        }
        let mut table = Table::new(&["ACTION", "SENT BY", "AT", "OUTCOME", "AFTER", "SAID"]);
        for goal in goals {
            // The duration is unknown if only the end of the goal was observed.
            let took = goal.ended.map(|ended| ended.saturating_sub(goal.began));
            let took = took.filter(|took| *took > 0);
            table.row([
                goal.action,
                goal.by,
                output::clock(goal.began),
                goal.state.to_string(),
                took.map_or_else(String::new, |took| format!("{:.1} s", took as f64 / 1e3)),
                goal.text,
            ]);
        }
        table.print()
    }
}
