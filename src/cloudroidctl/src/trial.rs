//! `try`: runs a package on a recording or an image, before it is used by a robot.

use std::path::{Path, PathBuf};

use anyhow::Context;
use api::Stopped;
use api::trial::{Fed, Trial};
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::client::{self, DaemonClient};
use crate::output::{self, OutputFormat, Table, count};
use crate::push::PushArgs;

/// Try a package on a recording or an image: show its answers and response times, and suggest T_desire and T_max.
///
/// It is built and started as by push, but under a temporary name, and removed afterwards.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("material").required(true).args(["bag", "image"])))]
pub struct TryArgs {
    #[command(flatten)]
    push: PushArgs,
    /// Recording of the package's inputs: an uncompressed rosbag file.
    #[arg(long, value_name = "FILE")]
    bag: Option<PathBuf>,
    /// Image for the package's camera inputs: a PNG file.
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
}

impl TryArgs {
    /// Pushes the package, runs the trial, removes the service and prints the result.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let (kind, path) = match (&self.bag, &self.image) {
            (Some(path), _) => ("bag", path),
            (None, Some(path)) => ("image", path),
            (None, None) => anyhow::bail!("no input given; pass --bag FILE or --image FILE"),
        };
        // Read the file before minutes are spent on building.
        let material = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let name = format!("try-{}", std::process::id());
        let tried = match self.push.publish_as(&name, client, format).await {
            Ok(()) => tokio::select! {
                tried = run_trial(client, &name, kind, material) => tried,
                _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("cancelled")),
            },
            Err(error) => Err(error),
        };
        // There is no service if the push failed.
        let removed = client.delete::<Stopped>(&format!("/api/v1/services/{name}")).await;
        let trial = tried?;
        removed
            .with_context(|| format!("cannot remove the trial's service; remove it with: cloudroidctl rm {name}"))?;
        match format {
            OutputFormat::Json => output::json(&trial),
            OutputFormat::Table => print(&trial, path),
        }
    }
}

async fn run_trial(client: &DaemonClient, name: &str, kind: &str, material: Vec<u8>) -> anyhow::Result<Trial> {
    let body = Full::new(material.into()).map_err(|never| match never {}).boxed_unsync();
    let path = format!("/api/v1/services/{name}/trial?kind={kind}");
    client::read_json(client.send(Method::POST, &path, body).await?).await
}

fn print(trial: &Trial, path: &Path) -> anyhow::Result<()> {
    let mut table = Table::new(&["TOPIC", "TYPE", "", "LAST"]);
    for input in &trial.inputs {
        table.row([input.topic.clone(), input.type_name.clone(), format!("{} sent", input.sent), String::new()]);
    }
    for output in &trial.outputs {
        let last = output.last.as_ref().map(ToString::to_string);
        table.row([
            output.topic.clone(),
            output.type_name.clone(),
            format!("{} heard", output.received),
            last.unwrap_or_else(|| format!("{} bytes", output.bytes)),
        ]);
    }
    output::line("")?;
    table.print()?;
    for words in describe_renamed_topics(&trial.inputs) {
        output::line(&words)?;
    }
    if !trial.unused.is_empty() {
        let unused = trial.unused.join(", ");
        output::line(&format!("not used of {}: {unused}", path.display()))?;
    }
    let Some(rrt) = trial.rrt else {
        return output::line(&format!(
            "none of {} was answered: check whether an input or a parameter is missing",
            count(trial.requests, "request")
        ));
    };
    output::line(&format!(
        "{} of {} answered; response times p50 {:.1} ms, p90 {:.1} ms, max {:.1} ms",
        trial.answered,
        count(trial.requests, "request"),
        rrt.p50,
        rrt.p90,
        rrt.max
    ))?;
    output::line(&format!(
        "initial values: desire = {:.3}, max = {:.3} (seconds; add the robot's network round trip)",
        rrt.desire / 1000.0,
        rrt.acceptable / 1000.0
    ))
}

/// Describes the topics of the recording that went to inputs of other names.
pub fn describe_renamed_topics(inputs: &[Fed]) -> impl Iterator<Item = String> {
    let renamed = inputs.iter().filter(|input| !input.from.is_empty());
    renamed.map(|input| {
        format!(
            "{} of the recording was sent to {}, the only input of type {}",
            input.from.join(", "),
            input.topic,
            input.type_name
        )
    })
}
