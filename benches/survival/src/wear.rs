//! What one daemon lives through, twice: what it holds afterwards must not have grown by the second time. By the first it may: what is made
//! once, and kept as large as it was ever needed, is made then.

use anyhow::Result;
use bench_report::Report;
use support::daemon::Daemon;

use crate::crowds::{self, Crowds};
use crate::half_open::{self, HalfOpen};
use crate::kills::{self, Kills, Victim};
use crate::resources::Resources;

/// One time.
struct Wear {
    kills: Vec<Kills>,
    crowds: Crowds,
    half_open: HalfOpen,
}

/// Does all of it twice, the second time with so many kills of each; few of what takes longer.
pub(crate) fn measure(report: &mut Report, daemon: &Daemon, kills: u32, few: u32) -> Result<()> {
    Wear::of(daemon, few, few)?;
    let before = Resources::at_rest(daemon.pid())?;
    let wear = Wear::of(daemon, kills, few)?;
    let after = Resources::at_rest(daemon.pid())?;
    for kills in &wear.kills {
        kills.tell(report);
    }
    wear.crowds.tell(report);
    wear.half_open.tell(report);
    after.tell(
        report,
        "all this a second time",
        ("after the first time", before),
    );
    Ok(())
}

impl Wear {
    fn of(daemon: &Daemon, kills: u32, few: u32) -> Result<Self> {
        say(daemon, "before")?;
        let mut all = Vec::new();
        for victim in Victim::ALL {
            all.push(kills::in_servants(daemon, victim, kills)?);
            say(daemon, &format!("{kills} kills of a servant's {victim}"))?;
        }
        let crowds = crowds::measure(daemon)?;
        say(daemon, "crowds")?;
        let half_open = half_open::measure(daemon, few)?;
        say(daemon, "half-open connections")?;
        Ok(Self {
            kills: all,
            crowds,
            half_open,
        })
    }
}

/// Says which part made the daemon hold more.
fn say(daemon: &Daemon, after: &str) -> Result<()> {
    eprintln!("{after}: {:?}", Resources::of(daemon.pid())?);
    Ok(())
}
