use super::*;

#[test]
fn what_apt_would_fetch_is_understood() {
    let line = "'https://m.invalid/pool/o/openssl/libssl3_3.0.17-1%7edeb12u2_amd64.deb' \
                libssl3_1%3a3.0.17-1~deb12u2_amd64.deb 2031860 SHA256:5c4b";
    let deb = parse_uri(line).expect("a package");
    assert_eq!(deb.to_string(), "libssl3=1:3.0.17-1~deb12u2:amd64");
    let quoted = "'file:/srv/it's' x/a_1_all.deb' a_1_all.deb 1 ";
    assert_eq!(parse_uri(quoted), None, "an address that ends early names no package");
    assert_eq!(parse_uri("Reading package lists..."), None);
    assert_eq!(parse_uri("'https://m.invalid/dists/stable/InRelease' m.invalid_InRelease 0 "), None);
}

/// Creates the lists of an archive that is never contacted.
fn apt_with_lists(root: &Path, packages: &str) -> Apt {
    let sources = "deb [trusted=yes] https://m.invalid/debian stable main\n";
    let apt = Apt::open(root, sources).expect("prepared");
    let lists = root.join("state/lists");
    let prefix = "m.invalid_debian_dists_stable";
    let release = "Origin: Lab\nSuite: stable\nCodename: stable\nArchitectures: amd64 arm64\nComponents: main\n";
    fs::write(lists.join(format!("{prefix}_Release")), release).expect("written");
    for architecture in ["amd64", "arm64"] {
        let name = format!("{prefix}_main_binary-{architecture}_Packages.gz");
        let file = fs::File::create(lists.join(name)).expect("made");
        let mut list = flate2::write::GzEncoder::new(file, flate2::Compression::fast());
        std::io::Write::write_all(&mut list, packages.as_bytes()).expect("written");
        list.finish().expect("written");
    }
    fs::write(root.join("updated"), "").expect("written");
    apt
}

const LAB: &str = "Package: robot\nVersion: 1:2.0-1\nArchitecture: all\nDepends: arm (>= 1), leg | wheel\n\
                   Filename: pool/robot_2.0-1_all.deb\nSize: 1\n\n\
                   Package: arm\nVersion: 1.5\nArchitecture: all\nPre-Depends: bolt\n\
                   Filename: pool/arm_1.5_all.deb\nSize: 1\n\n\
                   Package: bolt\nVersion: 3\nArchitecture: all\nFilename: pool/bolt_3_all.deb\nSize: 1\n\n\
                   Package: bolt\nVersion: 4\nArchitecture: all\nFilename: pool/bolt_4_all.deb\nSize: 1\n\n\
                   Package: wheel\nVersion: 1\nArchitecture: all\nFilename: pool/wheel_1_all.deb\nSize: 1\n";

#[tokio::test]
async fn lists_are_plain_whatever_the_hosts_apt_does() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = apt_with_lists(root.path(), LAB);
    let before = apt.stamp();
    let warning = apt.refresh(false, &progress()).await.expect("nothing is fetched");
    assert_eq!(warning, None);
    assert_eq!(apt.compressed_lists().expect("read"), Vec::<PathBuf>::new());
    let lists = root.path().join("state/lists");
    let plain = lists.join("m.invalid_debian_dists_stable_main_binary-amd64_Packages");
    assert_eq!(fs::read_to_string(plain).expect("there"), LAB);
    assert_ne!(apt.stamp(), before);
    // An unreadable list is reported by apt itself.
    fs::write(lists.join("other_Packages.xz"), "torn").expect("written");
    apt.refresh(false, &progress()).await.expect("not needed");
    assert!(lists.join("other_Packages.xz").exists() && !lists.join("other_Packages").exists());
}

#[tokio::test]
async fn what_is_to_be_installed_comes_in_an_order_that_dpkg_accepts() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = apt_with_lists(root.path(), LAB);
    let names = BTreeSet::from(["robot".to_owned()]);
    let debs = apt.resolve(None, &names).await.expect("resolved");
    let told: Vec<String> = debs.iter().map(Deb::to_string).collect();
    let place = |deb: &str| told.iter().position(|one| one == deb).expect(deb);
    assert_eq!(told.len(), 4, "{told:?}");
    assert!(place("bolt=4:all") < place("arm=1.5:all"), "{told:?}");
    place("robot=1:2.0-1:all");
    place("wheel=1:all");
    // Installed packages are not installed again.
    let status = root.path().join("status");
    let there = "Package: bolt\nStatus: install ok installed\nVersion: 4\nArchitecture: all\n";
    fs::write(&status, there).expect("written");
    let debs = apt.resolve(Some(&status), &names).await.expect("resolved");
    assert!(debs.len() == 3 && debs.iter().all(|deb| deb.name != "bolt"), "{debs:?}");
}

#[tokio::test]
async fn relations_are_those_of_the_lists() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = apt_with_lists(root.path(), LAB);
    let asked = ["robot=1:2.0-1", "arm=1.5"].map(str::to_owned);
    let relations = apt.relations(asked).await.expect("told");
    let names = |names: &BTreeSet<String>| names.iter().cloned().collect::<Vec<_>>().join(" ");
    let told: Vec<_> =
        relations.iter().map(|(name, about)| (name.as_str(), names(&about.needs), names(&about.before))).collect();
    assert_eq!(
        told,
        [("arm", "bolt".to_owned(), "bolt".to_owned()), ("robot", "arm leg wheel".to_owned(), String::new()),]
    );
    // For a part that only adds files: its packages are already installed.
    assert_eq!(apt.relations([]).await.expect("nothing asked").len(), 0);
}

#[tokio::test]
async fn candidates_are_those_that_apt_would_take() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = apt_with_lists(root.path(), LAB);
    for from in ["apt", "the file"] {
        let candidates = apt.candidates().await.expect(from);
        let names: Vec<&str> = candidates.names().collect();
        assert_eq!(names, ["arm", "bolt", "robot", "wheel"], "{from}");
        let bolt = candidates.get("bolt").expect("there");
        assert_eq!(bolt.to_string(), "bolt=4:all", "{from}");
    }
}

#[test]
fn what_a_package_says_of_others_is_understood() {
    let stanza = "Package: libcv-bridge1d\nSource: ros-vision-opencv (1.16.2+ds-4)\nVersion: 1.16.2+ds-4+b1\n\
                  Pre-Depends: init-system-helpers\nDepends: libc6 (>= 2.14), python3:any, a | b (= 1), x [amd64]\n\
                  Provides: cv-plugin (= 1), other\nSuggests: not-this";
    let (name, about) = parse_relations(stanza).expect("a stanza");
    assert_eq!((name.as_str(), about.source.as_str()), ("libcv-bridge1d", "ros-vision-opencv"));
    let names: Vec<&str> = about.needs.iter().map(String::as_str).collect();
    assert_eq!(names, ["a", "b", "init-system-helpers", "libc6", "python3", "x"]);
    assert_eq!(about.before, ["init-system-helpers".to_owned()].into());
    assert_eq!(about.provides, ["cv-plugin".to_owned(), "other".to_owned()].into());
    // A source package of the same name is not listed.
    let (_, about) = parse_relations("Package: zlib1g\nVersion: 1").expect("a stanza");
    assert_eq!((about.source.as_str(), about.needs.len()), ("zlib1g", 0));
    assert_eq!(parse_relations("N: no such package"), None);
}

#[test]
fn epochs_are_escaped_in_file_names() {
    let deb = Deb { name: "login".into(), version: "1:4.13+dfsg1-1".into(), architecture: "amd64".into() };
    assert_eq!(deb.file_name(), "login_1%3a4.13+dfsg1-1_amd64.deb");
}

#[test]
fn the_reason_is_taken_from_apts_refusal() {
    let lines = "Reading package lists...\nE: Unable to locate package nonesuch\nBuilding dependency tree...";
    assert_eq!(extract_errors(lines), "E: Unable to locate package nonesuch");
    let lines = "Some packages could not be installed.\n\nThe following packages have unmet dependencies:\n \
                 a : Depends: b but it is not installable\nE: Unable to correct problems";
    assert_eq!(
        extract_errors(lines),
        "The following packages have unmet dependencies:; a : Depends: b but it is not installable; \
         E: Unable to correct problems"
    );
    assert_eq!(extract_errors("something else"), "something else");
}

#[test]
fn the_state_directory_is_its_own() {
    let root = tempfile::tempdir().expect("a directory");
    Apt::open(root.path(), "deb http://example.invalid/debian bookworm main").expect("prepared");
    let conf = fs::read_to_string(root.path().join("apt.conf")).expect("written");
    assert!(conf.contains(&format!("Dir::State \"{}/state\"", root.path().display())), "{conf}");
    assert!(conf.contains("sources.list"), "{conf}");
}

pub(super) fn progress() -> Progress {
    // Nobody receives the events.
    Progress::new(tokio::sync::mpsc::channel(1).0)
}

#[tokio::test]
async fn what_the_archive_does_not_have_is_said_in_apts_words() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    let names = BTreeSet::from(["nonesuch".to_owned()]);
    let error = apt.resolve(None, &names).await.expect_err("an empty archive").to_string();
    assert_eq!(error, "apt cannot install nonesuch: E: Unable to locate package nonesuch");
    assert_eq!(apt.resolve(None, &BTreeSet::new()).await.expect("nothing asked"), []);
}

#[tokio::test]
async fn after_a_failed_download_the_lists_count_as_old() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    fs::write(root.path().join("updated"), "").expect("written");
    assert!(apt.is_fresh());
    let deb = Deb { name: "nonesuch".into(), version: "1".into(), architecture: "all".into() };
    let error = apt.download(&[deb], &progress()).await.expect_err("an empty archive").to_string();
    assert!(error.contains("Unable to locate package nonesuch") && error.contains("push again"), "{error}");
    assert!(!apt.is_fresh());
    let left = fs::read_dir(root.path().join("archives")).expect("there").count();
    assert_eq!(left, 0, "nothing half-made is left");
}

#[tokio::test]
async fn packages_in_the_cache_are_not_fetched_again() {
    let root = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(root.path(), "").expect("prepared");
    let file = root.path().join("archives/x_1_all.deb");
    fs::write(&file, "").expect("written");
    let deb = Deb { name: "x".into(), version: "1".into(), architecture: "all".into() };
    assert_eq!(apt.download(&[deb], &progress()).await.expect("there"), [file]);
}

#[tokio::test]
async fn apt_is_asked_for_names_alone() {
    let place = tempfile::tempdir().expect("a directory");
    let apt = Apt::open(place.path(), "").expect("prepared");
    for wrong in ["./own.deb", "/tmp/own.deb", "a/sid", "a=1", "a:armhf", "~na", "?true", "-o", ""] {
        let names = BTreeSet::from([wrong.to_owned()]);
        let error = apt.resolve(None, &names).await.expect_err(wrong).to_string();
        assert!(error.contains("not the name of a Debian package"), "{error}");
    }
    let good = ["libstdc++6", "libfoo2.0-dev", "0ad", "?essential"];
    assert!(good.into_iter().all(is_package_name));
}
