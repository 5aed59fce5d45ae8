//! `import`: publishes a service that another server has exported.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use tar::Archive;

use crate::client::DaemonClient;
use crate::output::OutputFormat;
use crate::push::PushArgs;
use crate::rollout::TermFlags;
use crate::wait::WaitFlag;

/// Import a service that `cloudroidctl export` has written on another server: the same image, commands and limits.
///
/// It is started once, like a push, to check that it works here. Its SLA table is imported unless the service has one
/// already.
#[derive(Debug, clap::Args)]
pub struct ImportArgs {
    /// File written by export.
    file: PathBuf,
    /// Name of the service (default: its name on the other server).
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    #[command(flatten)]
    rollout: TermFlags,
    #[command(flatten)]
    wait: WaitFlag,
}

impl ImportArgs {
    /// Sends the file and prints the progress.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        check_exported(&self.file)?;
        let push = PushArgs::from_export(self.file, self.name, self.rollout, self.wait);
        push.run(client, format).await
    }
}

/// Refuses a file that is not an exported service: a package would be compiled and published instead.
fn check_exported(path: &Path) -> anyhow::Result<()> {
    let named = || path.display();
    let file = File::open(path).with_context(|| format!("cannot read {}", named()))?;
    match is_exported(file) {
        Ok(true) => Ok(()),
        Ok(false) => bail!(
            "{} is not an exported service; create one with cloudroidctl export, or publish a package with \
                cloudroidctl push",
            named()
        ),
        Err(error) => bail!(
            "{} is not a valid file of cloudroidctl export ({error}); export the service again, and copy the whole \
                file",
            named()
        ),
    }
}

/// Returns whether an archive contains an image layout; fails if it is truncated or not an archive.
fn is_exported(file: File) -> std::io::Result<bool> {
    let length = file.metadata()?.len();
    let mut archive = Archive::new(file);
    let mut found = false;
    for entry in archive.entries_with_seek()? {
        let entry = entry?;
        if entry.raw_file_position() + entry.size() > length {
            return Err(std::io::Error::other("it is truncated"));
        }
        found |= entry.path()?.as_os_str() == "oci-layout";
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn archive(name: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut archive = tar::Builder::new(file.reopen().expect("the file"));
        let mut header = tar::Header::new_gnu();
        header.set_size(2);
        archive.append_data(&mut header, name, &b"{}"[..]).expect("an entry");
        archive.finish().expect("an archive");
        file
    }

    #[test]
    fn an_exported_service_alone_is_imported() {
        check_exported(archive("oci-layout").path()).expect("it has a layout");
        let source = check_exported(archive("adder_py/package.xml").path());
        let source = source.expect_err("a package").to_string();
        assert!(source.contains("publish a package with cloudroidctl push"), "{source}");
    }

    #[test]
    fn what_cannot_be_read_is_said() {
        let text = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(text.path(), [b'x'; 700]).expect("written");
        let text = check_exported(text.path()).expect_err("a text").to_string();
        assert!(text.contains("export the service again"), "{text}");
        let torn = archive("oci-layout");
        let torn_at = torn.as_file().set_len(513);
        torn_at.expect("it is cut");
        let torn = check_exported(torn.path()).expect_err("it is cut").to_string();
        assert!(torn.contains("it is truncated"), "{torn}");
        let missing = check_exported(Path::new("/nowhere/x.tar")).expect_err("none");
        assert!(missing.to_string().contains("cannot read /nowhere/x.tar"));
        let directory = tempfile::tempdir().expect("a directory");
        let directory = check_exported(directory.path()).expect_err("a directory");
        assert!(directory.to_string().contains("export"), "{directory}");
    }
}
