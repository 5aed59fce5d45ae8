//! Captures the first error of an installation: dpkg prints many errors, most of them consequences of the first.

/// Maximum number of lines of the failed package.
const MOST_LINES: usize = 12;

/// Listener for the first error in the output of dpkg.
#[derive(Debug, Default)]
pub(crate) struct FirstError {
    lines: Vec<String>,
    /// True once the error itself was seen; continuation lines begin with a space.
    heard: bool,
    over: bool,
}

impl FirstError {
    /// Processes a line of dpkg's output.
    pub(crate) fn push_line(&mut self, line: &str) {
        if self.over {
            return;
        }
        if self.heard {
            if line.starts_with(' ') {
                self.lines.push(line.to_owned());
            }
            self.over = true;
            return;
        }
        let another = ["Setting up ", "Preparing to unpack ", "Unpacking ", "Selecting previously ", "(Reading "]
            .iter()
            .any(|start| line.starts_with(start));
        if another {
            self.lines.clear();
        }
        if self.lines.len() == MOST_LINES {
            self.lines.remove(0);
        }
        self.lines.push(line.to_owned());
        self.heard = line.starts_with("dpkg: error");
    }

    /// Returns the first error, preceded by the output of its package; `None` if there was no error.
    pub(crate) fn text(&self) -> Option<String> {
        self.heard.then(|| self.lines.join("\n"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_error_is_told_with_what_led_to_it() {
        let mut complaint = FirstError::default();
        for line in [
            "Setting up java-common (0.74) ...",
            "Setting up openjdk-17-jre-headless:amd64 (17.0.13) ...",
            "update-alternatives: error: error creating symbolic link '/usr/share/man/man1/java.1.gz.dpkg-tmp'",
            "dpkg: error processing package openjdk-17-jre-headless:amd64 (--install):",
            " installed openjdk-17-jre-headless:amd64 package post-installation script returned error exit status 2",
            "dpkg: dependency problems prevent configuration of default-jre-headless:",
            " default-jre-headless depends on openjdk-17-jre-headless; however:",
            "Errors were encountered while processing:",
        ] {
            complaint.push_line(line);
        }
        let text = complaint.text().expect("dpkg complained");
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(lines.len(), 4, "{text}");
        assert!(lines[1].contains("man1/java.1.gz") && lines[3].ends_with("exit status 2"), "{text}");
    }

    #[test]
    fn what_went_well_is_no_complaint() {
        let mut complaint = FirstError::default();
        complaint.push_line("Setting up libfoo1 (1.0) ...");
        assert_eq!(complaint.text(), None);
    }
}
