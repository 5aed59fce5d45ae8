//! References to images of registries, as podman and skopeo write them:
//! `docker://HOST[:PORT]/REPOSITORY[:TAG][@DIGEST]`.

use std::fmt;
use std::str::FromStr;

use anyhow::{Context, ensure};

use super::digest::Digest;

/// Beginning of a reference.
pub const SCHEME: &str = "docker://";

/// Maximum length of a repository's name (OCI distribution specification 1.1) and of a tag.
const LONGEST_REPOSITORY: usize = 255;
const LONGEST_TAG: usize = 128;

/// An image in a registry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ImageReference {
    /// Host of the registry, with its port if that was given.
    pub registry: String,
    /// Name of the repository, with slashes.
    pub repository: String,
    /// Tag.
    tag: String,
    /// Digest, which decides if it was given.
    digest: Option<Digest>,
}

impl ImageReference {
    /// Returns what the registry is asked for: the digest, or else the tag.
    pub fn version(&self) -> String {
        self.digest.as_ref().map_or_else(|| self.tag.clone(), Digest::to_string)
    }

    /// Returns the digest that was given.
    pub fn digest(&self) -> Option<&Digest> {
        self.digest.as_ref()
    }
}

impl fmt::Display for ImageReference {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mark = if self.digest.is_some() { '@' } else { ':' };
        write!(out, "{}/{}{mark}{}", self.registry, self.repository, self.version())
    }
}

impl FromStr for ImageReference {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> anyhow::Result<ImageReference> {
        let image = text.strip_prefix(SCHEME).unwrap_or(text);
        let (registry, path) = image.split_once('/').unwrap_or(("", image));
        // Other tools take a name without a host for one of their default registry; here there is none.
        let is_host = registry == "localhost" || registry.contains(['.', ':']);
        ensure!(
            is_host && registry.bytes().all(|b| b.is_ascii_alphanumeric() || b".:-[]".contains(&b)),
            "{text} names no registry; write {SCHEME}HOST/REPOSITORY:TAG, such as \
                {SCHEME}registry.example.org/lab/ros:jazzy"
        );
        let (path, digest) = match path.split_once('@') {
            Some((path, digest)) => (path, Some(digest.parse::<Digest>().with_context(|| text.to_owned())?)),
            None => (path, None),
        };
        let (repository, tag) = path.split_once(':').unwrap_or((path, "latest"));
        ensure!(is_repository(repository), "{text}: {repository:?} is not the name of a repository");
        ensure!(tag.len() <= LONGEST_TAG && is_name(tag), "{text}: {tag:?} is not a tag");
        Ok(ImageReference {
            registry: registry.to_owned(),
            repository: repository.to_owned(),
            tag: tag.to_owned(),
            digest,
        })
    }
}

fn is_repository(name: &str) -> bool {
    name.len() <= LONGEST_REPOSITORY && name.split('/').all(is_name)
}

/// Returns whether a text can be a part of an address as it is, and is no dots alone.
fn is_name(text: &str) -> bool {
    let is_good = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
    text.bytes().all(is_good) && text.bytes().any(|byte| byte != b'.')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn references_are_those_of_podman_and_skopeo() {
        let hex = "0123456789abcdef".repeat(4);
        let by_digest = format!("registry.example.org/ros@sha256:{hex}");
        let tagged = format!("registry.example.org/ros:jazzy@sha256:{hex}");
        for (text, registry, repository, shown) in [
            ("registry.example.org/lab/ros:jazzy", "registry.example.org", "lab/ros", ""),
            ("docker://registry.example.org/ros", "registry.example.org", "ros", "registry.example.org/ros:latest"),
            ("docker://localhost/a/b/c:1", "localhost", "a/b/c", "localhost/a/b/c:1"),
            ("127.0.0.1:9090/adder_py:1", "127.0.0.1:9090", "adder_py", ""),
            ("[::1]:5000/x:y", "[::1]:5000", "x", ""),
            (&by_digest, "registry.example.org", "ros", ""),
            (&tagged, "registry.example.org", "ros", &by_digest),
        ] {
            let parsed: ImageReference = text.parse().expect(text);
            assert_eq!((parsed.registry.as_str(), parsed.repository.as_str()), (registry, repository), "{text}");
            assert_eq!(parsed.to_string(), if shown.is_empty() { text } else { shown });
        }
    }

    #[test]
    fn what_is_no_reference_is_refused_in_words() {
        for (text, words) in [
            ("docker://ros:jazzy", "names no registry"),
            ("docker://lab/ros:jazzy", "docker://registry.example.org"),
            ("docker://user:word@registry.example.org/ros", "names no registry"),
            ("docker://registry.example.org", "names no registry"),
            ("docker://registry.example.org/", "is not the name of a repository"),
            ("docker://registry.example.org/../x", "is not the name of a repository"),
            ("docker://registry.example.org/a//b", "is not the name of a repository"),
            ("docker://registry.example.org/ros?x=y", "is not the name of a repository"),
            ("docker://registry.example.org/ros:", "is not a tag"),
            ("docker://registry.example.org/ros:a b", "is not a tag"),
            ("docker://registry.example.org/ros@sha256:12", "is no SHA-256 digest"),
            ("docker://registry.example.org/ros@sha512:12", "is no SHA-256 digest"),
        ] {
            let refused = text.parse::<ImageReference>().expect_err(text);
            assert!(format!("{refused:#}").contains(words), "{refused:#}");
        }
    }
}
