//! Tests of the check's scripts with parts that misbehave.

use std::path::Path;
use std::process::{Command, Output};

const MAKEFILE: &str = "\
room:
\t@echo the room is there
test-deps:
\t@sleep 1000 & echo the dependencies are there
lint:
\t@echo a line is too long; exit 3
unit:
\t@echo all tests passed
";

/// Runs `scripts/parts` with [`MAKEFILE`] in place of the Makefile.
fn run_parts(parts: &[&str]) -> Output {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..");
    let place = tempfile::tempdir().expect("a directory");
    std::fs::create_dir(place.path().join("scripts")).expect("a directory");
    std::fs::copy(root.join("scripts/parts"), place.path().join("scripts/parts")).expect("a copy");
    std::fs::write(place.path().join("Makefile"), MAKEFILE).expect("a file");
    // Not by its own name: it could not be executed while another thread's child still has it open for writing.
    Command::new("bash")
        .arg(place.path().join("scripts/parts"))
        .args(parts)
        .env("CARGO_TARGET_DIR", place.path().join("built/cargo"))
        .env_remove("MAKEFLAGS")
        .env_remove("MAKELEVEL")
        .output()
        .expect("a result")
}

fn lines(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

#[test]
fn a_process_that_a_part_leaves_behind_is_named_and_does_not_hold_the_check() {
    let output = run_parts(&["room", "test-deps", "unit"]);
    let text = lines(&output);
    assert!(output.status.success(), "{text}");
    assert!(text.contains("test-deps: LEFT process"), "{text}");
    assert!(text.contains("sleep 1000"), "{text}");
    assert!(text.contains("unit: all tests passed"), "{text}");
}

#[test]
fn a_part_that_failed_is_named_with_the_end_of_its_log() {
    let output = run_parts(&["room", "lint"]);
    let text = lines(&output);
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("== lint failed; the end of target/parts/lint.log:\na line is too long"), "{text}");
    assert!(text.ends_with("failed: lint\n"), "{text}");
}

#[test]
fn an_unknown_part_is_refused_with_those_that_there_are() {
    let output = run_parts(&["nothing"]);
    let text = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(text.contains("knows no part nothing") && text.contains("unit"), "{text}");
}
