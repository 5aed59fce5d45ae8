//! `top`: who uses the machine now.

use std::cmp::Ordering;
use std::io::{IsTerminal, Write, stdout};

use anyhow::bail;
use api::Size;
use api::explain::Served;
use crossterm::event::{Event, EventStream, KeyCode, KeyModifiers};
use crossterm::{cursor, execute, queue, style, terminal};
use futures_util::StreamExt;

use crate::client::Client;
use crate::output::{self, Format, Table};
use crate::stream::{Live, Stream};

/// Show servants and what they use, as it changes: q ends it, c, m, r and n sort by cores, memory, response time and name.
///
/// Where nobody looks (a pipe, a file) it prints what is so now and ends, as with --once.
#[derive(Debug, clap::Args)]
pub struct Top {
    /// By what to sort.
    #[arg(long, value_enum, default_value_t = By::Cores, value_name = "WHAT")]
    sort: By,
    /// Only servants of this service.
    #[arg(long, value_name = "SERVICE")]
    service: Option<String>,
    /// Print once, and end.
    #[arg(long)]
    once: bool,
}

/// By what servants are sorted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum By {
    /// Most cores first.
    Cores,
    /// Most memory first.
    Memory,
    /// Longest response time first.
    Rrt,
    /// By service and robot.
    Name,
}

/// The terminal as it was, whatever ends this.
struct Screen;

impl Screen {
    fn take() -> anyhow::Result<Screen> {
        terminal::enable_raw_mode()?;
        let screen = Screen;
        execute!(stdout(), terminal::EnterAlternateScreen, cursor::Hide)?;
        Ok(screen)
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        // There is nobody left to tell.
        let _ = execute!(stdout(), cursor::Show, terminal::LeaveAlternateScreen);
        let _ = terminal::disable_raw_mode();
    }
}

impl Top {
    /// Asks and shows.
    pub async fn run(mut self, client: &Client, format: Format) -> anyhow::Result<()> {
        let mut stream = Stream::begin(client).await?;
        if !stream.changed().await? {
            bail!("the daemon told nothing; it may be ending");
        }
        if format == Format::Json {
            let servants: Vec<&Served> = self.sorted(&stream.live);
            return output::json(&servants);
        }
        if self.once || !stdout().is_terminal() {
            return self
                .lines(&stream.live)
                .iter()
                .try_for_each(|line| output::line(line));
        }
        let screen = Screen::take()?;
        let mut keys = EventStream::new();
        loop {
            self.draw(&stream.live)?;
            tokio::select! {
                changed = stream.changed() => if !changed? {
                    drop(screen);
                    bail!("the daemon has ended the connection; look again with: cloudroidctl top");
                },
                key = keys.next() => match key.transpose()? {
                    Some(Event::Key(key)) => {
                        let interrupts = key.modifiers.contains(KeyModifiers::CONTROL);
                        match key.code {
                            KeyCode::Char('c') if interrupts => return Ok(()),
                            KeyCode::Char('q') | KeyCode::Esc => return Ok(()),
                            KeyCode::Char('c') => self.sort = By::Cores,
                            KeyCode::Char('m') => self.sort = By::Memory,
                            KeyCode::Char('r') => self.sort = By::Rrt,
                            KeyCode::Char('n') => self.sort = By::Name,
                            _ => {}
                        }
                    }
                    Some(_) => {}
                    None => return Ok(()),
                },
            }
        }
    }

    fn sorted<'a>(&self, live: &'a Live) -> Vec<&'a Served> {
        let all = live.servants.values().map(AsRef::as_ref);
        let is_asked_for = |one: &&Served| {
            let service = self.service.as_ref();
            service.is_none_or(|service| *service == one.servant.service)
        };
        let mut all: Vec<&Served> = all.filter(is_asked_for).collect();
        all.sort_by(|a, b| order(self.sort, a, b));
        all
    }

    fn lines(&self, live: &Live) -> Vec<String> {
        let mut lines: Vec<String> = live.machine.iter().map(|of| machine(of)).collect();
        let mut table = Table::new(&[
            "SERVICE",
            "ROBOT",
            "STATE",
            "CORES",
            "THROTTLED",
            "MEMORY",
            "RRT",
            "LIMITS",
            "AGE",
        ]);
        for served in self.sorted(live) {
            table.row(row(served));
        }
        lines.extend(match table.is_empty() {
            true => vec!["no servants; one starts when a robot connects to a service".to_owned()],
            false => table.lines(),
        });
        lines
    }

    fn draw(&self, live: &Live) -> anyhow::Result<()> {
        // A terminal that does not say how large it is has zero of both.
        let (columns, rows) = match terminal::size()? {
            (0, _) | (_, 0) => (80, 24),
            (columns, rows) => (usize::from(columns), usize::from(rows)),
        };
        let lines = self.lines(live);
        let mut out = stdout().lock();
        queue!(out, terminal::BeginSynchronizedUpdate, cursor::MoveTo(0, 0))?;
        for line in lines.iter().take(rows.saturating_sub(1)) {
            let shown: String = output::shown(line).chars().take(columns).collect();
            queue!(
                out,
                style::Print(shown),
                terminal::Clear(terminal::ClearType::UntilNewLine)
            )?;
            queue!(out, style::Print("\r\n"))?;
        }
        queue!(out, terminal::Clear(terminal::ClearType::FromCursorDown))?;
        queue!(out, terminal::EndSynchronizedUpdate)?;
        Ok(out.flush()?)
    }
}

fn order(by: By, a: &Served, b: &Served) -> Ordering {
    let name = |of: &Served| (of.servant.service.clone(), of.servant.robot.clone());
    let memory = |of: &Served| of.servant.usage.as_ref().map_or(0, |usage| usage.memory);
    let time = |of: &Served| of.servant.response.map_or(0.0, |times| times.p95_ms);
    let first = match by {
        By::Cores => b.cores.total_cmp(&a.cores),
        By::Memory => memory(b).cmp(&memory(a)),
        By::Rrt => time(b).total_cmp(&time(a)),
        By::Name => Ordering::Equal,
    };
    first.then_with(|| name(a).cmp(&name(b)))
}

fn machine(of: &api::stream::Machine) -> String {
    let room = &of.status.capacity;
    format!(
        "{} servants; {:.2} of {} cores used, {:.2} promised; {} of {} of memory promised; {} waiting",
        of.status.servants,
        of.cores,
        of.host_cores,
        room.cpus_reserved,
        Size(room.memory_reserved),
        Size(room.memory),
        room.waiting
    )
}

fn row(of: &Served) -> [String; 9] {
    let servant = &of.servant;
    [
        format!("{}:{}", servant.service, servant.revision),
        servant.robot.clone(),
        servant.phase.to_string(),
        format!("{:.2}", of.cores),
        format!("{:.0} %", of.throttled * 100.0),
        servant
            .usage
            .as_ref()
            .map(|usage| Size(usage.memory).to_string())
            .unwrap_or_default(),
        servant
            .response
            .map(|times| format!("{:.1} ms", times.p95_ms))
            .unwrap_or_default(),
        output::limits(servant.enforced.as_ref().unwrap_or(&servant.limits)),
        output::age(servant.created),
    ]
}
