//! PID 1 of a servant: a static binary without allocations that only starts, signals and reaps processes.
//!
//! A program of an exec session, unlike a node, has a fork of init as its parent, which ends when the program and all
//! its descendants have ended, and kills them on SIGTERM: that is how a session leaves nothing behind.
//!
//! Its standard input is the socket to the shim; when that closes, every process of the servant is killed. It keeps no
//! state: the shim does. It runs with the servant's own seccomp filter, user and limits, which its children inherit;
//! nothing here could grant them more.
#![no_main]

use std::ffi::{c_char, c_int};
use std::os::fd::RawFd;
use std::ptr;

use init::socket::{self, MAX_FDS};
use init::wire::{InitReply, InitRequest, MAX_MESSAGE, Scope, Start, StartStage};

/// Exit statuses of init itself.
const EXIT_NOT_PID_ONE: c_int = 64;
const EXIT_BROKEN: c_int = 70;

/// Maximum number of arguments and variables of one program.
const MAX_STRINGS: usize = 8192;

static mut MESSAGE: [u8; MAX_MESSAGE] = [0; MAX_MESSAGE];
static mut POINTERS: [*const c_char; MAX_STRINGS] = [ptr::null(); MAX_STRINGS];

/// The socket and the signal descriptor are placed above the standard streams.
const FIRST_FREE: c_int = 3;

/// More than the highest descriptor of init: those of its socket, its signals and one request.
const INIT_DESCRIPTORS: c_int = 64;

/// Number of streams of a node: its standard input is /dev/null.
const NODE_STREAMS: usize = 2;

#[unsafe(no_mangle)]
extern "C" fn main(_count: c_int, _arguments: *const *const c_char) -> c_int {
    // SAFETY: plain calls without pointers.
    unsafe {
        // `kill(-1)` below must never run among the host's processes.
        if libc::getpid() != 1 {
            return EXIT_NOT_PID_ONE;
        }
        // Nodes run as the same user: without this they could open init's descriptors through /proc/1/fd.
        libc::prctl(libc::PR_SET_DUMPABLE, 0);
    }
    let (Some(shim), Some(children)) = (take_socket(), watch_children()) else {
        return EXIT_BROKEN;
    };
    if !send_reply(shim, InitReply::Ready, &[]) {
        return EXIT_BROKEN;
    }
    serve(shim, children);
    // SAFETY: as pid 1 this reaches only the processes of this pid namespace.
    unsafe { libc::kill(-1, libc::SIGKILL) };
    0
}

/// Moves the socket away from standard input, so that no node inherits it, and redirects the standard streams to
/// /dev/null.
fn take_socket() -> Option<RawFd> {
    // SAFETY: calls on descriptors only; the path is a literal.
    unsafe {
        let shim = libc::fcntl(0, libc::F_DUPFD_CLOEXEC, FIRST_FREE);
        let null = libc::open(c"/dev/null".as_ptr(), libc::O_RDWR | libc::O_CLOEXEC);
        if shim < 0 || null < 0 {
            return None;
        }
        for stream in 0..3 {
            libc::dup2(null, stream);
        }
        libc::close(null);
        Some(shim)
    }
}

/// Returns a descriptor that becomes readable when a child exits.
fn watch_children() -> Option<RawFd> {
    // SAFETY: the set is initialised before it is used.
    unsafe {
        let mut set: libc::sigset_t = std::mem::zeroed();
        libc::sigfillset(&mut set);
        libc::sigprocmask(libc::SIG_BLOCK, &set, ptr::null_mut());
        libc::sigemptyset(&mut set);
        libc::sigaddset(&mut set, libc::SIGCHLD);
        let fd = libc::signalfd(-1, &set, libc::SFD_CLOEXEC | libc::SFD_NONBLOCK);
        (fd >= 0).then_some(fd)
    }
}

/// Handles events until the shim is gone.
fn serve(shim: RawFd, children: RawFd) {
    let mut watched = [
        libc::pollfd { fd: shim, events: libc::POLLIN, revents: 0 },
        libc::pollfd { fd: children, events: libc::POLLIN, revents: 0 },
    ];
    loop {
        // SAFETY: two initialised entries.
        let ready = unsafe { libc::poll(watched.as_mut_ptr(), 2, -1) };
        if ready < 0 {
            continue;
        }
        if watched[1].revents != 0 && !reap(shim, children) {
            return;
        }
        if watched[0].revents != 0 && !handle_request(shim) {
            return;
        }
    }
}

/// Reports every process that has exited; returns false when the shim has closed the socket.
fn reap(shim: RawFd, children: RawFd) -> bool {
    let mut info = [0_u8; size_of::<libc::signalfd_siginfo>()];
    // SAFETY: the buffer has the given length. Its content is not needed: SIGCHLDs merge, waitpid knows them all.
    unsafe { libc::read(children, info.as_mut_ptr().cast(), info.len()) };
    loop {
        let mut status = 0;
        // SAFETY: `status` is a valid location.
        let pid = unsafe { libc::waitpid(-1, &mut status, libc::WNOHANG) };
        if pid <= 0 {
            return true;
        }
        if !send_reply(shim, InitReply::Exited { pid, status }, &[]) {
            return false;
        }
    }
}

/// Receives and handles one request; returns false when the shim is gone.
fn handle_request(shim: RawFd) -> bool {
    let mut fds = [-1; MAX_FDS];
    // SAFETY: init has one thread, and this is the only use of the buffer at this time.
    let buffer = unsafe { &mut *ptr::addr_of_mut!(MESSAGE) };
    let (length, count) = match socket::receive(shim, buffer, &mut fds) {
        Ok((0, 0)) | Err(_) => return false,
        Ok(received) => received,
    };
    let alive = match InitRequest::decode(&buffer[..length]) {
        Some(InitRequest::Start(request)) => start(shim, &request, &fds[..count]),
        Some(InitRequest::Signal { pid, signal, scope }) => {
            let target = match scope {
                Scope::Process => pid,
                Scope::Group => -pid,
                Scope::All => -1,
            };
            // 0, 1 and their negatives would address init itself or its own group.
            if scope == Scope::All || pid > 1 {
                // SAFETY: no pointers.
                unsafe { libc::kill(target, signal) };
            }
            true
        }
        None => true,
    };
    for fd in &fds[..count] {
        // SAFETY: received for this request only.
        unsafe { libc::close(*fd) };
    }
    alive
}

/// Forks and executes a program; the reply says which step failed, if any.
fn start(shim: RawFd, request: &Start<'_>, streams: &[RawFd]) -> bool {
    let failed = |errno, stage| send_reply(shim, InitReply::Failed { id: request.id, errno, stage }, &[]);
    if !(1..=3).contains(&streams.len())
        || usize::from(request.arguments) + usize::from(request.variables) + 2 > MAX_STRINGS
    {
        return failed(libc::E2BIG, StartStage::Request);
    }
    let mut report = [-1; 2];
    // SAFETY: an array of two for two descriptors.
    if unsafe { libc::pipe2(report.as_mut_ptr(), libc::O_CLOEXEC) } != 0 {
        return failed(errno(), StartStage::Fork);
    }
    // SAFETY: one thread; the child goes straight to exec or _exit.
    let pid = unsafe { libc::fork() };
    if pid == 0 {
        let failure = if streams.len() == NODE_STREAMS {
            exec_program(request, streams)
        } else {
            exec_supervised(request, streams, report[1])
        };
        report_failure(report[1], failure);
    }
    let fork_error = errno();
    let mut bytes = [0_u8; 3];
    // SAFETY: `report` is ours; the read ends when exec closes the other end, or with the child's three bytes.
    let read = unsafe {
        libc::close(report[1]);
        let read = if pid < 0 { 0 } else { libc::read(report[0], bytes.as_mut_ptr().cast(), bytes.len()) };
        libc::close(report[0]);
        read
    };
    if pid < 0 {
        return failed(fork_error, StartStage::Fork);
    }
    if read == 3 {
        // SAFETY: our child, which is about to exit: it must not be reported as a process that ran.
        unsafe { libc::waitpid(pid, ptr::null_mut(), 0) };
        return failed(i32::from(bytes[1]) | i32::from(bytes[2]) << 8, StartStage::from_byte(bytes[0]));
    }
    // The child is not reaped yet, so the pid is certainly its own.
    // SAFETY: no pointers.
    let pidfd = unsafe { libc::syscall(libc::SYS_pidfd_open, pid, 0) } as RawFd;
    let beside = [pidfd];
    let told = send_reply(shim, InitReply::Started { id: request.id, pid }, if pidfd < 0 { &[] } else { &beside });
    // SAFETY: opened above.
    unsafe { libc::close(pidfd) };
    told
}

/// Reports a step that failed, and ends the process.
fn report_failure(report: RawFd, (stage, error): (StartStage, c_int)) -> ! {
    let bytes = [stage as u8, error as u8, (error >> 8) as u8];
    // SAFETY: a live buffer of the length given; then the process ends.
    unsafe {
        libc::write(report, bytes.as_ptr().cast(), bytes.len());
        libc::_exit(127);
    }
}

/// Executes the program of an exec session in a child of this process, which from then on only supervises it: see
/// [`supervise`]. Returns only if there is no child.
fn exec_supervised(request: &Start<'_>, streams: &[RawFd], report: RawFd) -> (StartStage, c_int) {
    // SAFETY: one thread; the child goes straight to exec or _exit. The descriptors that are closed are those of init:
    // its copies of the streams would keep a reader from ever seeing the end.
    unsafe {
        // Whatever the program leaves behind becomes a child of this process.
        libc::prctl(libc::PR_SET_CHILD_SUBREAPER, 1);
        let program = libc::fork();
        if program < 0 {
            return (StartStage::Fork, errno());
        }
        if program == 0 {
            report_failure(report, exec_program(request, streams));
        }
        for fd in FIRST_FREE..INIT_DESCRIPTORS {
            libc::close(fd);
        }
        libc::_exit(supervise(program));
    }
}

/// Waits until the program and all its descendants have ended, and returns its exit status, 128 more than the number of
/// a signal that killed it. Once it has ended, or on SIGTERM, its descendants are killed, whatever sessions or groups
/// they have made for themselves.
fn supervise(program: libc::pid_t) -> c_int {
    let mut ended = None;
    let mut is_ending = false;
    // SAFETY: the set is initialised before it is used; `status` and `timeout` are valid locations. All signals are
    // blocked already, so that one that comes before `sigtimedwait` is not missed.
    unsafe {
        let mut awaited: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&mut awaited);
        libc::sigaddset(&mut awaited, libc::SIGCHLD);
        libc::sigaddset(&mut awaited, libc::SIGTERM);
        loop {
            let mut status = 0;
            let pid = libc::waitpid(-1, &mut status, libc::WNOHANG);
            if pid == program {
                ended = Some(status);
            }
            if pid > 0 {
                continue;
            }
            let is_killing = is_ending || ended.is_some();
            if pid < 0 || (is_killing && !kill_children() && ended.is_some()) {
                break;
            }
            // The kernel's list of children may lack some while others end, so that it is read again.
            let timeout = libc::timespec { tv_sec: 0, tv_nsec: 50_000_000 };
            let timeout = if is_killing { ptr::from_ref(&timeout) } else { ptr::null() };
            if libc::sigtimedwait(&awaited, ptr::null_mut(), timeout) == libc::SIGTERM {
                is_ending = true;
                // Also where the children cannot be listed.
                libc::kill(-program, libc::SIGKILL);
            }
        }
    }
    match ended {
        Some(status) if libc::WIFEXITED(status) => libc::WEXITSTATUS(status),
        Some(status) => 128 + libc::WTERMSIG(status),
        None => EXIT_BROKEN,
    }
}

/// Kills the children of this process; their own children then become this process's. Returns false if the kernel does
/// not list them (proc(5): it needs CONFIG_PROC_CHILDREN). Of very many some are left for the next call.
fn kill_children() -> bool {
    let mut list = [0_u8; 4096];
    // SAFETY: the path is a literal, the buffer has the given length.
    let length = unsafe {
        let fd = libc::open(c"/proc/thread-self/children".as_ptr(), libc::O_RDONLY | libc::O_CLOEXEC);
        if fd < 0 {
            return false;
        }
        let length = libc::read(fd, list.as_mut_ptr().cast(), list.len());
        libc::close(fd);
        length
    };
    let mut pid: libc::pid_t = 0;
    for byte in list.iter().take(usize::try_from(length).unwrap_or(0)) {
        if byte.is_ascii_digit() {
            pid = pid.wrapping_mul(10).wrapping_add(libc::pid_t::from(byte - b'0'));
            continue;
        }
        // A space follows each number; without one the number may be cut off.
        if pid > 1 {
            // SAFETY: no pointers. It is a child of ours that is not reaped, so the pid is its own.
            unsafe { libc::kill(pid, libc::SIGKILL) };
        }
        pid = 0;
    }
    true
}

/// Makes the descriptors the standard streams: of a node output and error, of an exec session input, output and error,
/// or one terminal for all three, which becomes the controlling one.
fn place_streams(streams: &[RawFd]) -> bool {
    // SAFETY: calls on descriptors only.
    unsafe {
        match streams {
            [out, err] => libc::dup2(*out, 1) >= 0 && libc::dup2(*err, 2) >= 0,
            [input, out, err] => libc::dup2(*input, 0) >= 0 && libc::dup2(*out, 1) >= 0 && libc::dup2(*err, 2) >= 0,
            [terminal] => {
                (0..3).all(|stream| libc::dup2(*terminal, stream) >= 0) && libc::ioctl(0, libc::TIOCSCTTY, 0) == 0
            }
            _ => false,
        }
    }
}

/// Executes the program, in the child; returns only on failure.
fn exec_program(request: &Start<'_>, streams: &[RawFd]) -> (StartStage, c_int) {
    // SAFETY: after fork in a process with one thread. The strings end in zero bytes and their number was checked when
    // the request was decoded; the pointer table is large enough, and each of its two lists ends in null.
    unsafe {
        let mut none: libc::sigset_t = std::mem::zeroed();
        libc::sigemptyset(&mut none);
        for signal in 1..=64 {
            libc::signal(signal, libc::SIG_DFL);
        }
        libc::sigprocmask(libc::SIG_SETMASK, &none, ptr::null_mut());
        if libc::setsid() < 0 || !place_streams(streams) {
            return (StartStage::Prepare, errno());
        }
        libc::umask(0o022);
        let table = ptr::addr_of_mut!(POINTERS).cast::<*const c_char>();
        let mut at = 0;
        let mut slot = 0;
        let mut next = || {
            let text = request.strings[at..].as_ptr();
            at += request.strings[at..].iter().position(|byte| *byte == 0).unwrap_or(0) + 1;
            text.cast::<c_char>()
        };
        let directory = next();
        let mut list = |count: u16, table: *mut *const c_char, slot: &mut usize| {
            let start = table.add(*slot);
            for _ in 0..count {
                *table.add(*slot) = next();
                *slot += 1;
            }
            *table.add(*slot) = ptr::null();
            *slot += 1;
            start
        };
        let arguments = list(request.arguments, table, &mut slot);
        let variables = list(request.variables, table, &mut slot);
        if libc::chdir(directory) != 0 {
            return (StartStage::Directory, errno());
        }
        libc::execve(*arguments, arguments, variables);
        (StartStage::Execute, errno())
    }
}

/// Sends a reply; returns false when the shim has closed the socket.
fn send_reply(shim: RawFd, reply: InitReply, fds: &[RawFd]) -> bool {
    socket::send(shim, &reply.encode(), fds).is_ok()
}

fn errno() -> c_int {
    // SAFETY: always a valid location in this thread.
    unsafe { *libc::__errno_location() }
}
