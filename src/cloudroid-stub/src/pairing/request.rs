//! A certificate request (PKCS #10, RFC 2986) in DER (X.690, section 10): a name and a P-256 key (RFC 5480), signed
//! with the key. It asks for nothing else; the server decides everything else about the certificate. Crates that write
//! such requests require a later compiler than robots' programs are built with.

use ring::error::Unspecified;
use ring::rand::SystemRandom;
use ring::signature::{EcdsaKeyPair, KeyPair};

/// Tags (X.680, section 8.6).
const INTEGER: u8 = 0x02;
const BIT_STRING: u8 = 0x03;
const OBJECT_IDENTIFIER: u8 = 0x06;
const UTF8_STRING: u8 = 0x0c;
const SEQUENCE: u8 = 0x30;
const SET: u8 = 0x31;
const ATTRIBUTES: u8 = 0xa0;

/// Encoded object identifiers: id-at-commonName (2.5.4.3), id-ecPublicKey (1.2.840.10045.2.1), secp256r1
/// (1.2.840.10045.3.1.7) and ecdsa-with-SHA256 (1.2.840.10045.4.3.2).
const COMMON_NAME: &[u8] = &[0x55, 0x04, 0x03];
const EC_PUBLIC_KEY: &[u8] = &[0x2a, 0x86, 0x48, 0xce, 0x3d, 0x02, 0x01];
const P256: &[u8] = &[0x2a, 0x86, 0x48, 0xce, 0x3d, 0x03, 0x01, 0x07];
const ECDSA_WITH_SHA256: &[u8] = &[0x2a, 0x86, 0x48, 0xce, 0x3d, 0x04, 0x03, 0x02];

/// Characters per line (RFC 7468, section 2).
const LINE: usize = 64;

/// Encodes tag, length and contents.
fn element(tag: u8, contents: &[&[u8]]) -> Vec<u8> {
    let contents = contents.concat();
    let length = contents.len().to_be_bytes();
    let mut written = vec![tag];
    match contents.len() {
        short @ 0..=127 => written.push(short as u8),
        _ => {
            let zeros = length.iter().take_while(|byte| **byte == 0).count();
            written.push(0x80 | (length.len() - zeros) as u8);
            written.extend(&length[zeros..]);
        }
    }
    written.extend(contents);
    written
}

/// Encodes a bit string without unused bits.
fn bits(bytes: &[u8]) -> Vec<u8> {
    element(BIT_STRING, &[&[0], bytes])
}

fn identifier(encoded: &[u8]) -> Vec<u8> {
    element(OBJECT_IDENTIFIER, &[encoded])
}

/// Returns a certificate request for a P-256 key and a common name, in PEM.
pub fn request(key: &EcdsaKeyPair, name: &str) -> Result<String, Unspecified> {
    let name = element(UTF8_STRING, &[name.as_bytes()]);
    let named = element(SEQUENCE, &[&identifier(COMMON_NAME), &name]);
    let subject = element(SEQUENCE, &[&element(SET, &[&named])]);
    let of_curve = element(SEQUENCE, &[&identifier(EC_PUBLIC_KEY), &identifier(P256)]);
    let public = element(SEQUENCE, &[&of_curve, &bits(key.public_key().as_ref())]);
    let version = element(INTEGER, &[&[0]]);
    let asked = element(SEQUENCE, &[&version, &subject, &public, &element(ATTRIBUTES, &[])]);
    let signature = key.sign(&SystemRandom::new(), &asked)?;
    let by = element(SEQUENCE, &[&identifier(ECDSA_WITH_SHA256)]);
    let signed = element(SEQUENCE, &[&asked, &by, &bits(signature.as_ref())]);
    Ok(pem("CERTIFICATE REQUEST", &signed))
}

/// Returns the textual encoding (RFC 7468).
pub fn pem(label: &str, der: &[u8]) -> String {
    let text = base64_simd::STANDARD.encode_to_string(der);
    let mut written = format!("-----BEGIN {label}-----\n");
    for line in text.as_bytes().chunks(LINE) {
        written.extend(line.iter().map(|letter| char::from(*letter)));
        written.push('\n');
    }
    written + &format!("-----END {label}-----\n")
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateSigningRequestParams, DnType};
    use ring::signature::ECDSA_P256_SHA256_ASN1_SIGNING;

    use super::*;

    #[test]
    fn requests_are_read_by_others() {
        let (kind, random) = (&ECDSA_P256_SHA256_ASN1_SIGNING, SystemRandom::new());
        let made = EcdsaKeyPair::generate_pkcs8(kind, &random).expect("made");
        let key = EcdsaKeyPair::from_pkcs8(kind, made.as_ref(), &random).expect("a key");
        // Lengths encoded in one, two and three bytes.
        for length in [1, 40, 60, 127, 128, 300] {
            let name = "n".repeat(length);
            let text = request(&key, &name).expect("signed");
            // Reading verifies the signature, too.
            let read = CertificateSigningRequestParams::from_pem(&text).expect("read");
            let names: Vec<_> = read.params.distinguished_name.iter().collect();
            let [(DnType::CommonName, rcgen::DnValue::Utf8String(found))] = names[..] else { panic!("{names:?}") };
            assert_eq!(*found, name);
        }
        assert!(text_is_wrapped(&pem("X", &[7; 100])));
    }

    fn text_is_wrapped(text: &str) -> bool {
        text.lines().all(|line| line.len() <= LINE) && text.ends_with("-----END X-----\n")
    }
}
