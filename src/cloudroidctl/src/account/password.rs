//! Reading a password: from a terminal that does not show it, or from standard input.

use std::fs::File;
use std::io::{self, BufRead, BufReader, Read, Write};

use anyhow::{Context, bail};
use nix::sys::termios::{LocalFlags, SetArg, Termios, tcgetattr, tcsetattr};

/// More than any password that the daemon takes, with the end of its line.
const LONGEST: u64 = 4096;

fn first_line(from: impl Read) -> io::Result<String> {
    let mut line = String::new();
    BufReader::new(from.take(LONGEST)).read_line(&mut line)?;
    let line = line.strip_suffix('\n').unwrap_or(&line);
    Ok(line.strip_suffix('\r').unwrap_or(line).to_owned())
}

/// A terminal that shows nothing of what is typed; shows it again when this is dropped.
struct Silent<'a> {
    terminal: &'a File,
    before: Termios,
}

impl<'a> Silent<'a> {
    fn new(terminal: &'a File) -> anyhow::Result<Silent<'a>> {
        let before = tcgetattr(terminal)?;
        let mut silent = before.clone();
        silent.local_flags.remove(LocalFlags::ECHO);
        silent.local_flags.insert(LocalFlags::ECHONL);
        tcsetattr(terminal, SetArg::TCSAFLUSH, &silent)?;
        Ok(Silent { terminal, before })
    }
}

impl Drop for Silent<'_> {
    fn drop(&mut self) {
        let _ = tcsetattr(self.terminal, SetArg::TCSAFLUSH, &self.before);
    }
}

/// A new password: asked for twice at the terminal, or the first line of standard input.
pub fn read(stdin: bool) -> anyhow::Result<String> {
    if stdin {
        let password = first_line(io::stdin()).context("cannot read standard input")?;
        if password.is_empty() {
            bail!("standard input has no password in its first line");
        }
        return Ok(password);
    }
    let terminal = File::options().read(true).write(true).open("/dev/tty").context(
        "there is no terminal to ask for a password at; give it on standard input with --password-stdin",
    )?;
    let silent = Silent::new(&terminal).context("the terminal cannot be kept from showing it")?;
    let asks = |words: &str| -> anyhow::Result<String> {
        (&terminal).write_all(words.as_bytes())?;
        Ok(first_line(&terminal)?)
    };
    let password = asks("Password: ")?;
    let again = asks("The same again: ")?;
    drop(silent);
    if password != again {
        bail!("these were two different passwords; nothing was changed");
    }
    Ok(password)
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
