//! Robots that connect and leave at once.

use std::net::{SocketAddr, TcpListener};
use std::time::{Duration, Instant};

use anyhow::Result;
use bench_report::BenchReport;
use support::daemon::Daemon;
use support::robot::Robot;
use tokio_tungstenite::tungstenite;

use super::join_thread;
use crate::greeters;

/// Duration of the load, and number of threads that create it.
const TIME: Duration = Duration::from_secs(5);
const THREADS: usize = 4;

pub(super) fn measure(report: &mut BenchReport, daemon: &Daemon) -> Result<()> {
    let bare = accept_upgrades()?;
    let path = greeters::robot_path("crowd");
    let ours = connections_per_second(&daemon.address, &path)?;
    let bare = connections_per_second(&bare.to_string(), "")?;
    report
        .figure("robots that connect and leave", "/s", ours)
        .relative_to("a WebSocket server with nothing behind it", bare)
        .note(format!("{THREADS} at a time"));
    Ok(())
}

/// Starts a server that accepts upgrades, and nothing else, until this program ends.
fn accept_upgrades() -> Result<SocketAddr> {
    let listener = TcpListener::bind("127.0.0.1:0")?;
    let address = listener.local_addr()?;
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            std::thread::spawn(move || {
                if let Ok(mut socket) = tungstenite::accept(stream) {
                    while socket.read().is_ok() {}
                }
            });
        }
    });
    Ok(address)
}

fn connections_per_second(address: &str, path: &str) -> Result<f64> {
    let url = format!("ws://{address}/{path}");
    let began = Instant::now();
    let come = || -> Result<u32> {
        let mut count = 0;
        while began.elapsed() < TIME {
            Robot::connect(&url)?.leave()?;
            count += 1;
        }
        Ok(count)
    };
    let counts = std::thread::scope(|scope| {
        let all: Vec<_> = (0..THREADS).map(|_| scope.spawn(come)).collect();
        all.into_iter().map(join_thread).collect::<Result<Vec<u32>>>()
    })?;
    Ok(f64::from(counts.iter().sum::<u32>()) / began.elapsed().as_secs_f64())
}
