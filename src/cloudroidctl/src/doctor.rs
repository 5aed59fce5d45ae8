//! `doctor`: checks the host. A running daemon is asked; without one, its program makes the checks.

use std::path::PathBuf;
use std::process::Stdio;

use anyhow::{Context, bail};
use api::{Check, CheckStatus};

use crate::client::{DaemonClient, DaemonUnreachable};
use crate::output::{self, OutputFormat, Table};

/// Check that this machine can run servants, and show how to fix what is missing.
#[derive(Debug, clap::Args)]
pub struct DoctorArgs {}

impl DoctorArgs {
    /// Runs the checks and prints them; fails if something is missing.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let doctor: api::Doctor = match client.get("/api/v1/doctor").await {
            Err(error) if error.is::<DaemonUnreachable>() => check_without_daemon(&error).await?,
            answer => answer?,
        };
        match format {
            OutputFormat::Json => output::json(&doctor)?,
            OutputFormat::Table => show(&doctor)?,
        }
        if !doctor.is_healthy() {
            let missing: Vec<&str> = doctor
                .checks
                .iter()
                .filter(|check| check.status == CheckStatus::Missing)
                .map(|check| check.name.as_str())
                .collect();
            bail!("missing: {}", missing.join(", "));
        }
        Ok(())
    }
}

async fn check_without_daemon(unreachable: &anyhow::Error) -> anyhow::Result<api::Doctor> {
    let beside = std::env::current_exe().ok().and_then(|path| Some(path.parent()?.join("cloudroidd")));
    let program = beside.filter(|path| path.exists()).unwrap_or_else(|| PathBuf::from("cloudroidd"));
    let output = tokio::process::Command::new(&program)
        .args(["doctor", "--json"])
        .stdin(Stdio::null())
        .stderr(Stdio::inherit())
        .output()
        .await
        .with_context(|| format!("{unreachable}; cannot run {} to check without the daemon", program.display()))?;
    let mut doctor: api::Doctor = serde_json::from_slice(&output.stdout)
        .with_context(|| format!("the output of {} doctor --json is not valid", program.display()))?;
    doctor.checks.push(Check {
        name: "daemon".to_owned(),
        status: CheckStatus::Warning,
        found: "not running".to_owned(),
        fix: Some(format!("sudo {}", program.display())),
    });
    Ok(doctor)
}

fn show(doctor: &api::Doctor) -> anyhow::Result<()> {
    let mut table = Table::new(&["STATE", "NEED", "FOUND"]);
    for check in &doctor.checks {
        let mark = match check.status {
            CheckStatus::Ok => "ok",
            CheckStatus::Warning => "warning",
            CheckStatus::Missing => "MISSING",
        };
        table.row([mark.to_owned(), check.name.clone(), check.found.clone()]);
    }
    table.print()?;
    let fixable = doctor.checks.iter().filter(|check| check.status != CheckStatus::Ok);
    for check in fixable {
        if let Some(fix) = &check.fix {
            output::line(&format!("\nto fix {}:\n    {fix}", check.name))?;
        }
    }
    Ok(())
}
