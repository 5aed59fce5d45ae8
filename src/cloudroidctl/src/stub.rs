//! `stub`: downloads the package that a robot installs in place of the original.

use std::io::Write;
use std::path::PathBuf;

use anyhow::{Context, bail};
use api::Stubs;
use api::stub::{ARCHITECTURE, ARCHIVE, ROS, SIGNATURE, SIGNER, parse_architecture};
use hyper::Method;
use sign::PublicKey;

use crate::client::{DaemonClient, empty_body, percent_encode};
use crate::output::{self, OutputFormat};

/// Download the stub of a service: the package that a robot installs in place of the original.
#[derive(Debug, clap::Args)]
pub struct StubArgs {
    /// Service of the stub. Without one, lists the services and architectures that have stubs.
    service: Option<String>,
    /// Output directory for NAME.tar.gz.
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
    /// Architecture of the robot, as printed by `uname -m` (default: this machine's).
    #[arg(long, value_name = "ARCH")]
    arch: Option<String>,
    /// ROS version of the robot (default: the one set up in this shell, by ROS_VERSION; otherwise the service's).
    /// Messages are translated if it is not the service's.
    #[arg(long, value_name = "1|2", value_parser = clap::value_parser!(u8).range(1..=2))]
    ros: Option<u8>,
    /// Key that must have signed the archive ("ssh-ed25519 AAAA…"; default: the key that the server reports).
    #[arg(long, value_name = "KEY")]
    key: Option<PublicKey>,
}

/// Summary of a download.
#[derive(serde::Serialize)]
struct FetchedStub {
    service: String,
    architecture: String,
    ros: Option<u8>,
    path: PathBuf,
    bytes: u64,
    signature: PathBuf,
    key: String,
}

impl StubArgs {
    /// Downloads, verifies and writes the archive.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let Some(service) = &self.service else {
            return list(client, format).await;
        };
        let key = match self.key {
            Some(key) => key,
            None => {
                let stubs: Stubs = client.get("/stubs").await?;
                if stubs.key.is_empty() {
                    bail!("this server's version is too old to sign stubs; update it");
                }
                stubs.key.parse().context("the server's key")?
            }
        };
        let asked = self.arch.as_deref().unwrap_or(std::env::consts::ARCH);
        let ros = self.ros.or_else(|| ros_of_shell(std::env::var("ROS_VERSION").ok().as_deref()));
        let path = format!(
            "/stubs/{}.tar.gz?arch={}{}",
            percent_encode(service),
            percent_encode(parse_architecture(asked).unwrap_or(asked)),
            ros.map(|ros| format!("&ros={ros}")).unwrap_or_default(),
        );
        let mut answer = client.send(Method::GET, &path, empty_body()).await?;
        let stated = |name: &str| answer.headers().get(name).and_then(|value| value.to_str().ok());
        let architecture = stated(ARCHITECTURE).unwrap_or(asked).to_owned();
        let made_for: Option<u8> = stated(ROS).and_then(|ros| ros.parse().ok());
        if let Some(ros) = self.ros.filter(|ros| made_for != Some(*ros)) {
            bail!("this server's version is too old to make archives for robots of ROS {ros}; update it");
        }
        let signature = stated(SIGNATURE)
            .map(sign::to_armoured_lines)
            .context("the archive is not signed: the server's version is too old; update it")?;
        let target = self.output.join(format!("{service}.tar.gz"));
        let failed = || format!("cannot write {}", target.display());
        std::fs::create_dir_all(&self.output).with_context(failed)?;
        // Atomically: an existing archive stays until the new one is complete.
        let half = self.output.join(format!(".{service}.tar.gz.part"));
        let mut file = std::fs::File::create(&half).with_context(failed)?;
        let mut bytes = 0;
        while let Some(frame) = http_body_util::BodyExt::frame(answer.body_mut()).await {
            let frame = frame.context("the daemon's response was cut off")?;
            if let Some(data) = frame.data_ref() {
                file.write_all(data).with_context(failed)?;
                bytes += data.len() as u64;
            }
        }
        if bytes == 0 {
            bail!("the daemon sent an empty archive");
        }
        file.sync_all().with_context(failed)?;
        let digest = std::fs::File::open(&half).and_then(|mut file| sign::digest(&mut file)).with_context(failed)?;
        if let Err(refused) = key.verify(ARCHIVE, &digest, &signature) {
            let _ = std::fs::remove_file(&half);
            return Err(anyhow::Error::new(refused).context(format!(
                "the signature of the archive of {service} does not match the server's key {key}; nothing was written"
            )));
        }
        let beside = self.output.join(format!("{service}.tar.gz.sig"));
        std::fs::write(&beside, signature).with_context(|| format!("cannot write {}", beside.display()))?;
        std::fs::rename(&half, &target).with_context(failed)?;
        let fetched = FetchedStub {
            service: service.clone(),
            architecture,
            ros: made_for,
            path: target,
            bytes,
            signature: beside,
            key: key.to_string(),
        };
        match format {
            OutputFormat::Json => output::json(&fetched),
            OutputFormat::Table => {
                output::line(&format!(
                    "{} for {}{} ({})",
                    fetched.path.display(),
                    fetched.architecture,
                    fetched.ros.map(|ros| format!(", ROS {ros}")).unwrap_or_default(),
                    api::Size(fetched.bytes)
                ))?;
                output::line(&format!("signed by {key}"))?;
                output::line("on the robot, with both files:")?;
                output::line(&format!("  {}", install_command(service, key)))
            }
        }
    }
}

/// Returns the ROS version that is set up in a shell, by its `ROS_VERSION`.
fn ros_of_shell(version: Option<&str>) -> Option<u8> {
    version.and_then(|version| version.parse().ok()).filter(|version| (1..=2).contains(version))
}

/// Returns the commands that verify the archive before any of it runs, and that use the same key for later updates.
fn install_command(service: &str, key: PublicKey) -> String {
    format!(
        "echo '{}' > server.pub && ssh-keygen -Y verify -f server.pub -I {SIGNER} -n {ARCHIVE} -s {service}.tar.gz.sig \
         < {service}.tar.gz \
         && tar xzf {service}.tar.gz && sh {service}-stub/install.sh --key server.pub",
        key.allowed_signers_line()
    )
}

async fn list(client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
    let stubs: Stubs = client.get("/stubs").await?;
    let list = |names: &[String]| match names.len() {
        0 => "none".to_owned(),
        _ => names.join(", "),
    };
    match format {
        OutputFormat::Json => output::json(&stubs),
        OutputFormat::Table => {
            output::line(&format!("services       {}", list(&stubs.services)))?;
            output::line(&format!("architectures  {}", list(&stubs.architectures)))?;
            output::line(&format!("signed by      {}", stubs.key))?;
            if stubs.lacking.is_empty() {
                return Ok(());
            }
            output::line(&format!("missing        {} (make stub-cross builds them)", list(&stubs.lacking)))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_ros_of_the_shell_is_a_number_or_none() {
        for (variable, expected) in [("1", Some(1)), ("2", Some(2)), ("3", None), ("noetic", None), ("", None)] {
            assert_eq!(ros_of_shell(Some(variable)), expected, "{variable:?}");
        }
        assert_eq!(ros_of_shell(None), None);
    }
}
