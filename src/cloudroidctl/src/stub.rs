//! `stub`: fetches what a robot installs in a package's place.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, bail};
use api::Stubs;
use api::stub::{ARCHITECTURE, ARCHIVE, SIGNATURE, SIGNER, architecture};
use hyper::Method;
use sign::PublicKey;

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
    /// The server's key, which the archive has to be signed by ("ssh-ed25519 AAAA…"); what the server says by default.
    #[arg(long, value_name = "KEY")]
    key: Option<PublicKey>,
}

/// What was fetched.
#[derive(serde::Serialize)]
struct Fetched {
    service: String,
    architecture: String,
    path: PathBuf,
    bytes: u64,
    signature: PathBuf,
    key: String,
}

impl Stub {
    /// Asks and writes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let Some(service) = &self.service else {
            return list(client, format).await;
        };
        let key = match self.key {
            Some(key) => key,
            None => {
                let stubs: Stubs = client.get("/stubs").await?;
                if stubs.key.is_empty() {
                    bail!("this server signs no stubs: it is of an earlier version; update it");
                }
                stubs.key.parse().context("the server's key")?
            }
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
        let signature = answer
            .headers()
            .get(SIGNATURE)
            .and_then(|value| value.to_str().ok())
            .map(sign::in_lines)
            .context("the archive is not signed: the server is of an earlier version; update it")?;
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
        let digest = std::fs::File::open(&half)
            .and_then(|mut file| sign::digest(&mut file))
            .with_context(failed)?;
        if let Err(refused) = key.verify(ARCHIVE, &digest, &signature) {
            let _ = std::fs::remove_file(&half);
            return Err(anyhow::Error::new(refused).context(format!(
                "the archive of {service} is not what a server with the key {key} signed; nothing was written"
            )));
        }
        let beside = self.output.join(format!("{service}.tar.gz.sig"));
        std::fs::write(&beside, signature)
            .with_context(|| format!("cannot write {}", beside.display()))?;
        std::fs::rename(&half, &target).with_context(failed)?;
        let fetched = Fetched {
            service: service.clone(),
            architecture,
            path: target,
            bytes,
            signature: beside,
            key: key.to_string(),
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
                output::line(&format!("signed by {key}"))?;
                output::line("on the robot, with both files:")?;
                output::line(&format!("  {}", to_install(service, key)))
            }
        }
    }
}

/// Verifies the archive before anything of it runs, and has what follows verified by the same key.
fn to_install(service: &str, key: PublicKey) -> String {
    format!(
        "echo '{}' > server.pub && ssh-keygen -Y verify -f server.pub -I {SIGNER} -n {ARCHIVE} -s {service}.tar.gz.sig < {service}.tar.gz \
         && tar xzf {service}.tar.gz && sh {service}-stub/install.sh --key server.pub",
        key.signer()
    )
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
            output::line(&format!("signed by      {}", stubs.key))?;
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
