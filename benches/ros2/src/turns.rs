//! Measurements that take turns, so that disturbances affect all of them.

use std::fmt::Display;

use anyhow::Result;
use bench_report::BenchReport;

use crate::rivals::Server;
use crate::world::keep_cores_awake;

/// Measures every path in each round, each second one backwards; returns the results of each path. A path through
/// another server (see `server`) may fail: it is reported as skipped, and is `None`.
pub(crate) fn measure_in_turns<P: Display, T>(
    report: &mut BenchReport,
    what: &str,
    rounds: usize,
    paths: &[P],
    server: impl Fn(&P) -> Option<&Server>,
    measure: impl Fn(&P) -> Result<T>,
) -> Result<Vec<Option<Vec<T>>>> {
    let _awake = keep_cores_awake()?;
    let mut turns: Vec<Option<Vec<T>>> = paths.iter().map(|_| Some(Vec::new())).collect();
    for round in 1..=rounds {
        eprintln!("{what}: round {round} of {rounds}");
        let mut order: Vec<usize> = (0..paths.len()).collect();
        if round % 2 == 0 {
            order.reverse();
        }
        for at in order {
            let Some(found) = &mut turns[at] else { continue };
            match measure(&paths[at]) {
                Ok(one) => found.push(one),
                Err(why) if matches!(server(&paths[at]), Some(Server::Rival(_))) => {
                    report.skip(format!("{what}, {}", paths[at]), format!("{why:#}"));
                    turns[at] = None;
                }
                Err(why) => return Err(why),
            }
        }
    }
    Ok(turns)
}
