//! `try`: what a package makes of a recording or a picture, before a robot is touched.

use std::path::{Path, PathBuf};

use anyhow::Context;
use api::Stopped;
use api::trial::{Fed, Trial};
use http_body_util::{BodyExt, Full};
use hyper::Method;

use crate::client::{self, Client};
use crate::output::{self, Format, Table};
use crate::push::Push;

/// Try a package on a recording or a picture: show what it answers and how fast, and suggest T_desire and T_max.
///
/// It is built and started as by push, but under a name of its own that is gone afterwards.
#[derive(Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("material").required(true).args(["bag", "image"])))]
pub struct Try {
    #[command(flatten)]
    push: Push,
    /// A recording of its inputs: a rosbag file, not compressed.
    #[arg(long, value_name = "FILE")]
    bag: Option<PathBuf>,
    /// A picture for its camera inputs: a PNG file.
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
}

impl Try {
    /// Pushes, tries, removes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let (kind, path) = match (&self.bag, &self.image) {
            (Some(path), _) => ("bag", path),
            (None, Some(path)) => ("image", path),
            (None, None) => anyhow::bail!("say with what to try it: --bag FILE or --image FILE"),
        };
        // Before minutes are spent on building.
        let material =
            std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let name = format!("try-{}", std::process::id());
        let tried = async {
            self.push.under(&name, client, format).await?;
            ask(client, &name, kind, material).await
        };
        let tried = tokio::select! {
            tried = tried => tried,
            _ = tokio::signal::ctrl_c() => Err(anyhow::anyhow!("cancelled")),
        };
        // There is none where the push failed.
        let removed = client
            .delete::<Stopped>(&format!("/api/v1/services/{name}"))
            .await;
        let trial = tried?;
        removed.with_context(|| format!("the trial's service is left: cloudroidctl rm {name}"))?;
        match format {
            Format::Json => output::json(&trial),
            Format::Table => print(&trial, path),
        }
    }
}

async fn ask(client: &Client, name: &str, kind: &str, material: Vec<u8>) -> anyhow::Result<Trial> {
    let body = Full::new(material.into())
        .map_err(|never| match never {})
        .boxed_unsync();
    let path = format!("/api/v1/services/{name}/trial?kind={kind}");
    client::read(client.send(Method::POST, &path, body).await?).await
}

fn print(trial: &Trial, path: &Path) -> anyhow::Result<()> {
    let mut table = Table::new(&["TOPIC", "TYPE", "", "LAST"]);
    for input in &trial.inputs {
        table.row([
            input.topic.clone(),
            input.type_name.clone(),
            format!("{} sent", input.sent),
            String::new(),
        ]);
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
    for words in renamed(&trial.inputs) {
        output::line(&words)?;
    }
    if !trial.unused.is_empty() {
        let unused = trial.unused.join(", ");
        output::line(&format!("not used of {}: {unused}", path.display()))?;
    }
    let Some(rrt) = trial.rrt else {
        return output::line(&format!(
            "none of {} requests was answered: look whether an input is missing, or a parameter",
            trial.requests
        ));
    };
    output::line(&format!(
        "{} of {} requests answered; response times {:.1} ms (median), {:.1} ms (90 %), {:.1} ms (longest)",
        trial.answered, trial.requests, rrt.p50, rrt.p90, rrt.max
    ))?;
    output::line(&format!(
        "to begin with: desire = {:.3}, max = {:.3} (seconds; add the round trip of the robot's network)",
        rrt.desire / 1000.0,
        rrt.acceptable / 1000.0
    ))
}

/// Which topics of the recording went to inputs of other names.
pub fn renamed(inputs: &[Fed]) -> impl Iterator<Item = String> {
    let renamed = inputs.iter().filter(|input| !input.from.is_empty());
    renamed.map(|input| {
        format!(
            "{} of the recording went to {}, the only input of type {}",
            input.from.join(", "),
            input.topic,
            input.type_name
        )
    })
}
