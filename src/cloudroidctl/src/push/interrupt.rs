//! Ctrl-C during a push that continues on the server: stop it, or leave it?

use std::io::{BufRead, IsTerminal, Write};

/// Answer to the question what becomes of an interrupted push.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InterruptAnswer {
    /// It is cancelled.
    Stop,
    /// It continues without this command.
    Leave,
    /// It continues, and this command follows it.
    Follow,
}

/// Asks at the terminal what becomes of the push. Without a terminal, or at a second Ctrl-C, it is stopped.
pub async fn ask(number: u64) -> InterruptAnswer {
    if !(std::io::stdin().is_terminal() && std::io::stderr().is_terminal()) {
        return InterruptAnswer::Stop;
    }
    let asked = tokio::task::spawn_blocking(move || read_answer(number, std::io::stdin().lock(), std::io::stderr()));
    tokio::select! {
        answer = asked => answer.unwrap_or(InterruptAnswer::Stop),
        _ = tokio::signal::ctrl_c() => InterruptAnswer::Stop,
    }
}

/// Asks until the answer is understood; at the end of the input, the push is stopped.
fn read_answer(number: u64, mut from: impl BufRead, mut to: impl Write) -> InterruptAnswer {
    loop {
        let question = format!("push {number}: [s]top it, [l]eave it running, or [f]ollow it further? ");
        let asked = to.write_all(question.as_bytes()).and_then(|()| to.flush());
        let mut line = String::new();
        let is_over = asked.is_err() || !from.read_line(&mut line).is_ok_and(|bytes| bytes > 0);
        if is_over {
            return InterruptAnswer::Stop;
        }
        match line.trim().to_ascii_lowercase().as_str() {
            "s" | "stop" => return InterruptAnswer::Stop,
            "l" | "leave" => return InterruptAnswer::Leave,
            "f" | "follow" => return InterruptAnswer::Follow,
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_asks_until_it_understands() {
        for (typed, answer, questions) in [
            ("s\n", InterruptAnswer::Stop, 1),
            ("Leave\n", InterruptAnswer::Leave, 1),
            ("\nwhat\nf\n", InterruptAnswer::Follow, 3),
            ("", InterruptAnswer::Stop, 1),
        ] {
            let mut said = Vec::new();
            assert_eq!(read_answer(7, typed.as_bytes(), &mut said), answer, "{typed:?}");
            let said = String::from_utf8(said).expect("text");
            assert_eq!(said.matches("push 7: [s]top it").count(), questions, "{said}");
        }
    }
}
