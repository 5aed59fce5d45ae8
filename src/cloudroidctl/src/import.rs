//! `import`: a service that another server has exported.

use std::fs::File;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use tar::Archive;

use crate::client::Client;
use crate::output::Format;
use crate::push::Push;
use crate::rollout::TermFlags;
use crate::wait::WaitFlag;

/// Publish a service that `cloudroidctl export` has written on another server: the same image, started and limited as there.
///
/// It is started once, like a push, to see that it works here. Its dictionary is taken over where the service has none yet.
#[derive(Debug, clap::Args)]
pub struct Import {
    /// The file that export has written.
    file: PathBuf,
    /// Name of the service; as it was called there by default.
    #[arg(long, value_name = "NAME")]
    name: Option<String>,
    #[command(flatten)]
    rollout: TermFlags,
    #[command(flatten)]
    wait: WaitFlag,
}

impl Import {
    /// Sends it, and shows what is done with it.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        check(&self.file)?;
        let push = Push::of_exported(self.file, self.name, self.rollout, self.wait);
        push.run(client, format).await
    }
}

/// Refuses what is no exported service: a package would be compiled and published instead.
fn check(path: &Path) -> anyhow::Result<()> {
    let named = || path.display();
    let file = File::open(path).with_context(|| format!("cannot read {}", named()))?;
    match is_exported(file) {
        Ok(true) => Ok(()),
        Ok(false) => bail!(
            "{} is no exported service; cloudroidctl export writes one, and cloudroidctl push takes packages",
            named()
        ),
        Err(error) => bail!(
            "{} cannot be read as what cloudroidctl export writes ({error}); export the service again, and copy the whole file",
            named()
        ),
    }
}

/// Whether an archive holds an image layout; an error where it is cut off or is no archive.
fn is_exported(file: File) -> std::io::Result<bool> {
    let length = file.metadata()?.len();
    let mut archive = Archive::new(file);
    let mut found = false;
    for entry in archive.entries_with_seek()? {
        let entry = entry?;
        if entry.raw_file_position() + entry.size() > length {
            return Err(std::io::Error::other("it is cut off"));
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
        archive
            .append_data(&mut header, name, &b"{}"[..])
            .expect("an entry");
        archive.finish().expect("an archive");
        file
    }

    #[test]
    fn an_exported_service_alone_is_imported() {
        check(archive("oci-layout").path()).expect("it has a layout");
        let source = check(archive("adder_py/package.xml").path());
        let source = source.expect_err("a package").to_string();
        assert!(source.contains("push takes packages"), "{source}");
    }

    #[test]
    fn what_cannot_be_read_is_said() {
        let text = tempfile::NamedTempFile::new().expect("a file");
        std::fs::write(text.path(), [b'x'; 700]).expect("written");
        let text = check(text.path()).expect_err("a text").to_string();
        assert!(text.contains("export the service again"), "{text}");
        let torn = archive("oci-layout");
        let torn_at = torn.as_file().set_len(513);
        torn_at.expect("it is cut");
        let torn = check(torn.path()).expect_err("it is cut").to_string();
        assert!(torn.contains("it is cut off"), "{torn}");
        let missing = check(Path::new("/nowhere/x.tar")).expect_err("none");
        assert!(missing.to_string().contains("cannot read /nowhere/x.tar"));
        let directory = tempfile::tempdir().expect("a directory");
        let directory = check(directory.path()).expect_err("a directory");
        assert!(directory.to_string().contains("export"), "{directory}");
    }
}
