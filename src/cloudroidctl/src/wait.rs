//! `--wait`: until what was asked for has come about.

use std::future::Future;
use std::time::Duration;

use tokio::time::Instant;

use crate::client::is_away;
use crate::exit::TimeUp;
use crate::token::lifetime;

/// Between two looks.
const LOOK: Duration = Duration::from_millis(250);

/// Whether, and how long.
#[derive(Debug, Clone, Copy, Default, clap::Args)]
pub struct WaitFlag {
    /// Wait until it has come about, for TIME at most, such as --wait=90s; without a time for as long as it takes. Exit status 8 when
    /// the time is up.
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
    /// Whether somebody waits.
    pub fn is_set(self) -> bool {
        self.wait.is_some()
    }

    /// Looks again and again until a look finds it; once where nobody waits. A look that finds something else says what. A daemon
    /// that is away is waited for, too.
    ///
    /// # Errors
    /// What a look fails with, and [`TimeUp`].
    pub async fn until<T, Look>(self, mut look: impl FnMut() -> Look) -> anyhow::Result<T>
    where
        Look: Future<Output = anyhow::Result<Result<T, String>>>,
    {
        let deadline = self.wait.flatten().map(|time| Instant::now() + time);
        loop {
            let instead = match look().await {
                Ok(Ok(found)) => return Ok(found),
                Ok(Err(instead)) => instead,
                Err(error) if self.is_set() && is_away(&error) => format!("{error:#}"),
                Err(error) => return Err(error),
            };
            if !self.is_set() || deadline.is_some_and(|deadline| Instant::now() >= deadline) {
                let words = format!("it has not come about: {instead}");
                return Err(TimeUp { words }.into());
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
        for (words, expected) in [
            (&[][..], None),
            (&["--wait"], Some(None)),
            (&["--wait=90s"], Some(Some(Duration::from_secs(90)))),
        ] {
            assert_eq!(parse(words).expect("valid").wait.wait, expected);
        }
        // What follows is another argument, not its time.
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
        assert_eq!(forever.until(&mut third).await.expect("found"), 3);

        let never = || async { Ok(Err::<(), _>("still at work".to_owned())) };
        let over = WaitFlag {
            wait: Some(Some(Duration::ZERO)),
        };
        let late = over.until(never).await.expect_err("time is up");
        assert!(late.is::<TimeUp>());
        assert!(late.to_string().contains("still at work"), "{late}");

        let failing = || async { Err::<Result<(), String>, _>(anyhow::anyhow!("no such service")) };
        let error = forever.until(failing).await.expect_err("it fails");
        assert_eq!(error.to_string(), "no such service");
    }
}
