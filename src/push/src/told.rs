//! Translation of build events and errors for the deployer.

use std::path::Path;

use api::PushEvent;
use rootfs_builder::BuildEvent;

use super::{Deployer, Error};

/// Name of the unpacked archive in the build directory.
pub(super) const PUSHED: &str = "pushed";

/// Converts a build event for the deployer. Services of others are named only if the deployer may publish them.
pub(super) fn to_push_event(event: BuildEvent, by: &Deployer) -> PushEvent {
    match event {
        BuildEvent::Waits { push } => {
            let whose = match by.check_may_publish(&push) {
                Ok(()) => format!("the push of {push}"),
                Err(_) => "another push".to_owned(),
            };
            PushEvent::Step { title: format!("waiting: {whose} is building a layer that this one needs, too") }
        }
        BuildEvent::Step { title } => PushEvent::Step { title },
        BuildEvent::Log { line } => PushEvent::Log { line },
        BuildEvent::Progress { unit, done, total } => PushEvent::Progress { unit: unit.to_owned(), done, total },
        BuildEvent::Warning { message } => PushEvent::Warning { message },
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
        error => (strip_build_paths(&error.to_string(), home, source), Vec::new()),
    };
    Error::Failed { message, next, log }
}

/// Replaces paths of the build directory by the deployer's own name for what was pushed (`source`).
fn strip_build_paths(text: &str, home: &Path, source: &str) -> String {
    let builds = format!("{}/", home.join("build").display());
    let mut parts = text.split(builds.as_str());
    let mut named = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let inside = part.split_once('/').map_or(part, |(_, inside)| inside);
        match inside.strip_prefix(PUSHED) {
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
    fn whoever_waits_is_told_for_whom_where_that_may_be_known() {
        let by = Deployer {
            owner: None,
            may: Box::new(|name| {
                if name.starts_with("lab_") { Ok(()) } else { Err(Error::NotAllowed("not yours".to_owned())) }
            }),
            over: Box::new(|| Box::pin(std::future::pending())),
        };
        for (push, whose) in [("lab_maps", "the push of lab_maps"), ("field", "another push")] {
            let event = BuildEvent::Waits { push: push.into() };
            let PushEvent::Step { title } = super::to_push_event(event, &by) else {
                panic!("a step");
            };
            let expected = format!("waiting: {whose} is building a layer that this one needs, too");
            assert_eq!(title, expected);
        }
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
