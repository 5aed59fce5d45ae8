//! `events`: the daemon's event journal.

use std::collections::BTreeSet;
use std::time::Duration;

use api::{EVENT_KINDS, Event, Level, Problem};
use futures_util::StreamExt;

use crate::client::{self, DaemonClient, percent_encode};
use crate::colour::Colour;
use crate::output::{self, OutputFormat};

/// Interval between attempts to reach the daemon.
const RETRY: Duration = Duration::from_millis(250);
/// Limit that exceeds the size of any journal.
const ALL: u32 = u32::MAX;

/// Print recent events: pushes, starts, failures.
#[derive(Debug, clap::Args)]
pub struct EventsArgs {
    /// Number of recent events.
    #[arg(short = 'n', long, default_value_t = 50, value_name = "EVENTS")]
    tail: u32,
    /// Keep printing new events.
    #[arg(short, long)]
    follow: bool,
    /// Only events of this kind, such as node-hung. For an unknown kind, the error lists all; docs/operators.md
    /// describes them.
    #[arg(long, value_name = "KIND")]
    kind: Option<String>,
    /// Only events of this service.
    #[arg(long, value_name = "SERVICE")]
    service: Option<String>,
    /// Only events of this servant.
    #[arg(long, value_name = "SERVANT")]
    servant: Option<String>,
    /// Only events of this robot.
    #[arg(long, value_name = "ROBOT")]
    robot: Option<String>,
}

impl EventsArgs {
    /// Sends the request and prints the events.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        if let Some(kind) = self.kind.as_deref().filter(|kind| !EVENT_KINDS.contains(kind)) {
            check_kind(client, kind).await?;
        }
        if self.follow {
            return self.follow(client, format).await;
        }
        let path = format!("/api/v1/events?{}", self.query(0, self.tail));
        let events: Vec<Event> = client.get(&path).await?;
        if let (true, Some(kind)) = (events.is_empty(), &self.kind) {
            output::eprint_line(&format!("no event of kind {kind} in the journal"));
        }
        match format {
            OutputFormat::Json => output::json(&events),
            OutputFormat::Table => events.iter().try_for_each(print),
        }
    }

    /// Prints events until the process is ended. After a restart of the daemon, missed events are printed, and none
    /// twice.
    async fn follow(&self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        // An endless output is one event per line.
        let print = |event: &Event| match format {
            OutputFormat::Json => output::json_line(event),
            OutputFormat::Table => print(event),
        };
        let (mut begun, mut last) = (false, None);
        loop {
            let query = match last {
                None => self.query(0, self.tail),
                Some(last) => self.query(last, ALL),
            };
            let path = format!("/api/v1/events/follow?{query}");
            let mut events = match client.get_lines::<Event>(&path).await {
                Ok(events) => events,
                // The daemon answered before, so it may come back.
                Err(error) if begun && client::is_unavailable(&error) => {
                    self.wait_for_daemon(client).await?;
                    continue;
                }
                Err(error) => return Err(error),
            };
            begun = true;
            while let Some(event) = events.next().await {
                let event = match event {
                    Ok(event) => event,
                    Err(error) if client::is_unavailable(&error) => break,
                    Err(error) => return Err(error),
                };
                last = Some(last.unwrap_or(0).max(event.id));
                print(&event)?;
            }
            self.wait_for_daemon(client).await?;
        }
    }

    /// Waits until the daemon answers.
    async fn wait_for_daemon(&self, client: &DaemonClient) -> anyhow::Result<()> {
        let mut told = false;
        loop {
            match client.get::<api::Clock>("/api/v1/clock").await {
                Ok(_) => return Ok(()),
                Err(error) if client::is_unavailable(&error) => {
                    if !std::mem::replace(&mut told, true) {
                        output::eprint_line(&format!("{error:#}; waiting for the daemon"));
                    }
                    tokio::time::sleep(RETRY).await;
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn query(&self, since: i64, limit: u32) -> String {
        let filter =
            [("kind", &self.kind), ("service", &self.service), ("servant", &self.servant), ("robot", &self.robot)];
        let filter = filter.into_iter();
        let filter: String =
            filter.filter_map(|(key, value)| Some(format!("&{key}={}", percent_encode(value.as_ref()?)))).collect();
        format!("since={since}&limit={limit}{filter}")
    }
}

fn print(event: &Event) -> anyhow::Result<()> {
    let colour = match event.level {
        Level::Info => None,
        Level::Warning => Some(Colour::Yellow),
        Level::Error => Some(Colour::Red),
    };
    output::line(&output::colour_text(&format_event(event), colour))
}

fn format_event(event: &Event) -> String {
    let mark = match event.level {
        Level::Info => ' ',
        Level::Warning => '!',
        Level::Error => 'X',
    };
    let (time, kind) = (output::clock(event.time), &event.kind);
    format!("{time} {mark} {kind:<18} {}", event.message)
}

/// Fails if a kind that this version does not know is not in the journal of the daemon either, which may be newer.
async fn check_kind(client: &DaemonClient, kind: &str) -> anyhow::Result<()> {
    let all: Vec<Event> = client.get(&format!("/api/v1/events?since=0&limit={ALL}")).await?;
    let recorded: BTreeSet<&str> = all.iter().map(|event| event.kind.as_str()).collect();
    if recorded.contains(kind) { Ok(()) } else { Err(unknown_kind(kind, &recorded).into()) }
}

fn unknown_kind(kind: &str, recorded: &BTreeSet<&str>) -> Problem {
    let known: BTreeSet<&str> = recorded.iter().copied().chain(EVENT_KINDS).collect();
    Problem {
        kind: "urn:cloudroid:unknown-kind".to_owned(),
        title: "unknown kind of event".to_owned(),
        status: 404,
        detail: format!("there are no events of kind {kind}"),
        next: Some("name one of these kinds with --kind; docs/operators.md describes them".to_owned()),
        exists: known.into_iter().map(str::to_owned).collect(),
        ..Problem::default()
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        events: EventsArgs,
    }

    #[test]
    fn what_is_asked_for_is_what_was_typed() {
        let query = |line: &str| {
            let words = std::iter::once("events").chain(line.split_whitespace());
            let Line { events } = Line::try_parse_from(words).expect("valid");
            events.query(7, events.tail)
        };
        for (line, expected) in [
            ("", "since=7&limit=50"),
            ("-n 3 -f --kind node-hung", "since=7&limit=3&kind=node-hung"),
            ("--robot r&d --service s --servant s-1", "since=7&limit=50&service=s&servant=s-1&robot=r%26d"),
        ] {
            assert_eq!(query(line), expected, "{line}");
        }
        let event = Event {
            id: 1,
            time: 0,
            level: Level::Warning,
            kind: "node-hung".into(),
            service: None,
            servant: None,
            robot: None,
            message: "it hangs".into(),
        };
        let unknown = unknown_kind("node-hnug", &["of-a-newer-daemon"].into());
        assert!(unknown.to_string().contains("node-hnug"), "{unknown}");
        for kind in ["node-hung", "of-a-newer-daemon"] {
            assert!(unknown.exists.iter().any(|known| known == kind), "{:?}", unknown.exists);
        }
        assert_eq!(format_event(&event), "00:00:00.000 ! node-hung          it hangs");
    }
}
