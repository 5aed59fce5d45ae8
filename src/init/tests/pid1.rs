//! Tests of the real init as the first process of a pid namespace. Needs root.

use std::io::{Read, Write};
use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};
use std::process::{Child, Command, Stdio};

use init::socket::{self, MAX_FDS};
use init::{InitReply, InitRequest, Scope, StartRequest, StartStage};

const INIT: &str = env!("CARGO_BIN_EXE_cloudroid-init");

struct Init {
    socket: Option<OwnedFd>,
    process: Child,
}

impl Init {
    fn start() -> Self {
        let mut pair = [-1; 2];
        let kind = libc::SOCK_SEQPACKET | libc::SOCK_CLOEXEC;
        // SAFETY: an array of two for two descriptors.
        let made = unsafe { libc::socketpair(libc::AF_UNIX, kind, 0, pair.as_mut_ptr()) };
        assert_eq!(made, 0);
        // SAFETY: just created, owned by nobody else.
        let [ours, theirs] = pair.map(|fd| unsafe { OwnedFd::from_raw_fd(fd) });
        // A missing message must fail the test, not hang it.
        let patience = libc::timeval { tv_sec: 30, tv_usec: 0 };
        let length = size_of::<libc::timeval>() as libc::socklen_t;
        // SAFETY: a live structure of the given length.
        let set = unsafe {
            let value = std::ptr::addr_of!(patience).cast();
            libc::setsockopt(ours.as_raw_fd(), libc::SOL_SOCKET, libc::SO_RCVTIMEO, value, length)
        };
        assert_eq!(set, 0);
        let process = Command::new("unshare")
            .args(["--pid", "--fork", "--kill-child", "--mount-proc", INIT])
            .stdin(Stdio::from(theirs))
            .spawn()
            .expect("unshare, of util-linux; run this test as root");
        let init = Self { socket: Some(ours), process };
        assert_eq!(init.receive().0, InitReply::Ready);
        init
    }

    fn fd(&self) -> i32 {
        self.socket.as_ref().expect("not closed yet").as_raw_fd()
    }

    fn receive(&self) -> (InitReply, Option<OwnedFd>) {
        let (mut bytes, mut fds) = ([0; 64], [-1; MAX_FDS]);
        let (length, count) = socket::receive(self.fd(), &mut bytes, &mut fds).expect("an answer");
        // SAFETY: just received, owned by nobody else.
        let fd = (count > 0).then(|| unsafe { OwnedFd::from_raw_fd(fds[0]) });
        (InitReply::decode(&bytes[..length]).expect("one of ours"), fd)
    }

    /// Starts a shell script; its output can be read from the returned file.
    fn shell(&self, id: u32, script: &str) -> std::fs::File {
        self.run(id, &["/bin/sh", "-c", script], "/")
    }

    fn run(&self, id: u32, argv: &[&str], directory: &str) -> std::fs::File {
        let (read, write) = pipe();
        self.start_with(id, argv, directory, &[&write, &write]);
        read.into()
    }

    fn start_with(&self, id: u32, argv: &[&str], directory: &str, streams: &[&OwnedFd]) {
        let argv: Vec<String> = argv.iter().map(|word| (*word).to_owned()).collect();
        let environment = ["GREETING=hello".to_owned(), "PATH=/usr/bin:/bin".to_owned()];
        let request = StartRequest { id, directory, argv: &argv, environment: &environment };
        let streams: Vec<_> = streams.iter().map(|stream| stream.as_raw_fd()).collect();
        socket::send(self.fd(), &request.encode().unwrap(), &streams).unwrap();
    }

    fn expect_started(&self, id: u32) -> i32 {
        match self.receive() {
            (InitReply::Started { id: told, pid }, Some(_pidfd)) if told == id => pid,
            other => panic!("not started but {other:?}"),
        }
    }

    fn expect_exit(&self, pid: i32) -> i32 {
        match self.receive().0 {
            InitReply::Exited { pid: told, status } if told == pid => status,
            other => panic!("no end of {pid} but {other:?}"),
        }
    }
}

/// Returns the read end and the write end of a new pipe.
fn pipe() -> (OwnedFd, OwnedFd) {
    let mut pipe = [-1; 2];
    // SAFETY: an array of two for two descriptors.
    let made = unsafe { libc::pipe2(pipe.as_mut_ptr(), libc::O_CLOEXEC) };
    assert_eq!(made, 0);
    // SAFETY: just created, owned by nobody else.
    let [read, write] = pipe.map(|fd| unsafe { OwnedFd::from_raw_fd(fd) });
    (read, write)
}

impl Drop for Init {
    fn drop(&mut self) {
        self.socket = None;
        let _ = self.process.wait();
    }
}

#[test]
fn it_runs_programs_and_tells_how_they_end() {
    let init = Init::start();
    let mut printed = init.shell(1, "echo $GREETING $(pwd); cat; exit 3");
    let pid = init.expect_started(1);
    assert_eq!(init.expect_exit(pid), 3 << 8);
    let mut text = String::new();
    printed.read_to_string(&mut text).unwrap();
    assert_eq!(text, "hello /\n", "and its standard input was empty");
}

#[test]
fn what_cannot_be_executed_is_told_apart_with_its_error() {
    let init = Init::start();
    init.run(1, &["/no/such/program"], "/");
    assert_eq!(init.receive().0, InitReply::Failed { id: 1, errno: libc::ENOENT, stage: StartStage::Execute });
    init.run(2, &["/bin/sh"], "/no/such/directory");
    assert_eq!(init.receive().0, InitReply::Failed { id: 2, errno: libc::ENOENT, stage: StartStage::Directory });
    socket::send(init.fd(), b"nonsense", &[]).unwrap();
    init.shell(3, "exit 0");
    assert_eq!(init.expect_exit(init.expect_started(3)), 0, "nonsense is passed over");
}

#[test]
fn programs_begin_with_ordinary_signals_and_a_session_of_their_own() {
    let init = Init::start();
    // The test process ignores SIGPIPE, as every Rust program does.
    init.shell(1, "kill -PIPE $$; exit 0");
    let pid = init.expect_started(1);
    assert_eq!(init.expect_exit(pid), libc::SIGPIPE);
    let mut printed = init.shell(2, "trap '' INT; sleep 60 & echo up; wait");
    let pid = init.expect_started(2);
    // The script's child must exist before the group is killed.
    let mut line = [0; 3];
    printed.read_exact(&mut line).unwrap();
    socket::send(init.fd(), &InitRequest::encode_signal(pid, libc::SIGKILL, Scope::Group), &[]).unwrap();
    assert_eq!(init.expect_exit(pid) & 0x7f, libc::SIGKILL);
    let orphan = init.receive().0;
    assert!(
        matches!(orphan, InitReply::Exited { status: libc::SIGKILL, .. }),
        "its child, in the same group: {orphan:?}"
    );
}

#[test]
fn orphans_are_reaped_and_told() {
    let init = Init::start();
    init.shell(1, "(sleep 0.1; exit 7) & exit 0");
    let pid = init.expect_started(1);
    assert_eq!(init.expect_exit(pid), 0);
    assert!(matches!(init.receive().0, InitReply::Exited { status: 0x700, .. }));
}

/// Leaves processes behind in sessions of their own, which hold the pipe open.
const LEAVES_CHILDREN: &str = "trap '' TERM HUP; setsid sleep 600 & (setsid sh -c 'sleep 600 & sleep 600' &); echo up;";

#[test]
fn the_program_of_an_exec_session_reads_its_input_and_leaves_nothing_behind() {
    let init = Init::start();
    let ((input, typed), (printed, out)) = (pipe(), pipe());
    let script = format!("{LEAVES_CHILDREN} cat; exit 5");
    init.start_with(1, &["/bin/sh", "-c", &script], "/", &[&input, &out, &out]);
    drop((input, out));
    let pid = init.expect_started(1);
    std::fs::File::from(typed).write_all(b"typed\n").unwrap();
    assert_eq!(init.expect_exit(pid), 5 << 8);
    let mut text = String::new();
    std::fs::File::from(printed).read_to_string(&mut text).unwrap();
    assert_eq!(text, "up\ntyped\n", "and nobody holds the other end");
}

#[test]
fn an_exec_session_that_is_ended_is_killed_with_all_that_it_has_started() {
    let init = Init::start();
    let ((input, typed), (printed, out)) = (pipe(), pipe());
    let script = format!("{LEAVES_CHILDREN} sleep 600");
    init.start_with(1, &["/bin/sh", "-c", &script], "/", &[&input, &out, &out]);
    drop((input, out));
    let pid = init.expect_started(1);
    let mut printed = std::fs::File::from(printed);
    let mut line = [0; 3];
    printed.read_exact(&mut line).unwrap();
    socket::send(init.fd(), &InitRequest::encode_signal(pid, libc::SIGTERM, Scope::Process), &[]).unwrap();
    assert_eq!(init.expect_exit(pid), (128 + libc::SIGKILL) << 8);
    let mut text = String::new();
    printed.read_to_string(&mut text).unwrap();
    assert_eq!(text, "", "and nobody holds the other end");
    drop(typed);
    init.start_with(2, &["/no/such/program"], "/", &[&pipe().0, &pipe().1, &pipe().1]);
    assert_eq!(init.receive().0, InitReply::Failed { id: 2, errno: libc::ENOENT, stage: StartStage::Execute });
}

#[test]
fn a_terminal_is_the_controlling_one() {
    let init = Init::start();
    let (mut ours, mut theirs) = (-1, -1);
    let (name, termios, size) = (std::ptr::null_mut(), std::ptr::null(), std::ptr::null());
    // SAFETY: two valid locations; nothing else is asked for.
    let made = unsafe { libc::openpty(&mut ours, &mut theirs, name, termios, size) };
    assert_eq!(made, 0);
    // SAFETY: just created, owned by nobody else.
    let [ours, theirs] = [ours, theirs].map(|fd| unsafe { OwnedFd::from_raw_fd(fd) });
    let script = "trap 'exit 9' INT; test -t 0 && test -t 2 && echo up; while :; do sleep 0.1; done";
    init.start_with(1, &["/bin/sh", "-c", script], "/", &[&theirs]);
    let pid = init.expect_started(1);
    let mut terminal = std::fs::File::from(ours);
    let mut line = [0; 4];
    terminal.read_exact(&mut line).unwrap();
    assert_eq!(&line, b"up\r\n");
    // Ctrl-C, which the terminal turns into a signal.
    terminal.write_all(b"\x03").unwrap();
    assert_eq!(init.expect_exit(pid), 9 << 8);
}

#[test]
fn when_the_socket_closes_everything_ends() {
    let mut init = Init::start();
    let mut printed = init.shell(1, "trap '' INT TERM HUP; setsid sleep 600 & sleep 600");
    init.expect_started(1);
    init.socket = None;
    assert!(init.process.wait().unwrap().success());
    let mut text = String::new();
    printed.read_to_string(&mut text).unwrap();
    assert_eq!(text, "", "and nobody holds the other end of the pipe");
}

#[test]
fn it_is_pid_1_or_nothing() {
    let status = Command::new(INIT).stdin(Stdio::null()).status().unwrap();
    assert_eq!(status.code(), Some(64));
}
