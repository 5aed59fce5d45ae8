//! `--wait`: waits until a condition is met.

use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

use crate::client::is_unavailable;
use crate::exit::WaitTimedOut;
use crate::token::lifetime;

/// Interval between two checks of the condition.
const LOOK: Duration = Duration::from_millis(250);

/// Flag to wait, with an optional time limit.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct WaitFlag {
    /// Wait until it is done, at most for TIME, such as --wait=90s (default: no limit). Exit status 8 when the time is
    /// up.
    #[arg(
        long,
        value_name = "TIME",
        num_args = 0..=1,
        require_equals = true,
        value_parser = lifetime
    )]
    wait: Option<Option<Duration>>,
}

impl WaitFlag {
    /// Returns whether the flag is given.
    pub fn is_set(self) -> bool {
        self.wait.is_some()
    }

    /// Calls `look` until it returns a value; once only without the flag. A `look` without a value returns the current
    /// state for the error message. Also waits for a daemon that is unavailable.
    ///
    /// # Errors
    /// Errors of `look`, and [`WaitTimedOut`].
    pub async fn poll_until<T, Look>(self, mut look: impl FnMut() -> Look) -> anyhow::Result<T>
    where
        Look: Future<Output = anyhow::Result<Result<T, String>>>,
    {
        let deadline = self.wait.flatten().map(|time| Instant::now() + time);
        loop {
            let instead = match look().await {
                Ok(Ok(found)) => return Ok(found),
                Ok(Err(instead)) => instead,
                Err(error) if self.is_set() && is_unavailable(&error) => format!("{error:#}"),
                Err(error) => return Err(error),
            };
            if !self.is_set() || deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                let words = format!("timed out: {instead}");
                return Err(WaitTimedOut { words }.into());
            }
            tokio::time::sleep(LOOK).await;
        }
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Debug, Parser)]
    struct Line {
        #[command(flatten)]
        wait: WaitFlag,
        after: Option<String>,
    }

    fn parse(words: &[&str]) -> Result<Line, clap::Error> {
        Line::try_parse_from(std::iter::once(&"verb").chain(words))
    }

    #[test]
    fn a_time_is_written_with_an_equals_sign() {
        for (words, expected) in
            [(&[][..], None), (&["--wait"], Some(None)), (&["--wait=90s"], Some(Some(Duration::from_secs(90))))]
        {
            assert_eq!(parse(words).expect("valid").wait.wait, expected);
        }
        // A following word is another argument, not the time.
        let line = parse(&["--wait", "90s"]).expect("valid");
        assert_eq!(line.after.as_deref(), Some("90s"));
        parse(&["--wait=soon"]).expect_err("no time");
    }

    #[tokio::test]
    async fn it_looks_until_it_finds_and_no_longer_than_the_time() {
        let mut looks = 0;
        let mut third = || {
            looks += 1;
            let found = match looks {
                3 => Ok(looks),
                _ => Err("still at work".to_owned()),
            };
            async move { Ok(found) }
        };
        let forever = parse(&["--wait"]).expect("valid").wait;
        assert_eq!(forever.poll_until(&mut third).await.expect("found"), 3);

        let never = || async { Ok(Err::<(), _>("still at work".to_owned())) };
        let over = WaitFlag { wait: Some(Some(Duration::ZERO)) };
        let late = over.poll_until(never).await.expect_err("time is up");
        assert!(late.is::<WaitTimedOut>());
        assert!(late.to_string().contains("still at work"), "{late}");

        let failing = || async { Err::<Result<(), String>, _>(anyhow::anyhow!("no such service")) };
        let error = forever.poll_until(failing).await.expect_err("it fails");
        assert_eq!(error.to_string(), "no such service");
    }
}
