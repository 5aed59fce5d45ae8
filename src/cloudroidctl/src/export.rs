//! `export`: a revision's image as one file, which tools of containers read (OCI image specification 1.1, image layout).

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};
use api::ServiceDetail;
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use http_body_util::{BodyExt, BodyStream};
use hyper::{Method, header};
use serde::{Deserialize, Serialize};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::client::{Client, empty, escaped};
use crate::output::{self, Format};

/// The largest manifest that is read: that of an image of the daemon has some kilobytes.
const LARGEST_MANIFEST: usize = 16 << 20;
/// What a tar archive is counted in (POSIX.1-2017, pax interchange format).
const BLOCK: u64 = 512;

/// Write the image of a service into one file: a tar archive of an OCI image layout, which skopeo, umoci and podman read.
#[derive(Debug, clap::Args)]
pub struct Export {
    /// The service.
    service: String,
    /// The revision; the current one by default.
    #[arg(long, value_name = "N")]
    revision: Option<u64>,
    /// The file; SERVICE.oci.tar by default. An earlier one is replaced when the new one is whole.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// What was written.
#[derive(Serialize)]
struct Exported {
    service: String,
    revision: u64,
    /// Digest of the image's manifest.
    image: String,
    path: PathBuf,
    bytes: u64,
}

/// Points at a blob (OCI image specification, descriptor).
#[derive(Debug, Clone, Deserialize)]
struct Descriptor {
    digest: String,
    size: u64,
}

/// What of a manifest names blobs.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct Manifest {
    media_type: String,
    config: Descriptor,
    layers: Vec<Descriptor>,
}

impl Export {
    /// Asks and writes.
    pub async fn run(self, client: &Client, format: Format) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}", escaped(&self.service));
        let service: ServiceDetail = client.get(&path).await?;
        let number = self.revision.unwrap_or(service.summary.revision);
        let Some(revision) = service.revisions.iter().find(|one| one.number == number) else {
            let exists = service.revisions.iter().map(|one| one.number.to_string());
            return Err(api::Problem {
                status: 404,
                detail: format!("{} has no revision {number}", self.service),
                exists: exists.collect(),
                ..api::Problem::default()
            }
            .into());
        };
        let target = self
            .output
            .unwrap_or_else(|| PathBuf::from(format!("{}.oci.tar", self.service)));
        let half = Half::beside(&target)?;
        let name = format!("{}:{number}", self.service);
        let mut out = Archive::new(BufWriter::new(&half.file));
        copy(client, &self.service, &revision.image, &name, &mut out).await?;
        let bytes = out.finish().with_context(|| half.failed())?;
        half.publish()?;
        let exported = Exported {
            service: self.service,
            revision: number,
            image: revision.image.clone(),
            path: target,
            bytes,
        };
        match format {
            Format::Json => output::json(&exported),
            Format::Table => output::line(&format!(
                "{}: revision {number} of {} ({}), {}",
                exported.path.display(),
                exported.service,
                api::Size(bytes),
                exported.image
            )),
        }
    }
}

/// Writes the image with this digest, named `name`.
async fn copy(
    client: &Client,
    service: &str,
    image: &str,
    name: &str,
    out: &mut Archive<impl Write>,
) -> anyhow::Result<()> {
    let service = escaped(service);
    let path = format!("/v2/{service}/manifests/{}", escaped(image));
    let answer = client.send(Method::GET, &path, empty()).await?;
    let limited = http_body_util::Limited::new(answer.into_body(), LARGEST_MANIFEST);
    let bytes = match limited.collect().await {
        Ok(collected) => collected.to_bytes(),
        Err(error) => bail!("the daemon did not send the manifest {image}: {error}"),
    };
    let manifest: Manifest = serde_json::from_slice(&bytes)
        .with_context(|| format!("the manifest {image} cannot be read"))?;
    let index = json!({
        "schemaVersion": 2,
        "mediaType": "application/vnd.oci.image.index.v1+json",
        "manifests": [{
            "mediaType": manifest.media_type,
            "digest": image,
            "size": bytes.len(),
            "annotations": { "org.opencontainers.image.ref.name": name },
        }],
    });
    out.file("oci-layout", br#"{"imageLayoutVersion":"1.0.0"}"#)?;
    out.file("index.json", &serde_json::to_vec(&index)?)?;
    let named = Descriptor {
        digest: image.to_owned(),
        size: bytes.len() as u64,
    };
    out.blob(&named, futures_util::stream::iter([Ok(bytes)]))
        .await?;
    let mut written = BTreeSet::new();
    for blob in std::iter::once(&manifest.config).chain(&manifest.layers) {
        // Layers may be equal.
        if !written.insert(&blob.digest) {
            continue;
        }
        let path = format!("/v2/{service}/blobs/{}", escaped(&blob.digest));
        let answer = client.send(Method::GET, &path, empty()).await?;
        let length = answer.headers().get(header::CONTENT_LENGTH);
        let length = length.and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
        ensure!(
            length.is_none_or(|length| length == blob.size),
            "the daemon's blob {} is not of {} bytes, as the manifest says",
            blob.digest,
            blob.size
        );
        let parts = BodyStream::new(answer.into_body()).map(|frame| {
            let frame = frame.context("the daemon broke off its answer")?;
            Ok(frame.into_data().unwrap_or_default())
        });
        out.blob(blob, parts).await?;
    }
    Ok(())
}

/// A tar archive that is written as its content comes.
struct Archive<W: Write> {
    out: W,
    bytes: u64,
}

impl<W: Write> Archive<W> {
    fn new(out: W) -> Self {
        Archive { out, bytes: 0 }
    }

    /// A blob, whose digest and size are compared with what comes.
    async fn blob(
        &mut self,
        named: &Descriptor,
        parts: impl Stream<Item = anyhow::Result<Bytes>>,
    ) -> anyhow::Result<()> {
        let digest = &named.digest;
        let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        let hex = digest.strip_prefix("sha256:").unwrap_or_default();
        ensure!(
            hex.len() == 64 && hex.bytes().all(is_digit),
            "the manifest names a blob {digest:?}, which is not sha256: and 64 digits"
        );
        self.begin(&format!("blobs/sha256/{hex}"), named.size)?;
        let mut hash = Sha256::new();
        let mut came = 0;
        let mut parts = std::pin::pin!(parts);
        while let Some(part) = parts.next().await {
            let part = part?;
            came += part.len() as u64;
            ensure!(
                came <= named.size,
                "the daemon sent more than the {} bytes of {digest}",
                named.size
            );
            hash.update(&part);
            self.write(&part)?;
        }
        ensure!(
            came == named.size,
            "the daemon sent {came} of the {} bytes of {digest}",
            named.size
        );
        let found: String = hash
            .finalize()
            .iter()
            .map(|byte| format!("{byte:02x}"))
            .collect();
        ensure!(
            found == hex,
            "what the daemon sent for {digest} has the digest sha256:{found}; nothing was written"
        );
        self.end(named.size)
    }

    /// A small file.
    fn file(&mut self, name: &str, content: &[u8]) -> anyhow::Result<()> {
        self.begin(name, content.len() as u64)?;
        self.write(content)?;
        self.end(content.len() as u64)
    }

    fn begin(&mut self, name: &str, size: u64) -> anyhow::Result<()> {
        let mut head = tar::Header::new_ustar();
        head.set_path(name)?;
        head.set_size(size);
        head.set_mode(0o644);
        head.set_entry_type(tar::EntryType::Regular);
        head.set_cksum();
        self.write(head.as_bytes())
    }

    /// Contents are filled up to whole blocks.
    fn end(&mut self, size: u64) -> anyhow::Result<()> {
        let over = size.next_multiple_of(BLOCK) - size;
        self.write(&[0; BLOCK as usize][..over as usize])
    }

    fn write(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.out
            .write_all(bytes)
            .context("the archive cannot be written")?;
        self.bytes += bytes.len() as u64;
        Ok(())
    }

    /// Two empty blocks end an archive; gives its length.
    fn finish(mut self) -> anyhow::Result<u64> {
        self.write(&[0; 2 * BLOCK as usize])?;
        self.out.flush()?;
        Ok(self.bytes)
    }
}

/// A file that gets its name when it is whole, and is removed if that does not come.
struct Half {
    file: File,
    path: PathBuf,
    target: PathBuf,
}

impl Half {
    fn beside(target: &Path) -> anyhow::Result<Half> {
        let Some(name) = target.file_name() else {
            bail!("{} names no file; give one with -o FILE", target.display());
        };
        let part = format!(".{}.{}.part", name.to_string_lossy(), std::process::id());
        let path = target.with_file_name(part);
        let file =
            File::create(&path).with_context(|| format!("cannot write {}", target.display()))?;
        Ok(Half {
            file,
            path,
            target: target.to_owned(),
        })
    }

    fn failed(&self) -> String {
        format!("cannot write {}", self.target.display())
    }

    fn publish(&self) -> anyhow::Result<()> {
        self.file.sync_all().with_context(|| self.failed())?;
        std::fs::rename(&self.path, &self.target).with_context(|| self.failed())
    }
}

impl Drop for Half {
    fn drop(&mut self) {
        // It has its own name already, mostly.
        let _ = std::fs::remove_file(&self.path);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    /// SHA-256 of `abc` (FIPS 180-2, appendix B.1).
    const ABC: &str = "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

    async fn written(digest: &str, size: u64, parts: &[&'static str]) -> anyhow::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut out = Archive::new(&mut bytes);
        out.file("oci-layout", b"{}")?;
        let parts = parts
            .iter()
            .map(|part| Ok(Bytes::from_static(part.as_bytes())));
        let named = Descriptor {
            digest: digest.to_owned(),
            size,
        };
        out.blob(
            &named,
            futures_util::stream::iter(parts.collect::<Vec<_>>()),
        )
        .await?;
        let length = out.finish()?;
        assert_eq!(length, bytes.len() as u64);
        Ok(bytes)
    }

    #[tokio::test]
    async fn the_archive_is_one_that_others_read() {
        let bytes = written(ABC, 3, &["a", "bc"]).await.expect("whole");
        let mut read = Vec::new();
        for entry in tar::Archive::new(&bytes[..]).entries().expect("a tar") {
            let mut entry = entry.expect("an entry");
            let mut content = String::new();
            entry.read_to_string(&mut content).expect("text");
            let path = entry.path().expect("a path").display().to_string();
            read.push((path, content));
        }
        let blob = format!("blobs/sha256/{}", &ABC["sha256:".len()..]);
        assert_eq!(
            read,
            [
                ("oci-layout".to_owned(), "{}".to_owned()),
                (blob, "abc".to_owned())
            ]
        );
    }

    #[tokio::test]
    async fn what_is_not_what_the_manifest_names_is_refused() {
        for (digest, size, parts, expected) in [
            (ABC, 3, &["abd"][..], "has the digest"),
            (ABC, 3, &["ab"], "sent 2 of the 3 bytes"),
            (ABC, 3, &["ab", "cd"], "more than the 3 bytes"),
            ("sha256:../../../etc/passwd", 3, &["abc"], "64 digits"),
            ("sha512:00", 3, &["abc"], "64 digits"),
        ] {
            let refused = written(digest, size, parts).await.expect_err(expected);
            assert!(refused.to_string().contains(expected), "{refused}");
        }
    }

    #[test]
    fn a_file_that_is_not_whole_leaves_nothing() {
        let directory = tempfile::tempdir().expect("a directory");
        let target = directory.path().join("x.tar");
        std::fs::write(&target, "earlier").expect("written");
        drop(Half::beside(&target).expect("begun"));
        let names = std::fs::read_dir(directory.path()).expect("listed").count();
        assert_eq!(names, 1);
        let half = Half::beside(&target).expect("begun");
        (&half.file).write_all(b"new").expect("written");
        half.publish().expect("named");
        drop(half);
        assert_eq!(std::fs::read(&target).expect("there"), b"new");
    }
}
