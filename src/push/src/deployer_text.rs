//! Translation of build events and errors for the deployer.

use std::path::Path;

use api::PushEvent;
use rootfs_builder::BuildEvent;

use super::Error;

/// Name of the unpacked archive in the build directory.
pub(super) const TREE_DIRECTORY: &str = "pushed";

/// Maximum length of an error's message in bytes: it is stored, logged and listed, and names what the package names.
const LONGEST: usize = 32 << 10;

/// Converts a build event for the deployer; `None` for those about other pushes, which `forward_events` tells.
pub(super) fn to_push_event(event: BuildEvent) -> Option<PushEvent> {
    match event {
        BuildEvent::Waits { .. } | BuildEvent::Continues => None,
        BuildEvent::Step { title } => Some(PushEvent::step(title)),
        BuildEvent::Log { line } => Some(PushEvent::Log { line }),
        BuildEvent::Progress { unit, done, total } => Some(PushEvent::Progress { unit: unit.to_owned(), done, total }),
        BuildEvent::Warning { message } => Some(PushEvent::Warning { message }),
    }
}

/// Converts an error of the build. `home` is the daemon's home directory, `source` what was pushed, as named by the
/// deployer.
pub(super) fn to_push_error(error: &rootfs_builder::Error, home: &Path, source: &str) -> Error {
    let mut next = None;
    let (message, log) = match error {
        // The complete log has been sent line by line.
        rootfs_builder::Error::BuildFailed { package, last_lines, advice, .. } => {
            next = (!advice.is_empty()).then(|| advice.join("; "));
            let lines = last_lines.lines().map(str::to_owned).collect();
            let cause = rootfs_builder::find_build_cause(last_lines);
            let cause = cause.map_or_else(String::new, |cause| format!(": {cause}"));
            (format!("the build of {package} failed{cause}"), lines)
        }
        error => (shorten(strip_build_paths(&error.to_string(), home, source)), Vec::new()),
    };
    Error::Failed { message, next, log }
}

/// Cuts a text that is too long.
fn shorten(mut text: String) -> String {
    if text.len() > LONGEST {
        let end = (0..=LONGEST).rev().find(|at| text.is_char_boundary(*at));
        text.truncate(end.unwrap_or(0));
        text.push('…');
    }
    text
}

/// Replaces paths of the build directory by the deployer's own name for what was pushed (`source`).
fn strip_build_paths(text: &str, home: &Path, source: &str) -> String {
    let builds = format!("{}/", home.join("build").display());
    let mut parts = text.split(builds.as_str());
    let mut named = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let inside = part.split_once('/').map_or(part, |(_, inside)| inside);
        match inside.strip_prefix(TREE_DIRECTORY) {
            Some(below) if source.is_empty() => named.push_str(below.trim_start_matches('/')),
            Some(below) => {
                named.push_str(source.trim_end_matches('/'));
                named.push_str(below);
            }
            None => named.push_str(inside),
        }
    }
    named
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_of_the_build_are_told_as_the_pusher_knows_them() {
        let told = |text: &str, source: &str| strip_build_paths(text, Path::new("/home"), source);
        let text = "/home/build/push-1/pushed/src/a/package.xml, line 4: malformed; see /home/build/push-1/log";
        assert_eq!(told(text, "../torn/"), "../torn/src/a/package.xml, line 4: malformed; see log");
        assert_eq!(told("there is no package.xml in /home/build/push-1/pushed", "."), "there is no package.xml in .");
        assert_eq!(told("nothing to fix", "x"), "nothing to fix");
    }

    #[test]
    fn what_a_package_names_does_not_fill_the_database() {
        let many = rootfs_builder::Error::BaseNotSetUp { base: "é".repeat(LONGEST) };
        let Error::Failed { message, .. } = to_push_error(&many, Path::new("/home"), "x") else {
            panic!("it failed");
        };
        assert!(message.starts_with("base éé") && message.ends_with("é…"), "{}", message.len());
        assert!(message.len() <= LONGEST + '…'.len_utf8(), "{}", message.len());
    }

    #[test]
    fn a_failed_build_is_told_with_the_compilers_words() {
        let failed = rootfs_builder::Error::BuildFailed {
            package: "broken".into(),
            log: "/home/build/push-1/log".into(),
            last_lines: "main.cpp:3: error: expected ;\nmake: *** [all] Error 2".into(),
            advice: vec!["the CMake package warp is missing: push with `--with libwarp-dev`".into()],
        };
        let Error::Failed { message, next, log } = to_push_error(&failed, Path::new("/home"), "broken") else {
            panic!("it failed");
        };
        assert_eq!(message, "the build of broken failed: main.cpp:3: error: expected ;");
        assert_eq!(log, ["main.cpp:3: error: expected ;", "make: *** [all] Error 2"]);
        let next = next.expect("what to do");
        assert!(next.contains("`--with libwarp-dev`"), "{next}");
    }
}
