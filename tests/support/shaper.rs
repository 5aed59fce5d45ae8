//! What netem does, for kernels without it: packets between two TUN devices are delayed, lost and slowed down. The
//! order of packets is kept, as netem keeps it without jitter, and as a rate makes it keep it with jitter.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::AsRawFd;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;

use crate::cable::Badness;

/// Packets that may wait while the network is good.
const GOOD_LIMIT: u32 = 1000;
/// Larger than any packet of a device whose MTU is not changed.
const PACKET: usize = 4096;

/// Ends with the devices: its threads stop once these are deleted.
pub struct Shaper {
    ways: [Arc<Way>; 2],
}

/// One direction.
#[derive(Default)]
struct Way {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    badness: Option<Badness>,
    /// Packets, and when they arrive.
    under_way: VecDeque<(Instant, Vec<u8>)>,
    /// When the last packet has left.
    free: Option<Instant>,
    /// For losses, the same in each run.
    random: u64,
    over: bool,
}

impl Shaper {
    /// Makes both devices and joins them.
    pub fn between(one: &str, other: &str) -> anyhow::Result<Self> {
        let (one, other) = (device(one)?, device(other)?);
        let ways = [way(one.try_clone()?, other.try_clone()?), way(other, one)];
        Ok(Self { ways })
    }

    /// From now on; what is under way and was slowed down arrives at once when the network is good again.
    pub fn set(&self, badness: Option<Badness>) {
        for way in &self.ways {
            let mut state = way.state();
            state.badness = badness;
            if badness.is_none() {
                let now = Instant::now();
                for (due, _) in &mut state.under_way {
                    *due = now.min(*due);
                }
                state.free = None;
            }
            way.changed.notify_one();
        }
    }
}

impl Way {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// A packet has come: it is lost, or it waits.
    fn take(&mut self, packet: &[u8], now: Instant) {
        let badness = self.badness;
        let limit = badness.map_or(GOOD_LIMIT, |badness| badness.limit);
        if self.under_way.len() >= limit as usize {
            return;
        }
        let due = match badness {
            Some(badness) if self.is_lost(badness.loss) => return,
            Some(badness) => {
                let bits = packet.len() as f64 * 8.0;
                let takes = Duration::from_secs_f64(bits / (f64::from(badness.rate) * 1e3));
                let left = self.free.unwrap_or(now).max(now) + takes;
                self.free = Some(left);
                left + self.on_the_way(&badness)
            }
            None => now,
        };
        let after = self
            .under_way
            .back()
            .map_or(due, |(last, _)| due.max(*last));
        self.under_way.push_back((after, packet.to_vec()));
    }

    /// The delay, more or less as much as the jitter.
    fn on_the_way(&mut self, badness: &Badness) -> Duration {
        let jitter = f64::from(badness.jitter);
        let more = if badness.jitter == 0 {
            0.0
        } else {
            jitter * (2.0 * self.random() - 1.0)
        };
        Duration::from_secs_f64((f64::from(badness.delay) + more).max(0.0) / 1e3)
    }

    fn is_lost(&mut self, share: f64) -> bool {
        self.random() < share
    }

    /// From 0 to 1; xorshift (Marsaglia, 2003).
    fn random(&mut self) -> f64 {
        let mut random = self.random | 1;
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        self.random = random;
        (random >> 11) as f64 / (1_u64 << 53) as f64
    }
}

fn way(mut from: File, mut to: File) -> Arc<Way> {
    let way = Arc::new(Way::default());
    way.state().random = 0x9e37_79b9_7f4a_7c15;
    let taking = way.clone();
    std::thread::spawn(move || {
        let mut packet = [0; PACKET];
        while let Ok(length) = from.read(&mut packet) {
            taking.state().take(&packet[..length], Instant::now());
            taking.changed.notify_one();
        }
        taking.state().over = true;
        taking.changed.notify_one();
    });
    let giving = way.clone();
    std::thread::spawn(move || {
        while let Some(packet) = next(&giving) {
            // What a device cannot take is lost.
            let _ = to.write(&packet);
        }
    });
    way
}

/// The next packet, when it is due; none once the device is gone.
fn next(way: &Way) -> Option<Vec<u8>> {
    let mut state = way.state();
    loop {
        if state.over {
            return None;
        }
        let now = Instant::now();
        let due = state.under_way.front().map(|(due, _)| *due);
        state = match due {
            Some(due) if due <= now => {
                return state.under_way.pop_front().map(|(_, packet)| packet);
            }
            Some(due) => {
                let waited = way.changed.wait_timeout(state, due - now);
                waited.unwrap_or_else(PoisonError::into_inner).0
            }
            None => way
                .changed
                .wait(state)
                .unwrap_or_else(PoisonError::into_inner),
        };
    }
}

mod request {
    nix::ioctl_write_ptr_bad!(
        tun_set_iff,
        nix::request_code_write!(b'T', 202, 4),
        super::Request
    );
}

/// `struct ifreq` of linux/if.h, as TUNSETIFF takes it.
#[repr(C)]
pub struct Request {
    name: [u8; 16],
    flags: u16,
    rest: [u8; 22],
}

/// IFF_TUN and IFF_NO_PI of linux/if_tun.h: bare IP packets.
const TUN_WITHOUT_HEAD: u16 = 0x0001 | 0x1000;

/// A TUN device of this namespace; it is gone when all who hold it are.
#[allow(unsafe_code)]
fn device(name: &str) -> anyhow::Result<File> {
    let path = "/dev/net/tun";
    let file = File::options().read(true).write(true).open(path);
    let file = file.context(path)?;
    let mut request = Request {
        name: [0; 16],
        flags: TUN_WITHOUT_HEAD,
        rest: [0; 22],
    };
    anyhow::ensure!(name.len() < request.name.len(), "{name} is too long");
    request.name[..name.len()].copy_from_slice(name.as_bytes());
    // SAFETY: the kernel reads and writes one ifreq, which `request` is and which outlives the call.
    unsafe { request::tun_set_iff(file.as_raw_fd(), &request) }.with_context(|| name.to_owned())?;
    Ok(file)
}
