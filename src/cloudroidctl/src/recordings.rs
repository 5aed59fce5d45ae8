//! `recordings`: recordings of the last seconds of servants, which the daemon keeps.

use std::path::PathBuf;

use api::recordings::Recording;

use crate::client::{DaemonClient, percent_encode};
use crate::inside;
use crate::output::{self, OutputFormat, Table};

/// Manage ring-buffer recordings: the seconds in servants before their robots waited too long.
///
/// The daemon writes them if its configuration enables it ([black_box]).
#[derive(Debug, clap::Args)]
pub struct RecordingsArgs {
    #[command(subcommand)]
    verb: RecordingsCommand,
}

#[derive(Debug, clap::Subcommand)]
enum RecordingsCommand {
    List(ListRecordings),
    Get(GetRecording),
    Take(TakeRecording),
    Rm(RemoveRecording),
}

/// List recordings, newest first.
#[derive(Debug, clap::Args)]
struct ListRecordings {
    /// Only recordings of this service.
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// Only recordings of this robot.
    #[arg(long, value_name = "ID")]
    robot: Option<String>,
}

/// Download a recording: an MCAP file, like those of `cloudroidctl record`.
#[derive(Debug, clap::Args)]
struct GetRecording {
    /// Number of the recording.
    number: u64,
    /// Output file (default: recording-NUMBER.mcap). An existing file is replaced when the new one is complete.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Write the last seconds of a servant to a recording now. The daemon must have black boxes on ([black_box] seconds).
#[derive(Debug, clap::Args)]
struct TakeRecording {
    /// Id of the servant, or name of a service that has one servant.
    servant: String,
}

/// Remove a recording.
#[derive(Debug, clap::Args)]
struct RemoveRecording {
    /// Number of the recording.
    number: u64,
}

impl RecordingsArgs {
    /// Sends the requests and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        match self.verb {
            RecordingsCommand::List(verb) => verb.run(client, format).await,
            RecordingsCommand::Get(verb) => verb.run(client, format).await,
            RecordingsCommand::Take(verb) => {
                let servant = inside::resolve_servant(client, &verb.servant).await?;
                let path = format!("/api/v1/servants/{}/recording", percent_encode(&servant));
                let taken: Recording = client.post(&path, &()).await?;
                list(&[taken], format)
            }
            RecordingsCommand::Rm(verb) => {
                let path = format!("/api/v1/recordings/{}", verb.number);
                let left: Vec<Recording> = client.delete(&path).await?;
                list(&left, format)
            }
        }
    }
}

impl ListRecordings {
    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let asked = [("service", self.service), ("robot", self.robot)];
        let asked: Vec<String> =
            asked.into_iter().filter_map(|(name, value)| Some(format!("{name}={}", percent_encode(&value?)))).collect();
        let path = format!("/api/v1/recordings?{}", asked.join("&"));
        let all: Vec<Recording> = client.get(&path).await?;
        if all.is_empty() && format == OutputFormat::Table {
            if asked.is_empty() {
                // Who may list recordings may not always see the daemon's status.
                let status = client.get::<api::Status>("/api/v1/status").await;
                output::eprint_line(describe_none(status.is_ok_and(|status| status.black_box > 0.0)));
            } else {
                output::eprint_line("no recordings of that service and robot; omit --service and --robot to list all");
            }
        }
        list(&all, format)
    }
}

/// Returns the message for a daemon without recordings. One is taken only where black boxes are on.
fn describe_none(is_on: bool) -> &'static str {
    if is_on {
        "no recordings; the daemon writes one when a response comes later than the robot's limit; write one now with: \
            cloudroidctl recordings take SERVANT"
    } else {
        "no recordings, and black boxes are off; with seconds in [black_box] of its configuration, the daemon writes \
            one when a response comes later than the robot's limit"
    }
}

impl GetRecording {
    async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let target = self.output.unwrap_or_else(|| PathBuf::from(format!("recording-{}.mcap", self.number)));
        let path = format!("/api/v1/recordings/{}", self.number);
        let bytes = client.download(&path, &target).await?;
        match format {
            OutputFormat::Json => output::json(&serde_json::json!({ "path": target, "bytes": bytes })),
            OutputFormat::Table => output::line(&format!("{} ({})", target.display(), api::Size(bytes))),
        }
    }
}

fn list(all: &[Recording], format: OutputFormat) -> anyhow::Result<()> {
    if format == OutputFormat::Json {
        return output::json(&all);
    }
    if all.is_empty() {
        return Ok(());
    }
    let mut table = Table::new(&["NUMBER", "TIME", "SERVICE", "ROBOT", "SECONDS", "MESSAGES", "SIZE", "WHY"]);
    for one in all {
        table.row([
            one.number.to_string(),
            output::clock(one.time),
            one.service.clone(),
            one.robot.clone(),
            format!("{:.1}", one.seconds),
            one.messages.to_string(),
            one.bytes.to_string(),
            one.why.clone(),
        ]);
    }
    table.print_list("")
}
