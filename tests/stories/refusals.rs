//! Invalid input: an error that names the problem and the next step, and no partial results.

use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use anyhow::{Context, ensure};
use support::daemon::{Daemon, DaemonSetup};
use support::deployer::{path_str, run};
use support::small_disk::SmallDisk;
use support::world::{ADDER, world};
use support::{Verdict, binaries};

/// Checks that there is no service of this name, no build directory and no servant.
fn expect_nothing_left(daemon: &Daemon, service: &str) -> Verdict {
    ensure!(daemon.get(&format!("/api/v1/services/{service}"))?.0 == 404, "{service} was published");
    ensure!(daemon.servants_of(service)?.is_empty(), "{service} has servants");
    Ok(())
}

pub fn a_directory_without_a_package() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let empty = place.path().join("empty_thing");
    std::fs::create_dir(&empty)?;
    daemon.deployer().run(&["push", path_str(&empty)])?.expect_failure(&["package.xml", "empty_thing"])?;
    let missing = place.path().join("not_there");
    daemon.deployer().run(&["push", path_str(&missing)])?.expect_failure(&["not_there"])?;
    expect_nothing_left(&daemon, "empty_thing")
}

pub fn malformed_xml() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    let package = place.path().join("torn");
    std::fs::create_dir(&package)?;
    std::fs::write(package.join("package.xml"), "<package>\n  <name>torn</name>\n  <version>1.0.0\n</package>\n")?;
    daemon.deployer().run(&["push", path_str(&package)])?.expect_failure(&["package.xml", "line 4"])?;
    expect_nothing_left(&daemon, "torn")
}

pub fn dependencies_that_nothing_provides_are_listed_at_once() -> Verdict {
    let daemon = world().ensure_shared()?;
    daemon.deployer().push("wants_the_impossible", &["--node", "any"])?.expect_failure(&[
        "warp_drive",
        "flux_capacitor_msgs",
        "--map",
    ])?;
    expect_nothing_left(&daemon, "wants_the_impossible")?;
    // What is only misspelled is told with the name that is meant.
    let place = tempfile::tempdir()?;
    run(Command::new("cp").arg("-r").arg(binaries::package("adder_py")).arg(place.path()))?.expect_success()?;
    let package = place.path().join("adder_py");
    let manifest = package.join("package.xml");
    let text = std::fs::read_to_string(&manifest)?;
    std::fs::write(&manifest, text.replace(">rospy<", ">rsopy<"))?;
    let push = ["push", path_str(&package), "--name", "misspelled", "--node", "adder.py"];
    daemon.deployer().run(&push)?.expect_failure(&["rsopy (wanted by adder_py); did you mean rospy"])?;
    expect_nothing_left(&daemon, "misspelled")
}

pub fn a_node_that_leaves_at_once() -> Verdict {
    let daemon = world().ensure_shared()?;
    daemon.deployer().push("leaver_py", &["--node", "leaver.py"])?.expect_failure(&[
        "leaver",
        "3",
        "the map file is missing",
    ])?;
    expect_nothing_left(&daemon, "leaver_py")
}

/// Creates an archive with an entry with an arbitrary, possibly hostile, header.
fn archive_with(entry: impl Fn(&mut tar::Builder<Vec<u8>>)) -> anyhow::Result<Vec<u8>> {
    let mut builder = tar::Builder::new(Vec::new());
    let manifest = b"<package><name>sly</name><version>1.0.0</version><description>x</description>\
        <maintainer email=\"a@b.org\">a</maintainer><license>x</license></package>";
    let mut header = tar::Header::new_gnu();
    header.set_size(manifest.len() as u64);
    header.set_mode(0o644);
    header.set_uid(0);
    header.set_gid(0);
    header.set_mtime(0);
    header.set_cksum();
    builder.append_data(&mut header, "package.xml", &manifest[..])?;
    entry(&mut builder);
    Ok(builder.into_inner()?)
}

fn append_raw(builder: &mut tar::Builder<Vec<u8>>, name: &str, kind: tar::EntryType, link: &str) {
    let mut header = tar::Header::new_ustar();
    let bytes = header.as_mut_bytes();
    bytes[..name.len()].copy_from_slice(name.as_bytes());
    bytes[157..157 + link.len()].copy_from_slice(link.as_bytes());
    header.set_entry_type(kind);
    header.set_mode(0o644);
    header.set_uid(0);
    header.set_gid(0);
    header.set_mtime(0);
    header.set_size(0);
    header.set_cksum();
    builder.append(&header, std::io::empty()).expect("into memory");
}

pub fn archives_that_reach_out_of_their_tree() -> Verdict {
    let daemon = world().ensure_shared()?;
    let place = tempfile::tempdir()?;
    use tar::EntryType;
    let cases: [(&str, EntryType, &str); 6] = [
        ("../escape", EntryType::Regular, ""),
        ("/etc/escape", EntryType::Regular, ""),
        ("dev_null", EntryType::Char, ""),
        ("pipe", EntryType::Fifo, ""),
        ("out", EntryType::Symlink, "../../etc/passwd"),
        ("hard", EntryType::Link, "../../etc/passwd"),
    ];
    for (index, (name, kind, link)) in cases.into_iter().enumerate() {
        let archive = place.path().join(format!("sly{index}.tar"));
        std::fs::write(&archive, archive_with(|builder| append_raw(builder, name, kind, link))?)?;
        daemon
            .deployer()
            .run(&["push", path_str(&archive), "--name", "sly", "--node", "x"])?
            .expect_failure(&[name])?;
    }
    ensure!(!Path::new("/etc/escape").exists());
    expect_nothing_left(&daemon, "sly")
}

pub fn reserved_and_taken_names() -> Verdict {
    let daemon = world().daemon_with(ADDER)?;
    for name in ["api", "v2", "stubs", "metrics", "healthz", "assets"] {
        daemon
            .deployer()
            .push("adder_py", &["--name", name, "--node", "adder.py"])?
            .expect_failure(&[name, "reserved"])?;
    }
    for name in ["../up", "a b", "", "Ümlaut"] {
        daemon.deployer().push("adder_py", &["--name", name, "--node", "adder.py"])?.expect_failure(&["name"])?;
    }
    // The name of a service is not taken over by another package by accident.
    daemon
        .deployer()
        .push("leaver_py", &["--name", "adder_py", "--node", "leaver.py"])?
        .expect_failure(&["adder_py", "taken"])?;
    Ok(())
}

pub fn an_import_of_a_base_leaves_space_on_the_disk() -> Verdict {
    let disk = SmallDisk::mount("importing", "100M")?;
    let daemon = DaemonSetup::new(&disk.home()).start()?;
    let mut import = Command::new(binaries::path("cloudroidctl"))
        .args(["base", "import", "robot", "--from", "-"])
        .env("CLOUDROID_HOME", &daemon.home)
        .env_remove("CLOUDROID_SERVER")
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    // The beginning of a system, which is kept while it arrives: less than a twentieth of the disk is left then.
    let mut sent = import.stdin.take().context("its input")?;
    let mut header = tar::Header::new_gnu();
    header.set_path("usr/share/map.pgm")?;
    header.set_size(1 << 30);
    header.set_mode(0o644);
    header.set_cksum();
    sent.write_all(header.as_bytes())?;
    let part = vec![1; 1 << 20];
    // It may be refused before the last of it is sent.
    let _ = (0..96).try_for_each(|_| sent.write_all(&part));
    // More would come, but nobody waits for it.
    let ended = import.wait_with_output()?;
    drop(sent);
    let said = String::from_utf8_lossy(&ended.stderr);
    ensure!(!ended.status.success() && said.contains("no space") && said.contains("must stay free"), "{said}");
    support::wait_until("nothing of it is left", || {
        let left = std::fs::read_dir(daemon.home.join("build"))?.count();
        Ok(if left == 0 { Ok(()) } else { Err(format!("{left} entries in build")) })
    })?;
    ensure!(daemon.get("/healthz")?.0 == 200, "the daemon lives on");
    Ok(())
}

pub fn a_full_disk_ends_a_push_and_nothing_else() -> Verdict {
    let disk = SmallDisk::mount("small", "24M")?;
    let daemon = DaemonSetup::new(&disk.home()).start()?;
    daemon.deployer().push("adder_py", &["--node", "adder.py"])?.expect_failure(&["no space"])?;
    expect_nothing_left(&daemon, "adder_py")?;
    ensure!(daemon.get("/healthz")?.0 == 200, "the daemon lives on");
    Ok(())
}
