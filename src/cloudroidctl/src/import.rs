//! `import`: a service that another server has exported.

use std::path::PathBuf;

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
        let push = Push::of_exported(self.file, self.name, self.rollout, self.wait);
        push.run(client, format).await
    }
}
