use super::*;

#[test]
fn apts_simulation_is_understood() {
    let deb = parse_inst(
        "Inst libssl3 [3.0.1-1] (3.0.17-1~deb12u2 Debian:12.12/oldstable, Debian-Security:12 [amd64]) []",
    );
    let deb = deb.expect("an installation");
    assert_eq!(deb.to_string(), "libssl3=3.0.17-1~deb12u2:amd64");
    let plain = parse_inst("Inst ros-std-msgs (0.5.13-2 Debian:12.12/oldstable [all])")
        .expect("an installation");
    assert_eq!(plain.architecture, "all");
    assert_eq!(
        parse_inst("Conf ros-std-msgs (0.5.13-2 Debian:12.12/oldstable [all])"),
        None
    );
}

#[test]
fn epochs_are_escaped_in_file_names() {
    let deb = Deb {
        name: "login".into(),
        version: "1:4.13+dfsg1-1".into(),
        architecture: "amd64".into(),
    };
    assert_eq!(deb.file_name(), "login_1%3a4.13+dfsg1-1_amd64.deb");
}

#[test]
fn the_reason_is_taken_from_apts_refusal() {
    let lines = "Reading package lists...\nBuilding dependency tree...\nE: Unable to locate package nonesuch";
    assert_eq!(apts_words(lines), "E: Unable to locate package nonesuch");
}

#[test]
fn the_state_directory_is_its_own() {
    let root = tempfile::tempdir().expect("a directory");
    Apt::open(
        root.path(),
        "deb http://example.invalid/debian bookworm main",
    )
    .expect("prepared");
    let conf = fs::read_to_string(root.path().join("apt.conf")).expect("written");
    assert!(
        conf.contains(&format!("Dir::State \"{}/state\"", root.path().display())),
        "{conf}"
    );
    assert!(conf.contains("sources.list"), "{conf}");
}
