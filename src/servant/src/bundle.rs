//! The OCI runtime configuration of a servant.

use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};

use nix::sys::resource::{Resource, getrlimit};
use oci_spec::OciSpecError;
use oci_spec::runtime::{
    Capability, LinuxBuilder, LinuxCapabilitiesBuilder, LinuxNamespaceBuilder, LinuxNamespaceType, Mount, MountBuilder,
    PosixRlimit, PosixRlimitBuilder, PosixRlimitType, Process, ProcessBuilder, RootBuilder, Spec as OciSpec,
    SpecBuilder, UserBuilder,
};

use crate::container::{ContainerSpec, Profile};
use crate::idmap::{MESSAGE_QUEUES, PENDING_SIGNALS};
use crate::quotas::Quotas;
use crate::rootfs::{COMPILE_USER, StagedRoot};
use crate::seccomp;

/// Limit of open files per process; a higher one only slows down programs that close all possible descriptors.
const OPEN_FILES: u64 = 16_384;

/// Limit of inotify instances per user of a container: the kernel's default.
pub const INOTIFY_INSTANCES: u64 = 128;

/// Limit of pseudoterminals per container; the host has some thousands in total.
pub const TERMINALS: u64 = 64;

const MASKED_PATHS: [&str; 9] = [
    "/proc/acpi",
    "/proc/asound",
    "/proc/kcore",
    "/proc/keys",
    "/proc/latency_stats",
    "/proc/sched_debug",
    "/proc/scsi",
    "/proc/timer_list",
    "/proc/timer_stats",
];

const READ_ONLY: [&str; 5] = ["/proc/bus", "/proc/fs", "/proc/irq", "/proc/sys", "/proc/sysrq-trigger"];

/// Builds the configuration of a container whose root and volumes are staged. It has no network namespace: the creating
/// process is in the servant's already, and the container inherits it. It has no limits: the cgroup is created, set and
/// read back before. The user namespace exists already, too (see [`crate::idmap::create_user_namespace`]).
pub fn config(spec: &ContainerSpec, staged: &StagedRoot, quotas: &Quotas) -> Result<OciSpec, OciSpecError> {
    let user = LinuxNamespaceBuilder::default()
        .typ(LinuxNamespaceType::User)
        // This descriptor is open in the process that creates the container, and in those it forks for that.
        .path(format!("/proc/self/fd/{}", staged.user_namespace.as_raw_fd()))
        .build()?;
    let others = [
        LinuxNamespaceType::Mount,
        LinuxNamespaceType::Pid,
        LinuxNamespaceType::Ipc,
        LinuxNamespaceType::Uts,
        LinuxNamespaceType::Cgroup,
    ]
    .into_iter()
    .map(|kind| LinuxNamespaceBuilder::default().typ(kind).build());
    let namespaces = std::iter::once(Ok(user)).chain(others).collect::<Result<Vec<_>, _>>()?;
    let mut linux = LinuxBuilder::default()
        .namespaces(namespaces)
        // Written by the process that creates the container, which may do so in its user namespace. A container has no
        // more than this even if the host allows more per user.
        .sysctl(std::collections::HashMap::from([(
            "user.max_inotify_instances".to_owned(),
            INOTIFY_INSTANCES.to_string(),
        )]))
        // libcontainer sees no cgroups at all (see rootfs.rs). If it ever did, it must find no process here: with an
        // empty path its cleanup would kill every process of its caller's cgroups, up to the host's.
        .cgroups_path(Path::new("/cloudroid-unused").join(&spec.id))
        .seccomp(seccomp::build_profile(spec.profile)?)
        .masked_paths(MASKED_PATHS.map(str::to_owned).to_vec())
        .readonly_paths(READ_ONLY.map(str::to_owned).to_vec())
        .build()?;
    // The builder's default asks for a device filter, which needs a cgroup. The container has no devices but those
    // bound into it, and without CAP_MKNOD on the host none can be created.
    linux.set_resources(None);
    SpecBuilder::default()
        .version("1.0.2")
        .hostname(spec.id.clone())
        .root(RootBuilder::default().path(&staged.root).readonly(spec.writable.is_none()).build()?)
        .process(process(spec)?)
        .mounts(mounts(spec, &staged.volumes, quotas)?)
        .linux(linux)
        .build()
}

/// Returns the OOM score adjustment. The daemon and its shims may be protected by their unit (OOMScoreAdjust), and that
/// is inherited: so servants are reset to that of ordinary processes, and builds, which can be repeated, are killed
/// first. A score that was raised stays: lowering it needs a capability that may be missing.
fn oom_score(profile: Profile) -> i32 {
    let inherited = std::fs::read_to_string("/proc/self/oom_score_adj").unwrap_or_default();
    let least = match profile {
        Profile::Servant => 0,
        Profile::Compile | Profile::Install => 500,
    };
    inherited.trim().parse().unwrap_or(0).max(least)
}

fn process(spec: &ContainerSpec) -> Result<Process, OciSpecError> {
    let user = if spec.profile == Profile::Compile { COMPILE_USER } else { 0 };
    let capabilities = if spec.profile == Profile::Install {
        [
            Capability::Chown,
            Capability::DacOverride,
            Capability::Fowner,
            Capability::Fsetid,
            Capability::Setuid,
            Capability::Setgid,
            Capability::Setfcap,
        ]
        .into()
    } else {
        std::collections::HashSet::new()
    };
    let none = std::collections::HashSet::new();
    let capabilities = LinuxCapabilitiesBuilder::default()
        .bounding(capabilities.clone())
        .effective(capabilities.clone())
        .permitted(capabilities)
        .inheritable(none.clone())
        .ambient(none)
        .build()?;
    ProcessBuilder::default()
        .terminal(false)
        .user(UserBuilder::default().uid(user).gid(user).build()?)
        .args(vec!["init".to_owned()])
        .env(vec!["HOME=/".to_owned()])
        .cwd("/")
        .capabilities(capabilities)
        .no_new_privileges(true)
        .oom_score_adj(oom_score(spec.profile))
        .rlimits(vec![
            rlimit(PosixRlimitType::RlimitNofile, Resource::RLIMIT_NOFILE, OPEN_FILES)?,
            rlimit(PosixRlimitType::RlimitCore, Resource::RLIMIT_CORE, 0)?,
            rlimit(PosixRlimitType::RlimitSigpending, Resource::RLIMIT_SIGPENDING, PENDING_SIGNALS)?,
            rlimit(PosixRlimitType::RlimitMsgqueue, Resource::RLIMIT_MSGQUEUE, MESSAGE_QUEUES)?,
        ])
        .build()
}

/// Builds a limit of at most `wanted`, and at most our own: raising a hard limit needs a capability that may be
/// missing.
fn rlimit(kind: PosixRlimitType, resource: Resource, wanted: u64) -> Result<PosixRlimit, OciSpecError> {
    let hard = getrlimit(resource).map_or(wanted, |(_, hard)| hard.min(wanted));
    PosixRlimitBuilder::default().typ(kind).soft(hard).hard(hard).build()
}

fn mounts(spec: &ContainerSpec, volumes: &[PathBuf], quotas: &Quotas) -> Result<Vec<Mount>, OciSpecError> {
    let scratch = quotas.scratch_bytes(spec.limits.memory.map(|size| size.0));
    let safe = ["nosuid", "nodev"];
    let tmpfs = |target: &str, mode: &str, size: u64, extra: &[&str]| {
        let mut options: Vec<String> = safe.iter().chain(extra).map(|option| (*option).to_owned()).collect();
        let inodes = quotas.inodes;
        options.extend([format!("mode={mode}"), format!("size={size}"), format!("nr_inodes={inodes}")]);
        mount(target, "tmpfs", "tmpfs", options)
    };
    let words = |list: &[&str]| list.iter().map(|word| (*word).to_owned()).collect::<Vec<_>>();
    let mut mounts = vec![
        mount("/proc", "proc", "proc", words(&["nosuid", "noexec", "nodev"]))?,
        mount("/dev", "tmpfs", "tmpfs", words(&["nosuid", "strictatime", "mode=755", "size=64k", "nr_inodes=1024"]))?,
        mount(
            "/dev/pts",
            "devpts",
            "devpts",
            words(&[
                "nosuid",
                "noexec",
                "newinstance",
                "ptmxmode=0666",
                "mode=0620",
                "gid=5",
                &format!("max={TERMINALS}"),
            ]),
        )?,
        tmpfs("/dev/shm", "1777", scratch, &["noexec"])?,
        tmpfs("/tmp", "1777", scratch, &[])?,
        tmpfs("/run", "755", 16 << 20, &[])?,
    ];
    if spec.profile == Profile::Servant {
        mounts.push(tmpfs("/root", "700", scratch, &[])?);
        mounts.push(tmpfs("/var/tmp", "1777", scratch, &[])?);
    }
    for (extra, source) in spec.mounts.iter().zip(volumes) {
        let access = if extra.writable { "rw" } else { "ro" };
        let devices = if extra.device { "dev" } else { "nodev" };
        let target = extra.target.to_string_lossy();
        let source = source.to_string_lossy();
        mounts.push(mount(&target, "bind", &source, words(&["bind", "nosuid", devices, access]))?);
    }
    Ok(mounts)
}

fn mount(target: &str, kind: &str, source: &str, options: Vec<String>) -> Result<Mount, OciSpecError> {
    MountBuilder::default().destination(target).typ(kind).source(source).options(options).build()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::{Limits, Size};

    fn spec(profile: Profile) -> ContainerSpec {
        ContainerSpec {
            id: "x".into(),
            layers: vec![],
            writable: None,
            profile,
            limits: Limits { memory: Some(Size(64 << 20)), ..Limits::default() },
            environment: Default::default(),
            nodes: vec![],
            owned_directories: vec![],
            mounts: vec![],
            hosts: Vec::new(),
            resident: serde_json::Value::Null,
        }
    }

    fn json(profile: Profile) -> serde_json::Value {
        serde_json::to_value(
            config(
                &spec(profile),
                &StagedRoot {
                    root: "/r".into(),
                    volumes: vec![],
                    user_namespace: std::fs::File::open("/proc/self/ns/user").unwrap().into(),
                },
                &Quotas::default(),
            )
            .unwrap(),
        )
        .unwrap()
    }

    #[test]
    fn only_installing_has_capabilities_and_only_compiling_another_user() {
        let count =
            |config: &serde_json::Value| config["process"]["capabilities"]["bounding"].as_array().unwrap().len();
        let user = |config: &serde_json::Value| config["process"]["user"]["uid"].as_u64().unwrap();
        let (servant, compile, install) = (json(Profile::Servant), json(Profile::Compile), json(Profile::Install));
        assert_eq!((count(&servant), count(&compile), count(&install)), (0, 0, 7));
        assert_eq!((user(&servant), user(&compile), user(&install)), (0, 1000, 0));
        for config in [servant, compile, install] {
            assert_eq!(config["process"]["noNewPrivileges"], true);
            assert_eq!(config["linux"]["namespaces"][0]["type"], "user");
            assert!(config["linux"]["namespaces"][0]["path"].is_string());
        }
    }

    #[test]
    fn libcontainer_is_given_no_cgroup_to_act_on() {
        let config = json(Profile::Servant);
        assert_eq!(config["linux"].get("resources"), None);
        assert_eq!(config["linux"]["cgroupsPath"], "/cloudroid-unused/x");
    }

    #[test]
    fn every_tmpfs_is_bounded() {
        for mount in json(Profile::Servant)["mounts"].as_array().unwrap() {
            let options = mount["options"].to_string();
            let bounded = options.contains("\"size=") && options.contains("\"nr_inodes=");
            assert_eq!(mount["type"] == "tmpfs", bounded, "{mount}");
        }
    }
}
