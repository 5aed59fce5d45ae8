//! Root file system of the image for the peers: its layers below an overlay, without shifted ids.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use nix::mount::{MntFlags, MsFlags, mount, umount2};
use servant::container::ContainerSpec;
use servant::rootfs::make_skeleton;

/// A mounted root; unmounted on drop.
pub(crate) struct ImageRoot {
    path: PathBuf,
}

impl ImageRoot {
    /// Mounts it below `place`, read-only.
    pub(crate) fn mount(place: &Path, spec: &ContainerSpec) -> Result<Self> {
        let (skeleton, path) = (place.join("skeleton"), place.join("root"));
        fs::create_dir_all(&path)?;
        make_skeleton(&skeleton, &spec.id, &[], &[], &[])?;
        // Without shifted ids it belongs to another user, and only a user who may enter it can mount on it.
        fs::set_permissions(skeleton.join("root"), fs::Permissions::from_mode(0o755))?;
        let lowers = [&skeleton].into_iter().chain(spec.layers.iter().rev());
        let lowers: Vec<&str> = lowers.map(|lower| lower.to_str()).collect::<Option<_>>().context("UTF-8")?;
        let options = format!("lowerdir={}", lowers.join(":"));
        mount(Some("overlay"), &path, Some("overlay"), MsFlags::MS_RDONLY, Some(options.as_str()))
            .with_context(|| format!("mounting {options}"))?;
        Ok(Self { path })
    }

    /// Returns its path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Mounts what a chrooted process needs: /proc, /dev, and the tmpfs of a servant.
    pub(crate) fn mount_system(&self) -> Result<()> {
        let place = |name: &str| self.path.join(name);
        let nothing = MsFlags::empty();
        mount(Some("proc"), &place("proc"), Some("proc"), nothing, None::<&str>).context("/proc")?;
        mount(Some("/dev"), &place("dev"), None::<&str>, MsFlags::MS_BIND | MsFlags::MS_REC, None::<&str>)
            .context("/dev")?;
        for name in ["root", "run", "tmp", "var/tmp"] {
            mount(Some("tmpfs"), &place(name), Some("tmpfs"), nothing, Some("size=64m"))
                .with_context(|| name.to_owned())?;
        }
        Ok(())
    }
}

impl Drop for ImageRoot {
    fn drop(&mut self) {
        // MNT_DETACH unmounts recursively; anything left disappears with our mount namespace.
        let _ = umount2(&self.path, MntFlags::MNT_DETACH);
    }
}
