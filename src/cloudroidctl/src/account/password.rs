//! Reads a password from a terminal without echo, or from standard input.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};

use anyhow::{Context, bail};
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};

/// Limit of the input in bytes: longer than any password that the daemon accepts, with the end of its line.
const LONGEST: u64 = 4096;

fn first_line(from: impl Read) -> io::Result<String> {
    let mut line = String::new();
    BufReader::new(from.take(LONGEST)).read_line(&mut line)?;
    let line = line.strip_suffix('\n').unwrap_or(&line);
    Ok(line.strip_suffix('\r').unwrap_or(line).to_owned())
}

/// Turns the echo of a terminal off, and on again when dropped.
struct EchoGuard<'a> {
    terminal: &'a File,
    before: Termios,
}

impl<'a> EchoGuard<'a> {
    fn new(terminal: &'a File) -> anyhow::Result<EchoGuard<'a>> {
        let before = tcgetattr(terminal)?;
        let mut silent = before.clone();
        silent.local_flags.remove(LocalFlags::ECHO);
        silent.local_flags.insert(LocalFlags::ECHONL);
        tcsetattr(terminal, SetArg::TCSAFLUSH, &silent)?;
        Ok(EchoGuard { terminal, before })
    }
}

impl Drop for EchoGuard<'_> {
    fn drop(&mut self) {
        let _ = tcsetattr(self.terminal, SetArg::TCSAFLUSH, &self.before);
    }
}

/// Reads a new password: prompts twice at the terminal, or reads the first line of standard input.
pub fn read_password(stdin: bool) -> anyhow::Result<String> {
    if stdin {
        let password = first_line(io::stdin()).context("cannot read standard input")?;
        if password.is_empty() {
            bail!("the first line of standard input is empty; it must be the password");
        }
        return Ok(password);
    }
    let [password, again] = ask(["Password: ", "Repeat the password: "])?;
    if password != again {
        bail!("the passwords differ; nothing was changed");
    }
    Ok(password)
}

/// Reads a password that exists: prompts at the terminal, or reads the first line of standard input.
pub fn read_existing_password(stdin: bool, prompt: &str) -> anyhow::Result<String> {
    if stdin {
        return read_password(true);
    }
    let [password] = ask([prompt])?;
    Ok(password)
}

/// Asks at the terminal, without echo.
fn ask<const N: usize>(prompts: [&str; N]) -> anyhow::Result<[String; N]> {
    let terminal = File::options()
        .read(true)
        .write(true)
        .open("/dev/tty")
        .context("no terminal to ask for a password; give it on standard input with --password-stdin")?;
    let _silent = EchoGuard::new(&terminal).context("cannot turn off the terminal's echo")?;
    let mut answers = [const { String::new() }; N];
    for (prompt, answer) in prompts.into_iter().zip(&mut answers) {
        (&terminal).write_all(prompt.as_bytes())?;
        *answer = first_line(&terminal)?;
    }
    Ok(answers)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_password_is_the_first_line() {
        for (text, password) in [
            ("four words\n", "four words"),
            (" four words ", " four words "),
            ("four words\r\nmore\n", "four words"),
            ("", ""),
        ] {
            assert_eq!(first_line(text.as_bytes()).expect("text"), password);
        }
    }
}
