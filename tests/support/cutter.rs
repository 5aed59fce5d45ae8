//! A proxy in front of a portal that cuts its connections repeatedly, at arbitrary positions in the byte stream.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// The proxy; stops on drop.
pub struct Cutter {
    /// Address of the portal for the robot.
    pub server: SocketAddr,
    shared: Arc<Shared>,
}

struct Shared {
    cuts: AtomicUsize,
    over: AtomicBool,
    closed: AtomicBool,
    state: Mutex<State>,
}

struct State {
    /// Bytes until the next cut; `None` if there are no more cuts.
    left: Option<usize>,
    remaining: usize,
    longest: usize,
    random: u64,
    open: Vec<TcpStream>,
}

impl Cutter {
    /// Creates a proxy that cuts `cuts` times, each after 1 to `longest` bytes, determined by `seed`.
    pub fn new(portal: &str, cuts: usize, longest: usize, seed: u64) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let server = listener.local_addr()?;
        let shared = Arc::new(Shared {
            cuts: AtomicUsize::new(0),
            over: AtomicBool::new(false),
            closed: AtomicBool::new(false),
            state: Mutex::new(State { left: None, remaining: cuts, longest, random: seed | 1, open: Vec::new() }),
        });
        let (portal, passing) = (portal.to_owned(), Arc::clone(&shared));
        std::thread::spawn(move || accept(&listener, server, &portal, &passing));
        Ok(Self { server, shared })
    }

    /// Starts to cut.
    pub fn begin(&self) {
        self.shared.state().draw();
    }

    /// Cuts all current connections; with `closed` later connections are refused, otherwise they are forwarded.
    pub fn cut(&self, closed: bool) {
        self.shared.closed.store(closed, Ordering::Relaxed);
        self.shared.state().cut();
    }

    /// Number of cuts so far.
    pub fn cuts(&self) -> usize {
        self.shared.cuts.load(Ordering::Relaxed)
    }
}

impl Drop for Cutter {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Relaxed);
        self.shared.state().cut();
        // Wakes the accepting thread.
        let _ = TcpStream::connect(self.server);
    }
}

impl Shared {
    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns how many of `bytes` may pass; if fewer than all, the cut follows.
    fn pass(&self, bytes: usize) -> usize {
        let state = &mut *self.state();
        match &mut state.left {
            Some(left) if *left < bytes => *left,
            Some(left) => {
                *left -= bytes;
                bytes
            }
            None => bytes,
        }
    }

    fn cut(&self) {
        let state = &mut *self.state();
        state.cut();
        // Both directions may have reached the same cut.
        if state.left.is_none() {
            return;
        }
        state.remaining -= 1;
        state.left = None;
        if state.remaining > 0 {
            state.draw();
        }
        self.cuts.fetch_add(1, Ordering::Relaxed);
    }
}

impl State {
    /// Draws the number of bytes until the next cut, by xorshift (Marsaglia, 2003).
    fn draw(&mut self) {
        self.random ^= self.random << 13;
        self.random ^= self.random >> 7;
        self.random ^= self.random << 17;
        let bytes = usize::try_from(self.random >> 33).unwrap_or(0) % self.longest;
        self.left = Some(bytes + 1);
    }

    fn cut(&mut self) {
        for open in self.open.drain(..) {
            let _ = open.shutdown(Shutdown::Both);
        }
    }
}

fn accept(listener: &TcpListener, server: SocketAddr, portal: &str, shared: &Arc<Shared>) {
    for robot in listener.incoming().flatten() {
        if shared.over.load(Ordering::Relaxed) {
            return;
        }
        if shared.closed.load(Ordering::Relaxed) {
            continue;
        }
        let Ok(cloud) = TcpStream::connect(portal) else {
            continue;
        };
        let _ = (robot.set_nodelay(true), cloud.set_nodelay(true));
        let clones = (robot.try_clone(), cloud.try_clone());
        let (Ok(robot_too), Ok(cloud_too)) = clones else {
            continue;
        };
        shared.state().open.extend([robot.try_clone(), cloud.try_clone()].into_iter().flatten());
        let (up, down) = (Arc::clone(shared), Arc::clone(shared));
        // Replaces the host name by the portal's own, as a reverse proxy does.
        let names = (server.to_string(), portal.to_owned());
        std::thread::spawn(move || copy(robot, cloud, Some(names), &up));
        std::thread::spawn(move || copy(cloud_too, robot_too, None, &down));
    }
}

fn copy(mut from: TcpStream, mut to: TcpStream, mut names: Option<(String, String)>, shared: &Shared) {
    let mut buffer = vec![0; 1 << 14];
    while let Ok(count) = from.read(&mut buffer) {
        if count == 0 {
            break;
        }
        let mut bytes = buffer[..count].to_vec();
        if let Some((ours, theirs)) = names.take() {
            bytes = String::from_utf8_lossy(&bytes).replace(&ours, &theirs).into_bytes();
        }
        let passes = shared.pass(bytes.len());
        if to.write_all(&bytes[..passes]).is_err() {
            break;
        }
        if passes < bytes.len() {
            shared.cut();
            break;
        }
    }
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
