//! Tests that archives are verified by their signatures: real archives, signed by real keys that are generated here,
//! read by the real apt.

use std::process::Command;

use sha2::{Digest, Sha256};

use super::tests::progress;
use super::*;

/// A key of an archive's maintainer, and its key ring.
struct Key {
    home: tempfile::TempDir,
}

impl Key {
    fn new() -> Self {
        let home = tempfile::tempdir().expect("a directory");
        let key = Self { home };
        key.gpg(&["--quick-generate-key", "lab", "ed25519", "sign", "never"]);
        key.gpg(&["--output", &key.ring(), "--export"]);
        key
    }

    fn gpg(&self, arguments: &[&str]) {
        let done = Command::new("gpg")
            .args(["--batch", "--quiet", "--pinentry-mode", "loopback"])
            .args(["--passphrase", "", "--homedir"])
            .arg(self.home.path())
            .args(arguments)
            .output()
            .expect("gpg is started");
        let complaint = String::from_utf8_lossy(&done.stderr);
        assert!(done.status.success(), "gpg {arguments:?}: {complaint}");
    }

    /// Returns the file for `signed-by`.
    fn ring(&self) -> String {
        self.home.path().join("ring.gpg").display().to_string()
    }
}

impl Drop for Key {
    /// gpg leaves an agent process behind.
    fn drop(&mut self) {
        let _ = Command::new("gpgconf").arg("--homedir").arg(self.home.path()).args(["--kill", "all"]).status();
    }
}

const PACKAGES: &str = "Package: arm\nVersion: 1.5\nArchitecture: all\nDescription: an arm\n\
                        Filename: pool/arm_1.5_all.deb\nSize: 1\n";

/// An archive in a directory.
struct Mirror {
    root: tempfile::TempDir,
}

impl Mirror {
    fn new() -> Self {
        let root = tempfile::tempdir().expect("a directory");
        let mirror = Self { root };
        let lists = mirror.lists();
        fs::create_dir_all(lists.parent().expect("a parent")).expect("made");
        fs::write(&lists, PACKAGES).expect("written");
        let hash: String = Sha256::digest(PACKAGES).iter().map(|byte| format!("{byte:02x}")).collect();
        let release = format!(
            "Origin: Lab\nSuite: lab\nCodename: lab\nArchitectures: all amd64 arm64\nComponents: main\n\
             Date: Sat, 01 Jan 2022 00:00:00 UTC\nSHA256:\n {hash} {} main/binary-all/Packages\n",
            PACKAGES.len()
        );
        fs::write(mirror.release(), release).expect("written");
        mirror
    }

    fn signed_by(key: &Key) -> Self {
        let mirror = Self::new();
        let (release, signed) = (mirror.release(), mirror.dist().join("InRelease"));
        let names = [&signed, &release].map(|path| path.display().to_string());
        key.gpg(&["--output", &names[0], "--clearsign", &names[1]]);
        mirror
    }

    fn dist(&self) -> PathBuf {
        self.root.path().join("dists/lab")
    }

    fn release(&self) -> PathBuf {
        self.dist().join("Release")
    }

    fn lists(&self) -> PathBuf {
        self.dist().join("main/binary-all/Packages")
    }

    /// Fetches the lists with a known key ring, and returns what would be installed.
    async fn read(&self, ring: &str) -> Result<Vec<String>, Error> {
        let state = tempfile::tempdir().expect("a directory");
        let at = self.root.path().display();
        let sources = format!("deb [signed-by={ring}] file:{at} lab main\n");
        let apt = Apt::open(state.path(), &sources)?;
        apt.refresh(true, &progress()).await?;
        let debs = apt.resolve(None, &BTreeSet::from(["arm".into()])).await?;
        Ok(debs.iter().map(Deb::to_string).collect())
    }
}

fn assert_mentions(error: &Error, words: &[&str]) {
    let text = error.to_string();
    for words in words {
        assert!(text.contains(words), "{words:?} is not in: {text}");
    }
}

#[tokio::test]
async fn an_archive_is_taken_with_the_signature_of_its_key() {
    let key = Key::new();
    let mirror = Mirror::signed_by(&key);
    let debs = mirror.read(&key.ring()).await.expect("taken");
    assert_eq!(debs, ["arm=1.5:all"]);
}

#[tokio::test]
async fn an_archive_that_somebody_else_has_signed_is_refused_by_name() {
    let (key, other) = (Key::new(), Key::new());
    let mirror = Mirror::signed_by(&other);
    let error = mirror.read(&key.ring()).await.expect_err("refused");
    assert_mentions(&error, &["NO_PUBKEY", "[signed-by=FILE]"]);
}

#[tokio::test]
async fn an_archive_that_nobody_has_signed_is_refused() {
    let key = Key::new();
    let error = Mirror::new().read(&key.ring()).await.expect_err("refused");
    assert_mentions(&error, &["is not signed", "take a mirror"]);
}

#[tokio::test]
async fn lists_that_were_changed_after_the_signature_are_refused() {
    let key = Key::new();
    let mirror = Mirror::signed_by(&key);
    fs::write(mirror.lists(), PACKAGES.replace("1.5", "6.6")).expect("written");
    let error = mirror.read(&key.ring()).await.expect_err("refused");
    assert_mentions(&error, &["Hash Sum mismatch", "push again later"]);
}
