//! System calls that a servant may make: an allow-list as data, and its conversion to an OCI specification.
//!
//! Calls that are not listed return `ENOSYS`, so that a C library that probes for newer calls falls back to older ones.
//! Known calls that are refused return `EPERM`. The usual lists of container runtimes let a process without
//! capabilities create a user namespace and mount in it; this one does not.

use oci_spec::OciSpecError;
use oci_spec::runtime::{
    Arch, LinuxSeccomp, LinuxSeccompAction, LinuxSeccompArg, LinuxSeccompArgBuilder, LinuxSeccompBuilder,
    LinuxSeccompOperator, LinuxSyscall, LinuxSyscallBuilder,
};

use crate::container::Profile;

/// Calls allowed with any arguments. `io_setup` and its relatives are not among them, since their pending requests are
/// limited for the whole host (`fs.aio-max-nr`), which one servant could exhaust. Programs that find no such call do
/// without.
const ALLOWED_CALLS: &[&str] = &[
    // files
    "access chdir chmod chown close close_range copy_file_range creat dup dup2 dup3 faccessat faccessat2 fadvise64 \
     fallocate fchdir fchmod fchmodat fchmodat2 fchown fchownat fcntl fdatasync fgetxattr flistxattr flock \
     fremovexattr fsetxattr fstat fstatfs fsync ftruncate futimesat getcwd getdents getdents64 getxattr ioctl lchown \
     lgetxattr link linkat listxattr llistxattr lremovexattr lseek lsetxattr lstat mkdir mkdirat mknod mknodat \
     newfstatat open openat openat2 pread64 preadv preadv2 pwrite64 pwritev pwritev2 read readahead readlink \
     readlinkat readv removexattr rename renameat renameat2 rmdir sendfile setxattr splice stat statfs statx symlink \
     symlinkat sync sync_file_range syncfs tee truncate umask unlink unlinkat utime utimensat utimes vmsplice write \
     writev",
    // waiting for events
    "epoll_create epoll_create1 epoll_ctl epoll_pwait epoll_pwait2 epoll_wait eventfd eventfd2 inotify_add_watch \
     inotify_init inotify_init1 inotify_rm_watch poll ppoll pselect6 select",
    // memory
    "brk cachestat get_mempolicy madvise map_shadow_stack membarrier memfd_create mincore mlock mlock2 mlockall mmap \
     mprotect mremap mseal msync munlock munlockall munmap pkey_alloc pkey_free pkey_mprotect remap_file_pages",
    // processes and threads
    "arch_prctl capget capset execve execveat exit exit_group fork futex futex_requeue futex_wait futex_waitv \
     futex_wake get_robust_list get_thread_area getcpu getegid geteuid getgid getgroups getpgid getpgrp getpid \
     getppid getpriority getresgid getresuid getrlimit getrusage getsid gettid getuid ioprio_get ioprio_set kill \
     landlock_add_rule landlock_create_ruleset landlock_restrict_self pause pidfd_open pidfd_send_signal prctl \
     prlimit64 restart_syscall rseq rt_sigaction rt_sigpending rt_sigprocmask rt_sigqueueinfo rt_sigreturn \
     rt_sigsuspend rt_sigtimedwait rt_tgsigqueueinfo sched_get_priority_max sched_get_priority_min sched_getaffinity \
     sched_getattr sched_getparam sched_getscheduler sched_rr_get_interval sched_setaffinity sched_setattr \
     sched_setparam sched_setscheduler sched_yield seccomp set_robust_list set_thread_area set_tid_address setfsgid \
     setfsuid setgid setgroups setpgid setpriority setregid setresgid setresuid setreuid setrlimit setsid setuid \
     sigaltstack signalfd signalfd4 sysinfo tgkill times tkill uname vfork wait4 waitid",
    // time
    "alarm clock_getres clock_gettime clock_nanosleep getitimer gettimeofday nanosleep setitimer time timer_create \
     timer_delete timer_getoverrun timer_gettime timer_settime timerfd_create timerfd_gettime timerfd_settime",
    // communication
    "accept accept4 bind connect getpeername getsockname getsockopt listen mq_getsetattr mq_notify mq_open \
     mq_timedreceive mq_timedsend mq_unlink msgctl msgget msgrcv msgsnd pipe pipe2 recvfrom recvmmsg recvmsg semctl \
     semget semop semtimedop sendmmsg sendmsg sendto setsockopt shmat shmctl shmdt shmget shutdown",
    // other
    "getrandom",
];

/// Further calls that compilers, package managers and their tests use; none allows an escape.
const BUILDS_TOO: &[&str] = &["mbind", "name_to_handle_at", "set_mempolicy"];

/// Known calls that are refused with `EPERM`.
const REFUSED_CALLS: &[&str] = &[
    // namespaces and mounts
    "chroot fsconfig fsmount fsopen fspick mount mount_setattr move_mount open_tree pivot_root setns umount2 unshare",
    // other processes
    "kcmp move_pages migrate_pages pidfd_getfd process_madvise process_vm_readv process_vm_writev ptrace userfaultfd",
    // the kernel
    "acct add_key bpf delete_module fanotify_init finit_module init_module io_uring_enter io_uring_register \
     io_uring_setup ioperm iopl kexec_file_load kexec_load keyctl lookup_dcookie open_by_handle_at perf_event_open \
     quotactl quotactl_fd reboot request_key setdomainname sethostname settimeofday swapoff swapon syslog vhangup \
     clock_adjtime clock_settime",
];

/// The `CLONE_NEW*` flags (sched.h); `clone` must have none of them.
const CLONE_NEW: u64 = 0x7E02_0000;

/// Socket families: unix, IPv4, IPv6, netlink. Not vsock, which no network namespace confines.
const FAMILIES: [u64; 4] = [1, 2, 10, 16];

/// Families of socket pairs: unix. For others the kernel would load modules on request.
const PAIR_FAMILIES: [u64; 1] = [1];

/// Execution domains: Linux, 32-bit address limit, no address randomisation, both, and the query of the current one.
const PERSONALITIES: [u64; 5] = [0x0, 0x8, 0x2_0000, 0x2_0008, 0xffff_ffff];

const LOW_WORD: u64 = 0xffff_ffff;

/// Splits groups of names.
fn split_names(groups: &[&'static str]) -> Vec<&'static str> {
    groups.iter().flat_map(|group| group.split_whitespace()).collect()
}

/// Returns the calls that are refused to all untrusted processes.
pub(crate) fn refused_calls() -> impl Iterator<Item = &'static str> {
    split_names(REFUSED_CALLS).into_iter()
}

/// Builds the seccomp profile of an OCI specification.
pub fn build_profile(profile: Profile) -> Result<LinuxSeccomp, OciSpecError> {
    let mut allowed = split_names(ALLOWED_CALLS);
    if profile != Profile::Servant {
        allowed.extend(BUILDS_TOO);
    }
    let mut refused = split_names(REFUSED_CALLS);
    refused.retain(|name| !allowed.contains(name));
    let mut rules = vec![
        rule(&allowed, LinuxSeccompAction::ScmpActAllow, None, vec![])?,
        rule(&refused, LinuxSeccompAction::ScmpActErrno, Some(libc::EPERM), vec![])?,
        rule(&["clone"], LinuxSeccompAction::ScmpActAllow, None, vec![masked_equal(0, CLONE_NEW, 0)?])?,
        // Its flags are behind a pointer, which no filter can follow; glibc falls back to clone.
        rule(&["clone3"], LinuxSeccompAction::ScmpActErrno, Some(libc::ENOSYS), vec![])?,
    ];
    for (name, values) in
        [("socket", FAMILIES.as_slice()), ("socketpair", &PAIR_FAMILIES), ("personality", &PERSONALITIES)]
    {
        for value in values {
            rules.push(rule(
                &[name],
                LinuxSeccompAction::ScmpActAllow,
                None,
                vec![masked_equal(0, LOW_WORD, *value)?],
            )?);
        }
    }
    LinuxSeccompBuilder::default()
        .default_action(LinuxSeccompAction::ScmpActErrno)
        .default_errno_ret(libc::ENOSYS as u32)
        .architectures(vec![native_arch()])
        .syscalls(rules)
        .build()
}

/// Allows only this machine's native calls: an i386 or x32 call ends the process.
fn native_arch() -> Arch {
    if cfg!(target_arch = "aarch64") { Arch::ScmpArchAarch64 } else { Arch::ScmpArchX86_64 }
}

fn rule(
    names: &[&str],
    action: LinuxSeccompAction,
    errno: Option<i32>,
    arguments: Vec<LinuxSeccompArg>,
) -> Result<LinuxSyscall, OciSpecError> {
    let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
    let mut builder = LinuxSyscallBuilder::default().names(names).action(action);
    if let Some(errno) = errno {
        builder = builder.errno_ret(errno as u32);
    }
    if !arguments.is_empty() {
        builder = builder.args(arguments);
    }
    builder.build()
}

/// Builds the condition `argument & mask == wanted`. According to the specification `value` is the mask and `valueTwo`
/// the wanted value; libcontainer 0.7.0 swaps them, and the specified order would let `clone` create user namespaces.
/// Its version is pinned, and a test makes the real call.
fn masked_equal(index: usize, mask: u64, wanted: u64) -> Result<LinuxSeccompArg, OciSpecError> {
    LinuxSeccompArgBuilder::default()
        .index(index)
        .op(LinuxSeccompOperator::ScmpCmpMaskedEq)
        .value(wanted)
        .value_two(mask)
        .build()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn no_call_is_both_allowed_and_refused() {
        for list in [ALLOWED_CALLS, BUILDS_TOO, REFUSED_CALLS] {
            let list = split_names(list);
            let once: BTreeSet<_> = list.iter().collect();
            assert_eq!(once.len(), list.len(), "a name is listed twice");
        }
        let refused = split_names(REFUSED_CALLS);
        assert!(split_names(ALLOWED_CALLS).iter().all(|name| !refused.contains(name)));
    }

    #[test]
    fn every_profile_refuses_namespaces() {
        for kind in [Profile::Servant, Profile::Compile, Profile::Install] {
            let text = serde_json::to_string(&build_profile(kind).unwrap()).unwrap();
            for name in "unshare setns mount ptrace keyctl bpf io_uring_setup userfaultfd".split(' ') {
                assert!(!split_names(ALLOWED_CALLS).contains(&name) && !BUILDS_TOO.contains(&name), "{name}");
                assert!(text.contains(name), "{name} is refused by name");
            }
        }
    }
}
