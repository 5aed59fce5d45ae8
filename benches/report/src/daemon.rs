//! A daemon to be measured, with a home of its own.

use std::fs;
use std::ops::Deref;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

use anyhow::{Context, Result};
use support::daemon::{Daemon, DaemonSetup};
use tempfile::TempDir;

/// A running `cloudroidd`. It ends on drop, together with its servants, and its home is removed.
pub struct BenchDaemon {
    daemon: Daemon,
    place: TempDir,
}

impl Deref for BenchDaemon {
    type Target = Daemon;

    fn deref(&self) -> &Daemon {
        &self.daemon
    }
}

impl BenchDaemon {
    /// Starts the daemon with this configuration and waits until it answers.
    pub fn start(config: &str) -> Result<Self> {
        Self::start_in(create_directory()?, config, &[])
    }

    /// Starts the daemon in a directory of [`create_directory`], with these environment variables.
    pub fn start_in(place: TempDir, config: &str, environment: &[(&str, &Path)]) -> Result<Self> {
        let mut setup = DaemonSetup::new(&place.path().join("home")).config(config);
        for (key, value) in environment {
            setup = setup.environment(key, value.to_str().context("UTF-8")?);
        }
        Ok(Self { daemon: setup.start()?, place })
    }

    /// Returns a directory for other files, which is removed together with the daemon.
    pub fn directory(&self) -> &Path {
        self.place.path()
    }

    /// Returns the ids of its servants.
    pub fn servants(&self) -> Result<Vec<String>> {
        let servants = self.api("/api/v1/servants")?;
        let servants = servants.as_array().context("a list of servants")?;
        let ids = servants.iter().filter_map(|servant| servant["id"].as_str());
        Ok(ids.map(str::to_owned).collect())
    }

    /// Waits until it has `count` servants; a servant that is stopping counts until it has been removed completely.
    pub fn wait_for_servants(&self, count: usize) -> Result<()> {
        support::wait_until(&format!("a daemon with {count} servants"), || {
            let found = self.servants()?.len();
            Ok((found == count).then_some(()).ok_or_else(|| format!("{found}:\n{}", self.log_tail())))
        })
    }

    /// Stops all its servants.
    pub fn stop_servants(&self) -> Result<()> {
        let stop = ["stop", "--all"];
        self.deployer().run(&stop)?.expect_success()?;
        self.wait_for_servants(0)
    }
}

/// Creates a temporary directory. Containers reach their root file systems through it, so everybody may enter it.
pub fn create_directory() -> Result<TempDir> {
    let place = tempfile::Builder::new().prefix("cloudroid-bench-").tempdir()?;
    fs::set_permissions(place.path(), fs::Permissions::from_mode(0o755))?;
    Ok(place)
}
