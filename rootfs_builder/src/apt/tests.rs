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
fn what_a_package_says_of_others_is_understood() {
    let stanza = "Package: libcv-bridge1d\nSource: ros-vision-opencv (1.16.2+ds-4)\nVersion: 1.16.2+ds-4+b1\n\
                  Pre-Depends: init-system-helpers\nDepends: libc6 (>= 2.14), python3:any, a | b (= 1), x [amd64]\n\
                  Provides: cv-plugin (= 1), other\nSuggests: not-this";
    let (name, about) = parse_relations(stanza).expect("a stanza");
    assert_eq!(
        (name.as_str(), about.source.as_str()),
        ("libcv-bridge1d", "ros-vision-opencv")
    );
    let names: Vec<&str> = about.needs.iter().map(String::as_str).collect();
    assert_eq!(
        names,
        ["a", "b", "init-system-helpers", "libc6", "python3", "x"]
    );
    assert_eq!(
        about.provides,
        ["cv-plugin".to_owned(), "other".to_owned()].into()
    );
    // A source package of the same name is not told.
    let (_, about) = parse_relations("Package: zlib1g\nVersion: 1").expect("a stanza");
    assert_eq!((about.source.as_str(), about.needs.len()), ("zlib1g", 0));
    assert_eq!(parse_relations("N: no such package"), None);
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
    let lines = "Reading package lists...\nE: Unable to locate package nonesuch\nBuilding dependency tree...";
    assert_eq!(apts_words(lines), "E: Unable to locate package nonesuch");
    let lines = "Some packages could not be installed.\n\nThe following packages have unmet dependencies:\n \
                 a : Depends: b but it is not installable\nE: Unable to correct problems";
    assert_eq!(
        apts_words(lines),
        "The following packages have unmet dependencies:; a : Depends: b but it is not installable; \
         E: Unable to correct problems"
    );
    assert_eq!(apts_words("something else"), "something else");
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

fn progress() -> Progress {
    // Nobody listens.
    Progress::new(tokio::sync::mpsc::channel(1).0)
}

#[tokio::test]
async fn what_the_archive_does_not_have_is_said_in_apts_words() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    let names = BTreeSet::from(["nonesuch".to_owned()]);
    let error = apt
        .resolve(None, &names)
        .await
        .expect_err("an empty archive")
        .to_string();
    assert_eq!(
        error,
        "apt cannot install nonesuch: E: Unable to locate package nonesuch"
    );
    assert_eq!(
        apt.resolve(None, &BTreeSet::new())
            .await
            .expect("nothing asked"),
        []
    );
}

#[tokio::test]
async fn after_a_failed_download_the_lists_count_as_old() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    fs::write(root.path().join("updated"), "").expect("written");
    assert!(apt.is_fresh());
    let deb = Deb {
        name: "nonesuch".into(),
        version: "1".into(),
        architecture: "all".into(),
    };
    let error = apt
        .download(&[deb], &progress())
        .await
        .expect_err("an empty archive")
        .to_string();
    assert!(
        error.contains("Unable to locate package nonesuch") && error.contains("push again"),
        "{error}"
    );
    assert!(!apt.is_fresh());
    let left = fs::read_dir(root.path().join("archives"))
        .expect("there")
        .count();
    assert_eq!(left, 0, "nothing half-made is left");
}

#[tokio::test]
async fn packages_in_the_cache_are_not_fetched_again() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    let file = root.path().join("archives/x_1_all.deb");
    fs::write(&file, "").expect("written");
    let deb = Deb {
        name: "x".into(),
        version: "1".into(),
        architecture: "all".into(),
    };
    assert_eq!(
        apt.download(&[deb], &progress()).await.expect("there"),
        [file]
    );
}
