//! A replacement for netem on kernels without it: delays, drops and slows down packets between two TUN devices. The
//! order of packets is preserved, as by netem without jitter, or with jitter and a rate.

use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::AsRawFd;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;

use crate::cable::NetworkImpairment;

/// Maximum number of queued packets without an impairment.
const GOOD_LIMIT: u32 = 1000;
/// More than the size of any packet at the default MTU.
const PACKET: usize = 4096;

/// Shapes the traffic between two devices; its threads end once the devices are deleted.
pub struct Shaper {
    ways: [Arc<ShaperDirection>; 2],
}

/// One direction.
#[derive(Default)]
struct ShaperDirection {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    badness: Option<NetworkImpairment>,
    /// Packets with their arrival times.
    under_way: VecDeque<(Instant, Vec<u8>)>,
    /// Time at which the last packet has been sent.
    free: Option<Instant>,
    /// State of the generator for losses, the same in each run.
    random: u64,
    over: bool,
}

impl Shaper {
    /// Creates both devices and connects them.
    pub fn join_devices(one: &str, other: &str) -> anyhow::Result<Self> {
        let (one, other) = (open_tun(one)?, open_tun(other)?);
        let ways = [spawn_direction(one.try_clone()?, other.try_clone()?), spawn_direction(other, one)];
        Ok(Self { ways })
    }

    /// Sets the impairment; when it is removed, delayed packets arrive at once.
    pub fn set_impairment(&self, badness: Option<NetworkImpairment>) {
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

impl ShaperDirection {
    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl State {
    /// Drops or queues an arrived packet.
    fn enqueue(&mut self, packet: &[u8], now: Instant) {
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
                left + self.transit_delay(&badness)
            }
            None => now,
        };
        let after = self.under_way.back().map_or(due, |(last, _)| due.max(*last));
        self.under_way.push_back((after, packet.to_vec()));
    }

    /// Returns the delay of a packet, including jitter.
    fn transit_delay(&mut self, badness: &NetworkImpairment) -> Duration {
        let jitter = f64::from(badness.jitter);
        let more = if badness.jitter == 0 { 0.0 } else { jitter * (2.0 * self.random() - 1.0) };
        Duration::from_secs_f64((f64::from(badness.delay) + more).max(0.0) / 1e3)
    }

    fn is_lost(&mut self, share: f64) -> bool {
        self.random() < share
    }

    /// Returns a number from 0 to 1 by xorshift (Marsaglia, 2003).
    fn random(&mut self) -> f64 {
        let mut random = self.random | 1;
        random ^= random << 13;
        random ^= random >> 7;
        random ^= random << 17;
        self.random = random;
        (random >> 11) as f64 / (1_u64 << 53) as f64
    }
}

fn spawn_direction(mut from: File, mut to: File) -> Arc<ShaperDirection> {
    let way = Arc::new(ShaperDirection::default());
    way.state().random = 0x9e37_79b9_7f4a_7c15;
    let taking = way.clone();
    std::thread::spawn(move || {
        let mut packet = [0; PACKET];
        while let Ok(length) = from.read(&mut packet) {
            taking.state().enqueue(&packet[..length], Instant::now());
            taking.changed.notify_one();
        }
        taking.state().over = true;
        taking.changed.notify_one();
    });
    let giving = way.clone();
    std::thread::spawn(move || {
        while let Some(packet) = next_packet(&giving) {
            // A packet that the device does not accept is lost.
            let _ = to.write(&packet);
        }
    });
    way
}

/// Waits for the next packet to be due and returns it; `None` once the device is deleted.
fn next_packet(way: &ShaperDirection) -> Option<Vec<u8>> {
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
            None => way.changed.wait(state).unwrap_or_else(PoisonError::into_inner),
        };
    }
}

mod request {
    nix::ioctl_write_ptr_bad!(tun_set_iff, nix::request_code_write!(b'T', 202, 4), super::TunRequest);
}

/// `struct ifreq` of linux/if.h, as TUNSETIFF takes it.
#[repr(C)]
pub struct TunRequest {
    name: [u8; 16],
    flags: u16,
    rest: [u8; 22],
}

/// IFF_TUN and IFF_NO_PI of linux/if_tun.h: bare IP packets.
const TUN_WITHOUT_HEAD: u16 = 0x0001 | 0x1000;

/// Opens a TUN device of this namespace, which exists until all descriptors are closed.
#[allow(unsafe_code)]
fn open_tun(name: &str) -> anyhow::Result<File> {
    let path = "/dev/net/tun";
    let file = File::options().read(true).write(true).open(path);
    let file = file.context(path)?;
    let mut request = TunRequest { name: [0; 16], flags: TUN_WITHOUT_HEAD, rest: [0; 22] };
    anyhow::ensure!(name.len() < request.name.len(), "{name} is too long");
    request.name[..name.len()].copy_from_slice(name.as_bytes());
    // SAFETY: the kernel reads and writes one ifreq, which is `request` and outlives the call.
    unsafe { request::tun_set_iff(file.as_raw_fd(), &request) }.with_context(|| name.to_owned())?;
    Ok(file)
}
