//! Signatures in OpenSSH's format.

use ::sign::PublicKey;

/// Key of the seeds, whose other half nobody has.
const KEY: &str = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIH+5f8V5VLRc0ky/siNYdh4m3GBb0x6yEFZzsgx6PS/y";

/// A signature, as an archive of a stub has it.
pub fn signature(data: &[u8]) {
    let text = String::from_utf8_lossy(data);
    let key: PublicKey = KEY.parse().expect("a key");
    let verified = key.verify("cloudroid-stub", &[7; 64], &text);
    assert!(verified.is_err(), "nobody has signed this content");
    let _ = text.parse::<PublicKey>();
}
