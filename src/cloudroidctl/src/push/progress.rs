//! Progress of a push: bars on a terminal, plain lines otherwise, or the events as JSON lines.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use api::{PushEvent, Size};
use foreign::terminal;
use indicatif::{ProgressBar, ProgressStyle};

use crate::output::{self, OutputFormat};

/// Shortest interval between lines of progress without a terminal.
const PLAIN_INTERVAL: Duration = Duration::from_secs(5);

/// Prints the progress of a push.
pub struct PushProgress {
    format: OutputFormat,
    began: Instant,
    /// Progress bar on a terminal.
    bar: Option<ProgressBar>,
    said: Instant,
}

impl PushProgress {
    /// Creates the progress for the current standard output.
    pub fn new(format: OutputFormat) -> PushProgress {
        let bar = (format == OutputFormat::Table && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new_spinner();
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        PushProgress { format, began: Instant::now(), bar, said: Instant::now() }
    }

    /// Prints an event.
    pub fn show(&mut self, event: &PushEvent) -> anyhow::Result<()> {
        if self.format == OutputFormat::Json {
            return output::json_line(event);
        }
        match event {
            PushEvent::Step { title } => self.step(title),
            PushEvent::Log { line } => self.print(&format!("  | {line}")),
            PushEvent::Progress { unit, done, total } => self.progress(unit, *done, *total),
            PushEvent::Warning { message } => self.print(&format!("warning: {message}")),
            PushEvent::Done { service, layers, took, unchanged } => {
                self.finish();
                for layer in layers {
                    let how = if layer.cached { "unchanged" } else { "new" };
                    output::line(&format!("   layer {:<14} {:>8}  {how}", layer.name, Size(layer.size).to_string()))?;
                }
                let took = *took as f64 / 1000.0;
                if *unchanged {
                    let number = service.summary.revision;
                    return output::line(&format!("== unchanged: revision {number} serves ({took:.1} s)\n"));
                }
                output::line(&format!("== published in {took:.1} s\n"))
            }
            PushEvent::Error { .. } => {
                self.finish();
                Ok(())
            }
        }
    }

    fn step(&mut self, title: &str) -> anyhow::Result<()> {
        self.said = Instant::now();
        let text = format!("== {:>5.1} s  {title}", self.began.elapsed().as_secs_f64());
        self.print(&text)?;
        if let Some(bar) = &self.bar {
            bar.set_style(ProgressStyle::with_template("{spinner} {msg} {elapsed}")?);
            bar.reset_elapsed();
            bar.set_message(terminal::escape(title, false).into_owned());
        }
        Ok(())
    }

    fn progress(&mut self, unit: &str, done: u64, total: Option<u64>) -> anyhow::Result<()> {
        let amount = |number: u64| {
            if unit == "bytes" { Size(number).to_string() } else { number.to_string() }
        };
        let text = match total {
            Some(total) => format!("{} of {} {unit}", amount(done), amount(total)),
            None => format!("{} {unit}", amount(done)),
        };
        match &self.bar {
            Some(bar) => {
                if let Some(total) = total {
                    bar.set_style(ProgressStyle::with_template("{spinner} [{bar:30}] {msg} {elapsed}")?);
                    bar.set_length(total);
                    bar.set_position(done);
                }
                bar.set_message(terminal::escape(&text, false).into_owned());
                Ok(())
            }
            None if self.said.elapsed() >= PLAIN_INTERVAL => {
                self.said = Instant::now();
                output::line(&format!("   {text}"))
            }
            None => Ok(()),
        }
    }

    /// Prints a line above the bar.
    fn print(&self, text: &str) -> anyhow::Result<()> {
        match &self.bar {
            Some(bar) => {
                bar.suspend(|| output::line(text))?;
                Ok(())
            }
            None => output::line(text),
        }
    }

    fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

impl Drop for PushProgress {
    fn drop(&mut self) {
        self.finish();
    }
}
