//! Waiting for programs with a time limit.

use std::fs::File;
use std::io::{Read, Seek};
use std::process::{Child, Command, ExitStatus, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail, ensure};

use crate::interrupt;

/// Polling interval for the end of a program.
const LOOK: Duration = Duration::from_millis(50);

/// Waits until a program has exited.
///
/// # Errors
/// If the program, named `what` in the error, has not exited after `longest`, or if the evaluation is interrupted: it
/// is killed.
pub fn wait_for_exit(child: &mut Child, what: &str, longest: Duration) -> Result<ExitStatus> {
    let begun = Instant::now();
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        let is_late = begun.elapsed() > longest;
        if is_late || interrupt::is_requested() {
            let _ = child.kill();
            let _ = child.wait();
            ensure!(is_late, "the evaluation was asked to end while this was measured");
            bail!("{what} had not ended after {:.0} s and was killed", longest.as_secs_f64());
        }
        std::thread::sleep(LOOK);
    }
}

/// Runs a program to its end and returns its output. The output goes through files, so that background processes of the
/// program are not waited for.
///
/// # Errors
/// If it cannot be started, or has not exited after `longest`: it is killed.
pub fn output(command: &mut Command, longest: Duration) -> Result<Output> {
    let what = command.get_program().to_string_lossy().into_owned();
    let (out, said) = (tempfile::tempfile()?, tempfile::tempfile()?);
    let mut child = command
        .stdin(Stdio::null())
        .stdout(out.try_clone()?)
        .stderr(said.try_clone()?)
        .spawn()
        .with_context(|| what.clone())?;
    let status = wait_for_exit(&mut child, &what, longest)?;
    let read = |mut file: File| -> Result<Vec<u8>> {
        let mut bytes = Vec::new();
        file.rewind()?;
        file.read_to_end(&mut bytes)?;
        Ok(bytes)
    };
    Ok(Output { status, stdout: read(out)?, stderr: read(said)? })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_program_says_is_read() {
        let mut command = Command::new("sh");
        // The background process keeps the output open and is not waited for.
        command.args(["-c", "sleep 5 & echo out; echo said >&2; exit 3"]);
        let begun = Instant::now();
        let output = output(&mut command, Duration::from_secs(60)).expect("it ends");
        assert_eq!((&output.stdout[..], &output.stderr[..]), (&b"out\n"[..], &b"said\n"[..]));
        assert_eq!(output.status.code(), Some(3));
        assert!(begun.elapsed() < Duration::from_secs(4));
    }

    #[test]
    fn a_program_that_takes_too_long_is_killed() {
        let mut child = Command::new("sleep").arg("60").spawn().expect("sleep");
        let error = wait_for_exit(&mut child, "sleep", Duration::ZERO).expect_err("it takes a minute");
        assert!(error.to_string().contains("sleep had not ended"), "{error}");
        let mut child = Command::new("false").spawn().expect("false");
        let status = wait_for_exit(&mut child, "false", Duration::from_secs(60)).expect("it ends");
        assert_eq!(status.code(), Some(1));
    }
}
