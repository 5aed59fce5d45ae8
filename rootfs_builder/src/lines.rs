//! Lines on their way to whoever watches a build. A build may print faster than its watcher reads: then some are left
//! out, and their number is told, instead of keeping them all in memory or holding the build up.

use tokio::sync::mpsc;

/// Lines that may wait.
const AHEAD: usize = 4096;

/// Where lines go in.
pub(crate) struct Lines {
    sender: mpsc::Sender<String>,
    left_out: u64,
}

/// A pair of ends.
pub(crate) fn channel() -> (Lines, mpsc::Receiver<String>) {
    let (sender, receiver) = mpsc::channel(AHEAD);
    let lines = Lines {
        sender,
        left_out: 0,
    };
    (lines, receiver)
}

impl Lines {
    /// Sends a line, if there is room. Never waits.
    pub(crate) fn send(&mut self, line: String) {
        if self.left_out > 0 {
            let told = format!("({} lines are left out here)", self.left_out);
            match self.sender.try_send(told) {
                Ok(()) => self.left_out = 0,
                Err(_) => {
                    self.left_out += 1;
                    return;
                }
            }
        }
        if self.sender.try_send(line).is_err() {
            self.left_out += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slow_watcher_costs_lines_and_is_told_how_many() {
        let (mut lines, mut received) = channel();
        for number in 0..AHEAD + 10 {
            lines.send(number.to_string());
        }
        for number in 0..AHEAD {
            assert_eq!(received.try_recv().expect("kept"), number.to_string());
        }
        assert!(received.try_recv().is_err(), "more was kept than may wait");
        lines.send("after".into());
        assert_eq!(
            received.try_recv().expect("told"),
            "(10 lines are left out here)"
        );
        assert_eq!(received.try_recv().expect("sent"), "after");
    }
}
