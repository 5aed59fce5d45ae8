//! `top`: live view of the servants.

use std::cmp::Ordering;
use std::io::{IsTerminal, Write, stdout};

use anyhow::bail;
use api::Size;
use api::explain::Served;
use crossterm::event::{Event, EventStream, KeyCode, KeyModifiers};
use crossterm::{cursor, execute, queue, style, terminal};
use futures_util::StreamExt;

use crate::client::DaemonClient;
use crate::output::{self, OutputFormat, Table, count};
use crate::stream::{LiveState, LiveStream};

/// Show servants and their resource usage, updated live. Keys: q quits; c, m, r and n sort by cores, memory, response
/// time and name.
///
/// Without a terminal (a pipe, a file), prints the current state and exits, as with --once.
#[derive(Debug, clap::Args)]
pub struct TopArgs {
    /// Sort key.
    #[arg(long, value_enum, default_value_t = SortKey::Cores, value_name = "WHAT")]
    sort: SortKey,
    /// Only servants of this service.
    #[arg(long, value_name = "SERVICE")]
    service: Option<String>,
    /// Print the current state and exit.
    #[arg(long)]
    once: bool,
}

/// Sort key of the servants.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum SortKey {
    /// Most cores first.
    Cores,
    /// Most memory first.
    Memory,
    /// Longest response time first.
    Rrt,
    /// Order by service and robot.
    Name,
}

/// Restores the terminal when dropped.
struct ScreenGuard;

impl ScreenGuard {
    fn enter() -> anyhow::Result<ScreenGuard> {
        terminal::enable_raw_mode()?;
        let screen = ScreenGuard;
        execute!(stdout(), terminal::EnterAlternateScreen, cursor::Hide)?;
        Ok(screen)
    }
}

impl Drop for ScreenGuard {
    fn drop(&mut self) {
        // If the terminal fails, the error cannot be shown anywhere else.
        let _ = execute!(stdout(), cursor::Show, terminal::LeaveAlternateScreen);
        let _ = terminal::disable_raw_mode();
    }
}

impl TopArgs {
    /// Opens the stream and prints or draws it.
    pub async fn run(mut self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let mut stream = LiveStream::open(client).await?;
        if !stream.next_change().await? {
            bail!("the daemon sent nothing; it may be shutting down");
        }
        if format == OutputFormat::Json {
            let servants: Vec<&Served> = self.sorted_servants(&stream.live);
            return output::json(&servants);
        }
        if self.once || !stdout().is_terminal() {
            return self.lines(&stream.live).iter().try_for_each(|line| output::line(line));
        }
        let screen = ScreenGuard::enter()?;
        let mut keys = EventStream::new();
        loop {
            self.draw(&stream.live)?;
            tokio::select! {
                changed = stream.next_change() => if !changed? {
                    drop(screen);
                    bail!("the daemon closed the connection; run again: cloudroidctl top");
                },
                key = keys.next() => match key.transpose()? {
                    Some(Event::Key(key)) => {
                        let interrupts = key.modifiers.contains(KeyModifiers::CONTROL);
                        match key.code {
                            KeyCode::Char('c') if interrupts => return Ok(()),
                            KeyCode::Char('q') | KeyCode::Esc => return Ok(()),
                            KeyCode::Char('c') => self.sort = SortKey::Cores,
                            KeyCode::Char('m') => self.sort = SortKey::Memory,
                            KeyCode::Char('r') => self.sort = SortKey::Rrt,
                            KeyCode::Char('n') => self.sort = SortKey::Name,
                            _ => {}
                        }
                    }
                    Some(_) => {}
                    None => return Ok(()),
                },
            }
        }
    }

    fn sorted_servants<'a>(&self, live: &'a LiveState) -> Vec<&'a Served> {
        let all = live.servants.values().map(AsRef::as_ref);
        let is_asked_for = |one: &&Served| {
            let service = self.service.as_ref();
            service.is_none_or(|service| *service == one.servant.service)
        };
        let mut all: Vec<&Served> = all.filter(is_asked_for).collect();
        all.sort_by(|a, b| compare(self.sort, a, b));
        all
    }

    fn lines(&self, live: &LiveState) -> Vec<String> {
        let mut lines: Vec<String> = live.machine.iter().map(|of| machine_line(of)).collect();
        let mut table =
            Table::new(&["SERVICE", "ROBOT", "STATE", "CORES", "THROTTLED", "MEMORY", "RRT", "LIMITS", "AGE"]);
        for served in self.sorted_servants(live) {
            table.row(servant_row(served));
        }
        lines.extend(if table.is_empty() {
            vec!["no servants (instances); one starts when a robot connects to a service".to_owned()]
        } else {
            table.lines()
        });
        lines
    }

    fn draw(&self, live: &LiveState) -> anyhow::Result<()> {
        // A terminal that does not report its size has zero columns or rows.
        let (columns, rows) = match terminal::size()? {
            (0, _) | (_, 0) => (80, 24),
            (columns, rows) => (usize::from(columns), usize::from(rows)),
        };
        let lines = self.lines(live);
        let mut out = stdout().lock();
        queue!(out, terminal::BeginSynchronizedUpdate, cursor::MoveTo(0, 0))?;
        for line in lines.iter().take(rows.saturating_sub(1)) {
            let shown: String = output::sanitize(line).chars().take(columns).collect();
            queue!(out, style::Print(shown), terminal::Clear(terminal::ClearType::UntilNewLine))?;
            queue!(out, style::Print("\r\n"))?;
        }
        queue!(out, terminal::Clear(terminal::ClearType::FromCursorDown))?;
        queue!(out, terminal::EndSynchronizedUpdate)?;
        Ok(out.flush()?)
    }
}

fn compare(by: SortKey, a: &Served, b: &Served) -> Ordering {
    let name = |of: &Served| (of.servant.service.clone(), of.servant.robot.clone());
    let memory = |of: &Served| of.servant.usage.as_ref().map_or(0, |usage| usage.memory);
    let time = |of: &Served| of.servant.response.map_or(0.0, |times| times.p95_ms);
    let first = match by {
        SortKey::Cores => b.cores.total_cmp(&a.cores),
        SortKey::Memory => memory(b).cmp(&memory(a)),
        SortKey::Rrt => time(b).total_cmp(&time(a)),
        SortKey::Name => Ordering::Equal,
    };
    first.then_with(|| name(a).cmp(&name(b)))
}

fn machine_line(of: &api::stream::Machine) -> String {
    let room = &of.status.capacity;
    format!(
        "{}; {:.2} of {} cores used, {:.2} reserved; {} of {} of memory reserved; {} waiting",
        count(of.status.servants, "servant"),
        of.cores,
        of.host_cores,
        room.cpus_reserved,
        Size(room.memory_reserved),
        Size(room.memory),
        room.waiting
    )
}

fn servant_row(of: &Served) -> [String; 9] {
    let servant = &of.servant;
    [
        format!("{}:{}", servant.service, servant.revision),
        servant.robot.clone(),
        servant.phase.to_string(),
        format!("{:.2}", of.cores),
        format!("{:.0} %", of.throttled * 100.0),
        servant.usage.as_ref().map(|usage| Size(usage.memory).to_string()).unwrap_or_default(),
        servant.response.map(|times| format!("{:.1} ms", times.p95_ms)).unwrap_or_default(),
        output::limits(servant.enforced.as_ref().unwrap_or(&servant.limits)),
        output::age(servant.created),
    ]
}
