//! A proxy in front of a portal that can freeze its connections: they stay established and carry nothing any more.
//! Later connections work.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// The proxy; stops on drop, with all its connections.
pub struct Freezer {
    /// Address of the portal for the robot.
    pub server: SocketAddr,
    shared: Arc<Shared>,
}

#[derive(Default)]
struct Shared {
    /// Connections up to this number are frozen.
    frozen: AtomicUsize,
    over: AtomicBool,
    open: Mutex<Vec<TcpStream>>,
}

impl Freezer {
    /// Creates a proxy that forwards connections to `portal`.
    pub fn new(portal: &str) -> anyhow::Result<Self> {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let server = listener.local_addr()?;
        let shared = Arc::new(Shared::default());
        let (portal, passing) = (portal.to_owned(), Arc::clone(&shared));
        std::thread::spawn(move || accept(&listener, &portal, &passing));
        Ok(Self { server, shared })
    }

    /// Freezes all current connections; returns how many there have been so far.
    pub fn freeze(&self) -> usize {
        let count = self.shared.open().len() / 2;
        self.shared.frozen.store(count, Ordering::Relaxed);
        count
    }
}

impl Drop for Freezer {
    fn drop(&mut self) {
        self.shared.over.store(true, Ordering::Relaxed);
        for open in self.shared.open().drain(..) {
            let _ = open.shutdown(Shutdown::Both);
        }
        // Wakes the accepting thread.
        let _ = TcpStream::connect(self.server);
    }
}

impl Shared {
    fn open(&self) -> std::sync::MutexGuard<'_, Vec<TcpStream>> {
        self.open.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn accept(listener: &TcpListener, portal: &str, shared: &Arc<Shared>) {
    for robot in listener.incoming().flatten() {
        if shared.over.load(Ordering::Relaxed) {
            return;
        }
        let Ok(cloud) = TcpStream::connect(portal) else {
            continue;
        };
        let _ = (robot.set_nodelay(true), cloud.set_nodelay(true));
        let ends = [robot.try_clone(), cloud.try_clone()];
        let number = {
            let mut open = shared.open();
            open.extend(ends.into_iter().flatten());
            open.len() / 2
        };
        let (Ok(robot_too), Ok(cloud_too)) = (robot.try_clone(), cloud.try_clone()) else {
            continue;
        };
        let (up, down) = (Arc::clone(shared), Arc::clone(shared));
        std::thread::spawn(move || copy(robot, cloud, number, &up));
        std::thread::spawn(move || copy(cloud_too, robot_too, number, &down));
    }
}

fn copy(mut from: TcpStream, mut to: TcpStream, number: usize, shared: &Shared) {
    let mut buffer = vec![0; 1 << 14];
    while let Ok(count) = from.read(&mut buffer) {
        let frozen = shared.frozen.load(Ordering::Relaxed) >= number;
        // The end of a connection is not forwarded either.
        if frozen && count > 0 {
            continue;
        }
        if frozen || count == 0 || to.write_all(&buffer[..count]).is_err() {
            if frozen {
                return;
            }
            break;
        }
    }
    let _ = (from.shutdown(Shutdown::Both), to.shutdown(Shutdown::Both));
}
