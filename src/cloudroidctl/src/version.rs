//! `version`: the versions of this program and of the daemon.

use serde::Serialize;

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat};

/// Show the versions of cloudroidctl and of the daemon.
#[derive(Debug, clap::Args)]
pub struct VersionArgs {}

/// The versions; without a daemon's if none answers.
#[derive(Debug, Serialize)]
struct Versions {
    cloudroidctl: &'static str,
    cloudroidd: Option<String>,
}

impl VersionArgs {
    /// Asks the daemon and prints both versions. A daemon that does not answer is no error.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let answer = client.get::<api::Status>("/api/v1/status").await;
        let why = answer.as_ref().err().map(|error| format!("{error:#}"));
        let versions =
            Versions { cloudroidctl: env!("CARGO_PKG_VERSION"), cloudroidd: answer.ok().map(|status| status.version) };
        match format {
            OutputFormat::Json => output::json(&versions),
            OutputFormat::Table => {
                output::line(&format!("cloudroidctl {}", versions.cloudroidctl))?;
                match (versions.cloudroidd, why) {
                    (Some(version), _) => output::line(&format!("cloudroidd {version}")),
                    (None, why) => output::line(&format!("cloudroidd unknown: {}", why.unwrap_or_default())),
                }
            }
        }
    }
}
