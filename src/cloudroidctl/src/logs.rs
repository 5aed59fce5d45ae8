//! `logs`: the output of nodes.

use std::collections::BTreeSet;

use anyhow::bail;
use api::{Clock, KeptLog, LogLevel, LogLine, Problem, Servant};
use futures_util::stream::{BoxStream, select_all};
use futures_util::{StreamExt, TryStreamExt};
use hyper::Method;

use crate::client::{self, DaemonClient, empty_body, percent_encode};
use crate::colour::{self, Colour};
use crate::moment::{Moment, format_date};
use crate::output::{self, OutputFormat};

/// Print the output of the nodes of a servant, or of all servants of a robot.
///
/// The log of a servant that has ended is kept for a while: by default 14 days, up to 512 MB for all.
#[derive(Debug, clap::Args)]
pub struct LogsArgs {
    /// Id of a servant, running or ended; name of a service that has one servant; or name of a robot.
    #[arg(value_name = "NAME")]
    name: String,
    /// Keep printing new lines.
    #[arg(short, long)]
    follow: bool,
    /// Print the log of the last servant that has ended: of the service, of the robot (one for each service), or before
    /// this servant for its robot.
    #[arg(long, conflicts_with = "follow")]
    previous: bool,
    /// Number of recent lines of each servant (default: 10000).
    #[arg(short = 'n', long, value_name = "LINES")]
    tail: Option<usize>,
    /// Print only lines since TIME: how long ago, such as 10m, or a time in UTC, such as 2026-11-30T07:00:00Z.
    #[arg(long, value_name = "TIME", value_parser = Moment::parse)]
    since: Option<Moment>,
    /// Print date and time (UTC) of each line, instead of the time of day.
    #[arg(short, long)]
    timestamps: bool,
}

/// A line of a servant.
type ServantLine = (String, LogLine);

impl LogsArgs {
    /// Sends the requests and prints the lines.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let running: Vec<Servant> = client.get("/api/v1/servants").await?;
        let kept: Vec<KeptLog> = client.get("/api/v1/logs").await?;
        let ids = if self.previous {
            find_previous(&self.name, &running, &kept)?
        } else {
            find_current(&self.name, &running, &kept)?
        };
        if format == OutputFormat::Table {
            for ended in kept.iter().filter(|ended| ids.contains(&ended.servant)) {
                output::eprint_line(&describe_end(ended));
            }
        }
        let query = self.query(client).await?;
        let mut logs = Vec::new();
        for id in &ids {
            match open_log(client, id, &query).await {
                Ok(log) => logs.push(log),
                // A robot's reservation at a shared service has no log.
                Err(error) if ids.len() > 1 && is_without_log(&error) => output::eprint_line(&format!("{error:#}")),
                Err(error) => return Err(error),
            }
        }
        let painted = colour::has_colours(&std::io::stdout());
        let print = |(id, entry): &ServantLine| match format {
            OutputFormat::Json => output::json_line(entry),
            OutputFormat::Table => {
                let servant = if ids.len() > 1 { format!("{id} ") } else { String::new() };
                let time = if self.timestamps { format_date(entry.time) } else { output::clock(entry.time) };
                output::line(&format!("{time} {servant}{} | {}", entry.node, paint(entry, painted)))
            }
        };
        let mut lines = select_all(logs);
        if self.follow || ids.len() == 1 {
            while let Some(line) = lines.next().await {
                print(&line?)?;
            }
            return Ok(());
        }
        let mut lines: Vec<ServantLine> = lines.try_collect().await?;
        // Stable: lines of one servant keep their order.
        lines.sort_by_key(|(_, entry)| entry.time);
        lines.iter().try_for_each(print)
    }

    /// Returns the query of each log. Times that have passed are counted by the daemon's clock, like those of lines.
    async fn query(&self, client: &DaemonClient) -> anyhow::Result<String> {
        let mut query = format!("follow={}", self.follow);
        if let Some(tail) = self.tail {
            query += &format!("&tail={tail}");
        }
        let since = match self.since {
            None => return Ok(query),
            Some(Moment::At(at)) => at,
            Some(Moment::Ago(time)) => {
                let clock: Clock = client.get("/api/v1/clock").await?;
                (clock.now as u64).saturating_sub(u64::try_from(time.as_millis()).unwrap_or(u64::MAX))
            }
        };
        Ok(format!("{query}&since={since}"))
    }
}

/// Requests the log of a servant; returns its lines with the id.
async fn open_log(
    client: &DaemonClient,
    id: &str,
    query: &str,
) -> anyhow::Result<BoxStream<'static, anyhow::Result<ServantLine>>> {
    let path = format!("/api/v1/servants/{}/logs?{query}", percent_encode(id));
    let lines = client::json_lines::<LogLine>(client.send(Method::GET, &path, empty_body()).await?);
    let id = id.to_owned();
    Ok(lines.map_ok(move |line| (id.clone(), line)).boxed())
}

/// Returns whether the servant exists but has no container, and so no log.
fn is_without_log(error: &anyhow::Error) -> bool {
    error.downcast_ref::<Problem>().is_some_and(|problem| problem.status == 409)
}

/// Finds the servants with this id, of the service with this name, or of the robot with this name.
fn find_current(name: &str, running: &[Servant], kept: &[KeptLog]) -> anyhow::Result<Vec<String>> {
    let is_id = running.iter().any(|one| one.id == name) || kept.iter().any(|one| one.servant == name);
    if is_id {
        return Ok(vec![name.to_owned()]);
    }
    let ids = |of: fn(&Servant) -> &str| -> Vec<String> {
        running.iter().filter(|one| of(one) == name).map(|one| one.id.clone()).collect()
    };
    let of_service = ids(|one| one.service.as_str());
    if of_service.len() > 1 {
        bail!("{name} has {} servants; name one: {}", of_service.len(), of_service.join(", "));
    }
    let found = if of_service.is_empty() { ids(|one| one.robot.as_str()) } else { of_service };
    if !found.is_empty() {
        return Ok(found);
    }
    match kept.iter().find(|one| one.service == name || one.robot == name) {
        Some(last) => bail!("{name} has no servant now; {}: cloudroidctl logs --previous {name}", describe_end(last)),
        // The daemon's error lists the existing servants.
        None => Ok(vec![name.to_owned()]),
    }
}

/// Finds the last servants that have ended. `kept` has the newest first.
fn find_previous(name: &str, running: &[Servant], kept: &[KeptLog]) -> anyhow::Result<Vec<String>> {
    let successor = running.iter().find(|one| one.id == name);
    let is_before = |one: &KeptLog| {
        one.servant == name || successor.is_some_and(|next| (&one.service, &one.robot) == (&next.service, &next.robot))
    };
    let last = kept.iter().find(|one| is_before(one)).or_else(|| kept.iter().find(|one| one.service == name));
    if let Some(last) = last {
        return Ok(vec![last.servant.clone()]);
    }
    let mut services = BTreeSet::new();
    let of_robot = kept.iter().filter(|one| one.robot == name && services.insert(&one.service));
    let found: Vec<String> = of_robot.map(|one| one.servant.clone()).collect();
    if found.is_empty() {
        bail!(
            "no log of an ended servant of {name} is kept: none has ended, or its log was removed to make room or for \
             its age (docs/operators.md, [logs])"
        );
    }
    Ok(found)
}

/// Describes the end of a servant in one line.
fn describe_end(ended: &KeptLog) -> String {
    let KeptLog { servant, service, robot, reason, .. } = ended;
    let how = if ended.failed { "failed" } else { "ended" };
    format!("servant {servant} of {service} for {robot} {how} {} ago: {reason}", output::age(ended.ended))
}

/// Returns the text of a line in the colour of its level, unless it has colours of its own.
fn paint(entry: &LogLine, painted: bool) -> String {
    let colour = match entry.level {
        Some(LogLevel::Debug) => Colour::Dim,
        Some(LogLevel::Warn) => Colour::Yellow,
        Some(LogLevel::Error | LogLevel::Fatal) => Colour::Red,
        Some(LogLevel::Info) | None => return entry.line.clone(),
    };
    if !painted || entry.line.contains('\x1b') {
        return entry.line.clone();
    }
    colour::paint(&entry.line, colour)
}

#[cfg(test)]
mod tests {
    use api::{Size, Stream};
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        logs: LogsArgs,
    }

    fn running(id: &str, service: &str, robot: &str) -> Servant {
        let (id, service, robot) = (id.to_owned(), service.to_owned(), robot.to_owned());
        serde_json::from_value(serde_json::json!({
            "id": id, "service": service, "robot": robot, "revision": 1, "phase": "ready", "created": 1,
            "connections": 0, "limits": {}, "cgroup_version": 2, "pids": [], "dropped": 0,
        }))
        .expect("a servant")
    }

    fn new_kept_log(servant: &str, service: &str, robot: &str) -> KeptLog {
        KeptLog {
            servant: servant.into(),
            service: service.into(),
            revision: 1,
            robot: robot.into(),
            created: 1,
            ended: 2,
            failed: true,
            reason: "exited with status 3".into(),
            bytes: Size(1),
        }
    }

    #[test]
    fn a_name_is_a_servants_a_services_or_a_robots() {
        let now = [running("map-2", "map", "rover"), running("see-2", "see", "rover"), running("see-3", "see", "crab")];
        let then = [new_kept_log("map-1", "map", "rover"), new_kept_log("old-1", "old", "ship")];
        let current = |name: &str| find_current(name, &now, &then).map_err(|error| error.to_string());
        let ids = |ids: &[&str]| Ok(ids.iter().map(|id| (*id).to_owned()).collect::<Vec<_>>());
        assert_eq!(current("see-3"), ids(&["see-3"]));
        assert_eq!(current("map-1"), ids(&["map-1"]), "it has ended");
        assert_eq!(current("map"), ids(&["map-2"]));
        assert_eq!(current("rover"), ids(&["map-2", "see-2"]));
        assert_eq!(current("see"), Err("see has 2 servants; name one: see-2, see-3".to_owned()));
        let refused = current("old").expect_err("it has ended");
        assert!(refused.contains("exited with status 3: cloudroidctl logs --previous old"), "{refused}");
        assert_eq!(current("nobody"), ids(&["nobody"]), "the daemon says that there is none");
    }

    #[test]
    fn the_previous_one_is_the_last_that_ended() {
        let now = [running("map-3", "map", "rover")];
        let then = [
            new_kept_log("map-2", "map", "crab"),
            new_kept_log("see-2", "see", "rover"),
            new_kept_log("map-1", "map", "rover"),
            new_kept_log("see-1", "see", "rover"),
        ];
        let previous = |name: &str| find_previous(name, &now, &then).expect(name);
        assert_eq!(previous("map"), ["map-2"]);
        assert_eq!(previous("map-3"), ["map-1"], "of the same robot");
        assert_eq!(previous("see-1"), ["see-1"], "this one");
        assert_eq!(previous("rover"), ["see-2", "map-1"], "of each service");
        let refused = find_previous("nobody", &now, &then).expect_err("none").to_string();
        assert!(refused.contains("[logs]"), "{refused}");
    }

    #[test]
    fn lines_have_the_colour_of_their_level_and_not_of_their_stream() {
        let entry = |level, line: &str| LogLine {
            time: 0,
            node: "/n".into(),
            stream: Stream::Stderr,
            level,
            line: line.to_owned(),
        };
        let shown = |level, line: &str| paint(&entry(level, line), true);
        assert_eq!(shown(Some(LogLevel::Info), "[INFO] a"), "[INFO] a");
        assert_eq!(shown(Some(LogLevel::Warn), "[WARN] a"), "\x1b[33m[WARN] a\x1b[0m");
        assert_eq!(shown(Some(LogLevel::Error), "\x1b[35m[ERROR] a"), "\x1b[35m[ERROR] a", "it has one");
        assert_eq!(shown(None, "Traceback"), "Traceback");
        assert_eq!(paint(&entry(Some(LogLevel::Error), "[ERROR] a"), false), "[ERROR] a");
    }

    #[test]
    fn nothing_ended_is_followed() {
        let parse = |line: &str| Line::try_parse_from(["logs"].into_iter().chain(line.split(' ')));
        let Line { logs } = parse("rover -f -n 5 -t --since 10m").expect("valid");
        assert!(logs.follow && logs.timestamps && logs.tail == Some(5) && logs.since.is_some());
        parse("rover --previous -f").expect_err("it has ended");
    }
}
