//! Progress of a push: bars on a terminal, plain lines otherwise, or the events as JSON lines.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use api::push::Layer;
use api::{PushEvent, Size, count};
use foreign::terminal;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::output::{self, OutputFormat};

/// Interval of [`PushProgress::tick`], and the shortest one between lines of progress without a terminal.
pub const TICK: Duration = Duration::from_secs(2);
/// Longest silence without a terminal while nothing is counted. It begins with [`TICK`] and doubles.
const LONGEST_SILENCE: Duration = Duration::from_secs(16);

/// Prints the progress of a push.
pub struct PushProgress {
    format: OutputFormat,
    began: Instant,
    /// Progress bar on a terminal.
    bar: Option<ProgressBar>,
    said: Instant,
    /// Title of the current step, and when it began.
    step: (String, Instant),
    /// Time after the last line at which the next tick prints one.
    silence: Duration,
}

/// Hides the bar while somebody is asked something.
#[derive(Debug, Clone)]
pub struct BarPause(Option<ProgressBar>);

impl BarPause {
    /// Hides the bar; what is printed then begins on a line of its own.
    pub fn begin(&self) {
        if let Some(bar) = &self.0 {
            bar.set_draw_target(ProgressDrawTarget::hidden());
            output::eprint_line("");
        }
    }

    /// Shows the bar again.
    pub fn end(&self) {
        if let Some(bar) = &self.0 {
            bar.set_draw_target(ProgressDrawTarget::stderr());
        }
    }
}

impl PushProgress {
    /// Creates the progress for the current standard output.
    pub fn new(format: OutputFormat) -> PushProgress {
        let bar = (format == OutputFormat::Table && std::io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new_spinner();
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        let now = Instant::now();
        PushProgress { format, began: now, bar, said: now, step: (String::new(), now), silence: TICK }
    }

    /// Returns what hides the bar for a while.
    pub fn pauses(&self) -> BarPause {
        BarPause(self.bar.clone())
    }

    /// Prints the number of a push that is left to itself.
    pub fn show_number(&self, number: u64) -> anyhow::Result<()> {
        self.finish();
        match self.format {
            OutputFormat::Json => output::json_line(&PushEvent::Accepted { number }),
            OutputFormat::Table => output::line(&number.to_string()),
        }
    }

    /// Prints how long the current step has taken, if nothing else was printed for a while; a terminal shows it anyway.
    pub fn tick(&mut self) -> anyhow::Result<()> {
        let is_shown = self.bar.is_some() || self.format == OutputFormat::Json || self.step.0.is_empty();
        if is_shown || self.said.elapsed() < self.silence {
            return Ok(());
        }
        self.said = Instant::now();
        self.silence = LONGEST_SILENCE.min(self.silence * 2);
        output::line(&format!("   {} s: {}", self.step.1.elapsed().as_secs(), self.step.0))
    }

    /// Prints an event.
    pub fn show(&mut self, event: &PushEvent) -> anyhow::Result<()> {
        if self.format == OutputFormat::Json {
            return output::json_line(event);
        }
        match event {
            PushEvent::Accepted { .. } => Ok(()),
            PushEvent::Step { title, last_took } => self.step(title, *last_took),
            PushEvent::Log { line } => self.print(&format!("  | {line}")),
            PushEvent::Progress { unit, done, total } => self.progress(unit, *done, *total),
            PushEvent::Warning { message } => self.print(&format!("warning: {message}")),
            PushEvent::Underlay { underlay, layers, took, unchanged } => {
                self.finish();
                show_layers(layers)?;
                let state = if *unchanged { "unchanged" } else { "published" };
                let (name, revision) = (&underlay.name, underlay.revision);
                let packages = count(underlay.packages.len(), "package");
                output::line(&format!(
                    "== underlay {name} {state} in {:.1} s: revision {revision}, {packages}; push others with --on \
                    {name}",
                    *took as f64 / 1000.0
                ))
            }
            PushEvent::Done { service, layers, took, unchanged } => {
                self.finish();
                show_layers(layers)?;
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

    fn step(&mut self, title: &str, last_took: Option<u64>) -> anyhow::Result<()> {
        self.step = (title.to_owned(), Instant::now());
        self.silence = TICK;
        let last = last_took.map(format_last).unwrap_or_default();
        let text = format!("== {:>5.1} s  {title}{last}", self.began.elapsed().as_secs_f64());
        self.print(&text)?;
        if let Some(bar) = &self.bar {
            bar.set_style(ProgressStyle::with_template("{spinner} {msg} {elapsed}")?);
            bar.reset_elapsed();
            bar.set_message(terminal::escape(title, false).into_owned());
        }
        Ok(())
    }

    fn progress(&mut self, unit: &str, done: u64, total: Option<u64>) -> anyhow::Result<()> {
        let text = format_count(unit, done, total);
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
            None if self.said.elapsed() >= TICK => {
                self.said = Instant::now();
                self.silence = TICK;
                output::line(&format!("   {text}"))
            }
            None => Ok(()),
        }
    }

    /// Prints a line above the bar.
    fn print(&mut self, text: &str) -> anyhow::Result<()> {
        self.said = Instant::now();
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

/// Describes how many units of a step are done.
pub fn format_count(unit: &str, done: u64, total: Option<u64>) -> String {
    let is_size = unit == "bytes";
    let amount = |number: u64| if is_size { Size(number).to_string() } else { number.to_string() };
    let unit = if is_size { String::new() } else { format!(" {unit}") };
    match total {
        Some(total) => format!("{} of {}{unit}", amount(done), amount(total)),
        None => format!("{}{unit}", amount(done)),
    }
}

/// Returns a remark on how long a step took last, in milliseconds; empty if that is not worth a remark.
pub fn format_last(took: u64) -> String {
    match took {
        0..1000 => String::new(),
        took => format!(" (last time {} s)", took / 1000),
    }
}

impl Drop for PushProgress {
    fn drop(&mut self) {
        self.finish();
    }
}

/// Prints the layers of an image.
fn show_layers(layers: &[Layer]) -> anyhow::Result<()> {
    for layer in layers {
        let how = if layer.cached { "unchanged" } else { "new" };
        output::line(&format!("   layer {:<14} {:>8}  {how}", layer.name, Size(layer.size).to_string()))?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_need_no_unit() {
        assert_eq!(format_count("packages", 3, Some(9)), "3 of 9 packages");
        assert_eq!(format_count("bytes", 1 << 20, Some(3 << 20)), format!("{} of {}", Size(1 << 20), Size(3 << 20)));
        assert_eq!(format_count("bytes", 1 << 20, None), Size(1 << 20).to_string());
    }

    #[test]
    fn only_what_took_a_while_is_remarked() {
        assert_eq!(format_last(999), "");
        assert_eq!(format_last(102_400), " (last time 102 s)");
    }

    #[test]
    fn silence_is_told_less_and_less_often() {
        let mut progress = PushProgress::new(OutputFormat::Table);
        // Not on a terminal.
        progress.bar = None;
        progress.step("compiling", None).expect("printed");
        let mut told = Vec::new();
        for _ in 0..5 {
            told.push(progress.silence.as_secs());
            progress.said -= progress.silence;
            progress.tick().expect("printed");
        }
        assert_eq!(told, [2, 4, 8, 16, 16]);
        progress.step("packing", None).expect("printed");
        assert_eq!(progress.silence, TICK, "the next step begins anew");
    }
}
