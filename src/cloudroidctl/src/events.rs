//! `events`: the daemon's journal.

use std::time::Duration;

use api::{Event, Level};

use crate::client::{Client, escaped};
use crate::output::{self, Format};

/// Between two looks for what is new.
const LOOK: Duration = Duration::from_secs(1);
/// Events of one answer, where those that are new are followed.
const AT_ONCE: u32 = 1000;

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
        let events: Vec<Event> = client.get(&self.path(0, self.tail)).await?;
        if !self.follow {
            return match format {
                Format::Json => output::json(&events),
                Format::Table => events.iter().try_for_each(print),
            };
        }
        // What comes without an end is one event a line.
        let print = |event: &Event| match format {
            Format::Json => output::json_line(event),
            Format::Table => print(event),
        };
        let mut last = events.last().map_or(0, |event| event.id);
        events.iter().try_for_each(print)?;
        loop {
            tokio::time::sleep(LOOK).await;
            let events: Vec<Event> = client.get(&self.path(last, AT_ONCE)).await?;
            last = events.last().map_or(last, |event| event.id);
            events.iter().try_for_each(print)?;
        }
    }

    fn path(&self, since: i64, limit: u32) -> String {
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
        format!("/api/v1/events?since={since}&limit={limit}{filter}")
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
        let path = |line: &str| {
            let words = std::iter::once("events").chain(line.split_whitespace());
            let Line { events } = Line::try_parse_from(words).expect("valid");
            events.path(7, events.tail)
        };
        for (line, expected) in [
            ("", "since=7&limit=50"),
            ("-n 3 -f --kind node-hung", "since=7&limit=3&kind=node-hung"),
            (
                "--robot r&d --service s --servant s-1",
                "since=7&limit=50&service=s&servant=s-1&robot=r%26d",
            ),
        ] {
            assert_eq!(path(line), format!("/api/v1/events?{expected}"), "{line}");
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
        assert_eq!(
            in_a_line(&event),
            "00:00:00.000 ! node-hung          it hangs"
        );
    }
}
