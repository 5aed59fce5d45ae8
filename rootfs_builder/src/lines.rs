//! Bounded queue of output lines for the watcher of a build. If a build prints faster than its watcher reads, lines are
//! dropped and counted, instead of keeping them all in memory or blocking the build.

use tokio::sync::mpsc;

/// Capacity of the queue in lines.
const AHEAD: usize = 4096;

/// Sending end of the queue.
pub(crate) struct LineSender {
    sender: mpsc::Sender<String>,
    left_out: u64,
}

/// Creates a queue.
pub(crate) fn channel() -> (LineSender, mpsc::Receiver<String>) {
    let (sender, receiver) = mpsc::channel(AHEAD);
    let lines = LineSender { sender, left_out: 0 };
    (lines, receiver)
}

impl LineSender {
    /// Sends a line if there is room. Never blocks.
    pub(crate) fn send(&mut self, line: String) {
        if self.left_out > 0 {
            let told = format!("({} lines omitted)", self.left_out);
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
        assert_eq!(received.try_recv().expect("told"), "(10 lines omitted)");
        assert_eq!(received.try_recv().expect("sent"), "after");
    }
}
