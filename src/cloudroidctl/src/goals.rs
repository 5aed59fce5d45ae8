//! `goals`: what became of the goals of a servant's actions.

use api::goals::Goal;

use crate::client::{Client, escaped};
use crate::inside;
use crate::output::{self, Format, Table};

/// Print what became of the goals that a servant's actions were sent, the newest first.
#[derive(Debug, clap::Args)]
pub struct Goals {
    /// The servant's id, or the name of a service that has one servant.
    servant: String,
}

impl Goals {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let servant = inside::servant(client, &self.servant).await?;
        let path = format!("/api/v1/servants/{}/goals", escaped(&servant));
        let goals: Vec<Goal> = client.get(&path).await?;
        if format == Format::Json {
            return output::json(&goals);
        }
        if goals.is_empty() {
            output::complain("its actions were sent no goal yet, or it has none");
            return Ok(());
        }
        let mut table = Table::new(&["ACTION", "SENT BY", "AT", "OUTCOME", "AFTER", "SAID"]);
        for goal in goals {
            // Of one of which only the end was heard nobody knows.
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
