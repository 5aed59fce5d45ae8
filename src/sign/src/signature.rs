//! Signatures: made by the server, verified by its command line; robots verify them with `ssh-keygen -Y verify`, or
//! with the program that `install.sh` installs.

use std::io::Read;

use base64_simd::STANDARD;
use ring::signature::{ED25519, UnparsedPublicKey};
use sha2::{Digest, Sha512};

use crate::key::{ALGORITHM, PublicKey, SigningKey};
use crate::{Error, wire};

const MAGIC: &[u8; 6] = b"SSHSIG";
const VERSION: [u8; 4] = 1_u32.to_be_bytes();
const HASH: &[u8] = b"sha512";
const BEGIN: &str = "-----BEGIN SSH SIGNATURE-----";
const END: &str = "-----END SSH SIGNATURE-----";
/// Characters per line, as OpenSSH writes them.
const COLUMNS: usize = 70;

/// Returns the SHA-512 digest of everything that can be read.
pub fn digest(content: &mut impl Read) -> std::io::Result<[u8; 64]> {
    let mut hash = Sha512::new();
    let mut part = vec![0; 64 << 10];
    loop {
        match content.read(&mut part)? {
            0 => return Ok(hash.finalize().into()),
            read => hash.update(&part[..read]),
        }
    }
}

/// Returns the bytes that the key signs.
fn signed_message(namespace: &str, digest: &[u8; 64]) -> Vec<u8> {
    let mut bytes = MAGIC.to_vec();
    for field in [namespace.as_bytes(), b"", HASH, digest] {
        wire::write_string(&mut bytes, field);
    }
    bytes
}

/// Converts an armoured signature to a single line without its BEGIN and END lines, as an HTTP header can hold it.
pub fn to_single_line(armoured: &str) -> String {
    let lines = armoured.lines().filter(|line| !line.starts_with("-----"));
    lines.collect()
}

/// Converts the result of [`to_single_line`] back to the armoured form.
pub fn to_armoured_lines(text: &str) -> String {
    let mut armoured = format!("{BEGIN}\n");
    let mut rest = text;
    while !rest.is_empty() {
        let within = rest.char_indices().nth(COLUMNS);
        let (line, left) = rest.split_at(within.map_or(rest.len(), |(at, _)| at));
        armoured.push_str(line);
        armoured.push('\n');
        rest = left;
    }
    armoured + END + "\n"
}

impl SigningKey {
    /// Signs content by its digest. `namespace` names the purpose: the signature is valid for no other.
    pub fn sign(&self, namespace: &str, digest: &[u8; 64]) -> String {
        let mut signature = Vec::new();
        wire::write_string(&mut signature, ALGORITHM.as_bytes());
        wire::write_string(&mut signature, &self.sign_bytes(&signed_message(namespace, digest)));
        let mut blob = MAGIC.to_vec();
        blob.extend_from_slice(&VERSION);
        let public = self.public_key().to_blob();
        for field in [&public, namespace.as_bytes(), b"", HASH, &signature] {
            wire::write_string(&mut blob, field);
        }
        to_armoured_lines(&STANDARD.encode_to_string(blob))
    }
}

/// A decoded signature.
struct Signature {
    by: PublicKey,
    namespace: String,
    bytes: Vec<u8>,
}

impl Signature {
    fn read(armoured: &str) -> Option<Signature> {
        let body = armoured.trim().strip_prefix(BEGIN)?.strip_suffix(END)?;
        let body: String = body.split_whitespace().collect();
        let blob = STANDARD.decode_to_vec(body).ok()?;
        let mut rest = blob.strip_prefix(MAGIC)?.strip_prefix(&VERSION)?;
        let mut field = || wire::read_string(&mut rest);
        let by = PublicKey::from_blob(field()?)?;
        let namespace = String::from_utf8(field()?.to_vec()).ok()?;
        let (_reserved, hash, mut signature) = (field()?, field()?, field()?);
        let algorithm = wire::read_string(&mut signature)?;
        let bytes = wire::read_string(&mut signature)?.to_vec();
        let known = hash == HASH && algorithm == ALGORITHM.as_bytes();
        (known && rest.is_empty() && signature.is_empty()).then_some(Signature { by, namespace, bytes })
    }
}

impl PublicKey {
    /// Verifies that this key has signed content with this digest.
    pub fn verify(self, namespace: &str, digest: &[u8; 64], armoured: &str) -> Result<(), Error> {
        let signature = Signature::read(armoured).ok_or(Error::NoSignature)?;
        if signature.by != self {
            return Err(Error::OtherKey(signature.by));
        }
        if signature.namespace != namespace {
            return Err(Error::Namespace { found: signature.namespace, wanted: namespace.to_owned() });
        }
        UnparsedPublicKey::new(&ED25519, self.0)
            .verify(&signed_message(namespace, digest), &signature.bytes)
            .map_err(|_| Error::OtherContent)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const NAMESPACE: &str = "cloudroid-stub";

    fn key() -> SigningKey {
        SigningKey::generate().expect("made").0
    }

    fn sha512(content: &[u8]) -> [u8; 64] {
        digest(&mut &*content).expect("read")
    }

    #[test]
    fn what_was_signed_is_verified_and_nothing_else() {
        let (key, other) = (key(), key());
        let signature = key.sign(NAMESPACE, &sha512(b"content"));
        let verify = |key: &SigningKey, namespace, content: &[u8], signature: &str| {
            let verified = key.public_key().verify(namespace, &sha512(content), signature);
            verified.map_err(|error| error.to_string())
        };
        assert_eq!(verify(&key, NAMESPACE, b"content", &signature), Ok(()));
        assert_eq!(to_armoured_lines(&to_single_line(&signature)), signature);
        let stranger = other.sign(NAMESPACE, &sha512(b"content"));
        for (namespace, content, signature, words) in [
            (NAMESPACE, &b"contents"[..], &*signature, "does not match the content"),
            (NAMESPACE, b"", &signature, "does not match the content"),
            ("cloudroid-archive", b"content", &signature, "is for \"cloudroid-stub\""),
            (NAMESPACE, b"content", &stranger, "signed with another key, ssh-ed25519 AAAA"),
            (NAMESPACE, b"content", "", "not an SSH signature"),
            (NAMESPACE, b"content", &signature[..100], "not an SSH signature"),
        ] {
            let refused = verify(&key, namespace, content, signature).expect_err(words);
            assert!(refused.contains(words), "{words}: {refused}");
        }
    }

    /// OpenSSH can verify our signatures.
    #[test]
    fn openssh_verifies_it() {
        let place = tempfile::tempdir().expect("a directory");
        let key = key();
        let path = |name: &str| place.path().join(name);
        std::fs::write(path("signers"), key.public_key().allowed_signers_line()).expect("written");
        std::fs::write(path("signature"), key.sign(NAMESPACE, &sha512(b"content"))).expect("written");
        let verified = |content: &str| {
            std::fs::write(path("content"), content).expect("written");
            let mut command = std::process::Command::new("ssh-keygen");
            command
                .args(["-Y", "verify", "-I", "cloudroid", "-n", NAMESPACE])
                .args(["-f".as_ref(), path("signers").as_os_str()])
                .args(["-s".as_ref(), path("signature").as_os_str()])
                .stdin(std::fs::File::open(path("content")).expect("opened"));
            command.output()
        };
        // Skipped on machines without ssh-keygen.
        let Ok(output) = verified("content") else {
            return;
        };
        assert!(output.status.success(), "{output:?}");
        let verified = |content| verified(content).is_ok_and(|output| output.status.success());
        assert!(!verified("contents"));
    }

    proptest! {
        #[test]
        fn a_signature_with_one_byte_changed_is_refused(at in 0_usize..300, to in any::<u8>()) {
            let key = key();
            let signature = key.sign(NAMESPACE, &sha512(b"content"));
            let mut changed = signature.clone().into_bytes();
            let at = at % changed.len();
            prop_assume!(changed[at] != to && !changed[at].is_ascii_whitespace() && !to.is_ascii_whitespace());
            changed[at] = to;
            if let Ok(changed) = String::from_utf8(changed) {
                prop_assert!(key.public_key().verify(NAMESPACE, &sha512(b"content"), &changed).is_err());
            }
        }
    }
}
