//! Actions of the test nodes: `test-node WORD [ARGUMENT]...`. They make real system calls.

use std::ffi::CString;
use std::io::{self, Write};
use std::time::Duration;

/// Runs the action and returns the exit status.
pub fn run_action(words: &[String]) -> i32 {
    let number = |at: usize| words.get(at).and_then(|word| word.parse::<u64>().ok()).unwrap_or(0);
    match words.first().map(String::as_str).unwrap_or_default() {
        "exit" => return number(1) as i32,
        "sleep" => loop {
            std::thread::sleep(Duration::from_secs(60));
        },
        "stubborn" => {
            ignore_polite_signals();
            fork_sleeper();
            println!("stubborn");
            loop {
                std::thread::sleep(Duration::from_secs(60));
            }
        }
        "family" => {
            fork_sleeper();
            println!("family");
            loop {
                std::thread::sleep(Duration::from_secs(60));
            }
        }
        "orphan" => {
            // The child outlives this process for a moment and so becomes init's.
            // SAFETY: one thread.
            if unsafe { libc::fork() } == 0 {
                // SAFETY: no pointers.
                while unsafe { libc::getppid() } != 1 {
                    std::thread::yield_now();
                }
                return 0;
            }
            return 0;
        }
        "die" => {
            // SAFETY: no pointers.
            unsafe { libc::raise(number(1) as i32) };
        }
        "print" => {
            let mut out = io::stdout().lock();
            for line in 0..number(1) {
                if writeln!(out, "{line}").is_err() {
                    return 1;
                }
            }
        }
        "environment" => {
            let variables: std::collections::BTreeMap<_, _> = std::env::vars().collect();
            println!("{variables:?} {:?}", std::env::current_dir().unwrap_or_default());
        }
        "eat" => {
            let mut held: Vec<Vec<u8>> = Vec::new();
            loop {
                held.push(vec![1; 1 << 20]);
                std::hint::black_box(&held);
            }
        }
        "fork" => return fork_many(number(1)),
        "chown" => return chown(&words[1], number(2) as u32),
        "write" => return status(std::fs::write(&words[1], "x")),
        "read" => return status(std::fs::read_to_string(&words[1]).map(|text| print!("{text}"))),
        "share" => return status(write_shared(&words[1], words[2].as_bytes())),
        "shared" => return status(read_shared(&words[1]).map(|text| println!("{text}"))),
        "fill" => return status(fill(&words[1], number(2))),
        "calls" => refused_calls(),
        "buffer" => return status(buffer()),
        "exhaust" => return status(exhaust()),
        other => {
            eprintln!("unknown word {other}");
            return 99;
        }
    }
    0
}

fn status<T>(result: io::Result<T>) -> i32 {
    match result {
        Ok(_) => 0,
        Err(error) => {
            eprintln!("{error}");
            error.raw_os_error().unwrap_or(98)
        }
    }
}

/// Bytes of a shared memory segment.
const PIECE: usize = 4096;

/// Maps a POSIX shared memory segment by its name; a new one is zeroed.
fn map_shared_memory(name: &str, flags: i32) -> io::Result<*mut u8> {
    let name = CString::new(name)?;
    // SAFETY: the name is a string that outlives the call.
    let fd = unsafe { libc::shm_open(name.as_ptr(), flags, 0o600) };
    if fd < 0 {
        return Err(io::Error::last_os_error());
    }
    let size = PIECE as libc::off_t;
    // SAFETY: no pointers.
    if flags & libc::O_CREAT != 0 && unsafe { libc::ftruncate(fd, size) } != 0 {
        return Err(io::Error::last_os_error());
    }
    // SAFETY: a new mapping; nothing else is there.
    let at =
        unsafe { libc::mmap(std::ptr::null_mut(), PIECE, libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED, fd, 0) };
    if at == libc::MAP_FAILED {
        return Err(io::Error::last_os_error());
    }
    Ok(at.cast())
}

/// Writes a text into the segment and waits.
fn write_shared(name: &str, text: &[u8]) -> io::Result<()> {
    let at = map_shared_memory(name, libc::O_CREAT | libc::O_RDWR)?;
    let length = text.len().min(PIECE);
    // SAFETY: both are that long, and the segment was just mapped.
    unsafe { std::ptr::copy_nonoverlapping(text.as_ptr(), at, length) };
    println!("shared");
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

/// Reads the text in the segment.
fn read_shared(name: &str) -> io::Result<String> {
    let at = map_shared_memory(name, libc::O_RDWR)?;
    // SAFETY: that long, mapped for as long as this process lives; its writer is done.
    let bytes = unsafe { std::slice::from_raw_parts(at, PIECE) };
    let text = bytes.split(|byte| *byte == 0).next().unwrap_or_default();
    Ok(String::from_utf8_lossy(text).into_owned())
}

/// Writes this number of MiB into a file, and waits.
fn fill(path: &str, mebibytes: u64) -> io::Result<()> {
    let mut file = std::fs::File::create(path)?;
    for _ in 0..mebibytes {
        file.write_all(&vec![1; 1 << 20])?;
    }
    println!("filled");
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

/// Fills as many socket buffers as the kernel allows with data that nobody reads, prints the bytes by TCP and by UDP,
/// and waits.
fn buffer() -> io::Result<()> {
    use std::net::{TcpListener, TcpStream, UdpSocket};
    const SOCKETS: usize = 100;
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let (mut by_tcp, mut by_udp) = (0, 0);
    let mut streams = Vec::new();
    for _ in 0..SOCKETS {
        let mut sender = TcpStream::connect(listener.local_addr()?)?;
        streams.push(listener.accept()?.0);
        sender.set_nonblocking(true)?;
        while let Ok(sent) = sender.write(&[7; 65_536]) {
            by_tcp += sent;
        }
        streams.push(sender);
    }
    drop(streams);
    let mut sockets = Vec::new();
    for _ in 0..SOCKETS * 4 {
        let socket = UdpSocket::bind("127.0.0.1:0")?;
        socket.set_nonblocking(true)?;
        for _ in 0..400 {
            // Datagrams that find no room are lost, here or on their way.
            let _ = socket.send_to(&[7; 1000], socket.local_addr()?);
        }
        sockets.push(socket);
    }
    for socket in &sockets {
        while let Ok(kept) = socket.recv(&mut [0; 1000]) {
            by_udp += kept;
        }
    }
    println!("{by_tcp} {by_udp}");
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

/// Allocates as much as possible of the resources that the kernel counts per user, prints the counts, and waits.
fn exhaust() -> io::Result<()> {
    let mut queues = 0;
    let mut name = CString::new(format!("/queue-{queues}"))?;
    // SAFETY: a name that outlives the call; no attributes.
    while unsafe { libc::mq_open(name.as_ptr(), libc::O_CREAT | libc::O_RDWR, 0o600, std::ptr::null::<u8>()) } >= 0 {
        queues += 1;
        name = CString::new(format!("/queue-{queues}"))?;
    }
    let signal = libc::SIGRTMIN();
    // SAFETY: a signal set is emptied before it is used; a blocked signal runs no code.
    unsafe {
        let mut blocked: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&mut blocked);
        libc::sigaddset(&mut blocked, signal);
        libc::sigprocmask(libc::SIG_BLOCK, &blocked, std::ptr::null_mut());
    }
    let nothing = libc::sigval { sival_ptr: std::ptr::null_mut() };
    let mut signals = 0;
    // SAFETY: this very process, which has blocked the signal.
    while unsafe { libc::sigqueue(libc::getpid(), signal, nothing) } == 0 {
        signals += 1;
    }
    let mut instances = 0;
    // SAFETY: no pointers.
    while unsafe { libc::inotify_init1(0) } >= 0 {
        instances += 1;
    }
    let mut terminals = 0;
    // SAFETY: a path that outlives the call.
    while unsafe { libc::open(c"/dev/ptmx".as_ptr(), libc::O_RDWR | libc::O_NOCTTY) } >= 0 {
        terminals += 1;
    }
    println!("{queues} {signals} {instances} {terminals}");
    loop {
        std::thread::sleep(Duration::from_secs(60));
    }
}

fn ignore_polite_signals() {
    for signal in [libc::SIGINT, libc::SIGTERM] {
        // SAFETY: a disposition that runs no code of ours.
        unsafe { libc::signal(signal, libc::SIG_IGN) };
    }
}

fn fork_sleeper() {
    // SAFETY: one thread.
    if unsafe { libc::fork() } == 0 {
        // In its own session, where no signal to the node's group reaches it.
        // SAFETY: no pointers.
        unsafe { libc::setsid() };
        loop {
            std::thread::sleep(Duration::from_secs(60));
        }
    }
}

/// Returns, as exit status, how many processes could be forked; each waits until killed.
fn fork_many(wanted: u64) -> i32 {
    for made in 0..wanted {
        // SAFETY: one thread.
        match unsafe { libc::fork() } {
            -1 => {
                println!("{made} then {}", io::Error::last_os_error());
                return 0;
            }
            0 => loop {
                std::thread::sleep(Duration::from_secs(60));
            },
            _ => {}
        }
    }
    println!("{wanted} without end");
    0
}

fn chown(path: &str, owner: u32) -> i32 {
    if let Err(error) = std::fs::write(path, "x") {
        return status::<()>(Err(error));
    }
    status(std::os::unix::fs::chown(path, Some(owner), Some(owner)))
}

/// Prints `name: error` or `name: allowed` for every call that must be refused.
fn refused_calls() {
    let tell = |name: &str, result: i64| {
        let outcome = if result < 0 { io::Error::last_os_error().to_string() } else { "allowed".into() };
        println!("{name}: {outcome}");
    };
    let null = std::ptr::null::<u8>();
    let root = CString::from(c"/");
    let mut buffer = [0_u8; 256];
    let here = buffer.as_mut_ptr();
    // SAFETY: each call is refused before it looks at its arguments, or gets valid ones. A forked child exits at once.
    unsafe {
        tell("unshare user", i64::from(libc::unshare(libc::CLONE_NEWUSER)));
        tell("unshare network", i64::from(libc::unshare(libc::CLONE_NEWNET)));
        tell("unshare mounts", i64::from(libc::unshare(libc::CLONE_NEWNS)));
        tell("setns", i64::from(libc::setns(0, 0)));
        for (name, flag) in [("user", libc::CLONE_NEWUSER), ("mount", libc::CLONE_NEWNS), ("net", libc::CLONE_NEWNET)] {
            let flags = (flag | libc::SIGCHLD) as i64;
            let result = libc::syscall(libc::SYS_clone, flags, 0, 0, 0, 0);
            if result == 0 {
                libc::_exit(0);
            }
            tell(&format!("clone with a new {name} namespace"), result);
        }
        tell("clone3", libc::syscall(libc::SYS_clone3, here, 88));
        tell(
            "mount",
            i64::from(libc::mount(c"none".as_ptr(), c"/tmp".as_ptr(), c"tmpfs".as_ptr(), 0, std::ptr::null())),
        );
        tell(
            "remount",
            i64::from(libc::mount(
                std::ptr::null(),
                root.as_ptr(),
                std::ptr::null(),
                libc::MS_REMOUNT,
                std::ptr::null(),
            )),
        );
        tell("umount", i64::from(libc::umount2(c"/proc".as_ptr(), 0)));
        tell("fsopen", libc::syscall(libc::SYS_fsopen, c"tmpfs".as_ptr(), 0));
        tell("open_tree", libc::syscall(libc::SYS_open_tree, libc::AT_FDCWD, root.as_ptr(), 1));
        tell("pivot_root", libc::syscall(libc::SYS_pivot_root, root.as_ptr(), root.as_ptr()));
        tell("chroot", i64::from(libc::chroot(root.as_ptr())));
        tell("ptrace init", libc::ptrace(libc::PTRACE_ATTACH, 1, 0, 0));
        tell("ptrace me", libc::ptrace(libc::PTRACE_TRACEME, 0, 0, 0));
        tell("process_vm_readv", libc::syscall(libc::SYS_process_vm_readv, 1, null, 0, null, 0, 0));
        tell("pidfd_getfd", libc::syscall(libc::SYS_pidfd_getfd, 0, 0, 0));
        tell("keyctl", libc::syscall(libc::SYS_keyctl, 0, -3, 1, 0, 0));
        tell("add_key", libc::syscall(libc::SYS_add_key, c"user".as_ptr(), c"x".as_ptr(), here, 1, -3));
        tell("bpf", libc::syscall(libc::SYS_bpf, 5, here, 64));
        tell("perf_event_open", libc::syscall(libc::SYS_perf_event_open, here, 0, -1, -1, 0));
        tell("io_uring_setup", libc::syscall(libc::SYS_io_uring_setup, 8, here));
        tell("userfaultfd", libc::syscall(libc::SYS_userfaultfd, 0));
        tell("open_by_handle_at", libc::syscall(libc::SYS_open_by_handle_at, 0, here, 0));
        tell("kexec_load", libc::syscall(libc::SYS_kexec_load, 0, 0, null, 0));
        tell("reboot", libc::syscall(libc::SYS_reboot, 0xfee1dead_u32, 672_274_793, 0, null));
        tell("sethostname", i64::from(libc::sethostname(c"x".as_ptr(), 1)));
        tell("raw socket", i64::from(libc::socket(libc::AF_INET, libc::SOCK_RAW, 1)));
        tell("packet socket", i64::from(libc::socket(libc::AF_PACKET, libc::SOCK_RAW, 0)));
        // Such requests count for the whole host (fs.aio-max-nr).
        let mut context = 0_u64;
        tell("asynchronous input and output", libc::syscall(libc::SYS_io_setup, 1, &raw mut context));
        let mut pair = [0; 2];
        for (name, family) in [("netlink", libc::AF_NETLINK), ("tipc", libc::AF_TIPC)] {
            tell(
                &format!("{name} socketpair"),
                i64::from(libc::socketpair(family, libc::SOCK_SEQPACKET, 0, pair.as_mut_ptr())),
            );
        }
        tell("vsock", i64::from(libc::socket(libc::AF_VSOCK, libc::SOCK_STREAM, 0)));
        tell("alg socket", i64::from(libc::socket(libc::AF_ALG, libc::SOCK_SEQPACKET, 0)));
        tell("disk device", i64::from(libc::mknod(c"/tmp/disk".as_ptr(), libc::S_IFBLK | 0o600, libc::makedev(8, 0))));
        tell("setuid outside", i64::from(libc::setuid(70_000)));
    }
    for path in ["/proc/sys/kernel/core_pattern", "/proc/sysrq-trigger", "/x", "/usr/x", "/proc/1/mem", "/dev/x"] {
        let outcome = match std::fs::OpenOptions::new().create(true).truncate(false).write(true).open(path) {
            Ok(_) if path == "/dev/x" => "nothing but a file in its own tmpfs".to_owned(),
            Ok(_) => "allowed".to_owned(),
            Err(error) => error.to_string(),
        };
        println!("write {path}: {outcome}");
    }
    for path in ["/proc/kcore", "/proc/keys", "/proc/1/fd/3", "/proc/1/environ", "/proc/1/exe", "/proc/1/root"] {
        let outcome = match std::fs::read(path) {
            Ok(bytes) if bytes.is_empty() => "empty".to_owned(),
            Ok(_) => "allowed".to_owned(),
            Err(error) => error.to_string(),
        };
        println!("read {path}: {outcome}");
    }
    println!("end of calls");
}
