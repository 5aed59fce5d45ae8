//! `stub`: fetches what a robot installs in a package's place.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, bail};
use api::Stubs;
use api::stub::{ARCHITECTURE, architecture};
use hyper::Method;

use crate::client::{Client, empty, escaped};
use crate::output::{self, Format};

/// Fetch the stub of a service: the package that a robot installs in the original's place.
#[derive(Debug, clap::Args)]
pub struct Stub {
    /// The service. Without one: which services and architectures there are stubs for.
    service: Option<String>,
    /// Directory to write NAME.tar.gz into.
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
    /// The robot's architecture, as `uname -m` says it there; this machine's by default.
    #[arg(long, value_name = "ARCH")]
    arch: Option<String>,
}

/// What was fetched.
#[derive(serde::Serialize)]
struct Fetched {
    service: String,
    architecture: String,
    path: PathBuf,
    bytes: u64,
}

impl Stub {
    /// Asks and writes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let Some(service) = &self.service else {
            return list(client, format).await;
        };
        let asked = self.arch.as_deref().unwrap_or(std::env::consts::ARCH);
        let path = format!(
            "/stubs/{}.tar.gz?arch={}",
            escaped(service),
            escaped(architecture(asked).unwrap_or(asked))
        );
        let mut answer = client.send(Method::GET, &path, empty()).await?;
        let architecture = answer
            .headers()
            .get(ARCHITECTURE)
            .and_then(|value| value.to_str().ok())
            .unwrap_or(asked)
            .to_owned();
        let target = self.output.join(format!("{service}.tar.gz"));
        let failed = || format!("cannot write {}", target.display());
        std::fs::create_dir_all(&self.output).with_context(failed)?;
        // Whole or not at all: an earlier one stays until this one is there.
        let half = self.output.join(format!(".{service}.tar.gz.part"));
        let mut file = std::fs::File::create(&half).with_context(failed)?;
        let mut bytes = 0;
        while let Some(frame) = http_body_util::BodyExt::frame(answer.body_mut()).await {
            let frame = frame.context("the daemon broke off its answer")?;
            if let Some(data) = frame.data_ref() {
                file.write_all(data).with_context(failed)?;
                bytes += data.len() as u64;
            }
        }
        if bytes == 0 {
            bail!("the daemon sent an empty archive");
        }
        file.sync_all().with_context(failed)?;
        std::fs::rename(&half, &target).with_context(failed)?;
        let fetched = Fetched {
            service: service.clone(),
            architecture,
            path: target,
            bytes,
        };
        match format {
            Format::Json => output::json(&fetched),
            Format::Table => {
                output::line(&format!(
                    "{} for {} ({})",
                    fetched.path.display(),
                    fetched.architecture,
                    api::Size(fetched.bytes)
                ))?;
                output::line(&format!(
                    "on the robot:  tar xzf {service}.tar.gz && sh {service}-stub/install.sh"
                ))
            }
        }
    }
}

async fn list(client: &Client, format: Format) -> anyhow::Result<()> {
    let stubs: Stubs = client.get("/stubs").await?;
    let list = |names: &[String]| match names.len() {
        0 => "none".to_owned(),
        _ => names.join(", "),
    };
    match format {
        Format::Json => output::json(&stubs),
        Format::Table => {
            output::line(&format!("services       {}", list(&stubs.services)))?;
            output::line(&format!("architectures  {}", list(&stubs.architectures)))?;
            if stubs.lacking.is_empty() {
                return Ok(());
            }
            output::line(&format!(
                "lacking        {} (make stub-cross builds them)",
                list(&stubs.lacking)
            ))
        }
    }
}
