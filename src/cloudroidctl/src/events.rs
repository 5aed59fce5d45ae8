//! `events`: the daemon's journal.

use std::collections::BTreeSet;
use std::time::Duration;

use api::{Event, Level};
use futures_util::StreamExt;

use crate::client::{self, Client, escaped};
use crate::output::{self, Format};

/// Between attempts to reach a daemon that is away.
const RETRY: Duration = Duration::from_millis(250);
/// More than a journal holds.
const ALL: u32 = u32::MAX;

/// Print what happened lately: pushes, starts, failures.
#[derive(Debug, clap::Args)]
pub struct Events {
    /// So many of the last events.
    #[arg(short = 'n', long, default_value_t = 50, value_name = "EVENTS")]
    tail: u32,
    /// Go on printing as more happens.
    #[arg(short, long)]
    follow: bool,
    /// Only events of this kind, such as node-hung; docs/operators.md names them.
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

impl Events {
    /// Asks and prints.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        if self.follow {
            return self.follow(client, format).await;
        }
        let path = format!("/api/v1/events?{}", self.query(0, self.tail));
        let events: Vec<Event> = client.get(&path).await?;
        if let (true, Some(kind)) = (events.is_empty(), &self.kind) {
            let all: Vec<Event> = client
                .get(&format!("/api/v1/events?since=0&limit={ALL}"))
                .await?;
            output::complain(&nothing_of(kind, &all));
        }
        match format {
            Format::Json => output::json(&events),
            Format::Table => events.iter().try_for_each(print),
        }
    }

    /// Prints what comes until it is ended. A daemon that is started again tells what happened meanwhile, and nothing twice.
    async fn follow(&self, client: &Client, format: Format) -> anyhow::Result<()> {
        // What comes without an end is one event a line.
        let print = |event: &Event| match format {
            Format::Json => output::json_line(event),
            Format::Table => print(event),
        };
        let (mut begun, mut last) = (false, None);
        loop {
            let query = match last {
                None => self.query(0, self.tail),
                Some(last) => self.query(last, ALL),
            };
            let path = format!("/api/v1/events/follow?{query}");
            let mut events = match client.lines::<Event>(&path).await {
                Ok(events) => events,
                // It was there a moment ago.
                Err(error) if begun && client::is_away(&error) => {
                    self.come_back(client).await?;
                    continue;
                }
                Err(error) => return Err(error),
            };
            begun = true;
            while let Some(event) = events.next().await {
                let event = match event {
                    Ok(event) => event,
                    Err(error) if client::is_away(&error) => break,
                    Err(error) => return Err(error),
                };
                last = Some(last.unwrap_or(0).max(event.id));
                print(&event)?;
            }
            self.come_back(client).await?;
        }
    }

    /// Waits for a daemon that is away.
    async fn come_back(&self, client: &Client) -> anyhow::Result<()> {
        let mut told = false;
        loop {
            match client.get::<api::Clock>("/api/v1/clock").await {
                Ok(_) => return Ok(()),
                Err(error) if client::is_away(&error) => {
                    if !std::mem::replace(&mut told, true) {
                        output::complain(&format!("{error:#}; waiting for it"));
                    }
                    tokio::time::sleep(RETRY).await;
                }
                Err(error) => return Err(error),
            }
        }
    }

    fn query(&self, since: i64, limit: u32) -> String {
        let filter = [
            ("kind", &self.kind),
            ("service", &self.service),
            ("servant", &self.servant),
            ("robot", &self.robot),
        ];
        let filter = filter.into_iter();
        let filter: String = filter
            .filter_map(|(key, value)| Some(format!("&{key}={}", escaped(value.as_ref()?))))
            .collect();
        format!("since={since}&limit={limit}{filter}")
    }
}

fn print(event: &Event) -> anyhow::Result<()> {
    output::line(&in_a_line(event))
}

fn in_a_line(event: &Event) -> String {
    let mark = match event.level {
        Level::Info => ' ',
        Level::Warning => '!',
        Level::Error => 'X',
    };
    let (time, kind) = (output::clock(event.time), &event.kind);
    format!("{time} {mark} {kind:<18} {}", event.message)
}

/// Words about a kind of which nothing is told; it may be misspelt.
fn nothing_of(kind: &str, all: &[Event]) -> String {
    let kinds: BTreeSet<&str> = all.iter().map(|event| event.kind.as_str()).collect();
    match kinds.contains(kind) {
        true => format!("no event of kind {kind} is told of that"),
        false => format!(
            "no event of kind {kind} is in the journal; there are: {}; docs/operators.md names all",
            kinds.into_iter().collect::<Vec<_>>().join(", ")
        ),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        events: Events,
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
            (
                "--robot r&d --service s --servant s-1",
                "since=7&limit=50&service=s&servant=s-1&robot=r%26d",
            ),
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
        let unknown = nothing_of("node-hnug", std::slice::from_ref(&event));
        assert!(unknown.contains("there are: node-hung;"), "{unknown}");
        let known = nothing_of("node-hung", std::slice::from_ref(&event));
        assert!(!known.contains("there are"), "{known}");
        assert_eq!(
            in_a_line(&event),
            "00:00:00.000 ! node-hung          it hangs"
        );
    }
}
