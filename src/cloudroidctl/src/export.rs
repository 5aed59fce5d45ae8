//! `export`: writes the image of a revision to a file that container tools can read (OCI image specification 1.1, image
//! layout).

use std::collections::BTreeSet;
use std::io::{BufWriter, Write};
use std::path::PathBuf;

use anyhow::{Context, bail, ensure};
use api::ServiceDetail;
use bytes::Bytes;
use futures_util::{Stream, StreamExt};
use http_body_util::{BodyExt, BodyStream};
use hyper::{Method, header};
use serde::{Deserialize, Serialize};
use serde_json::json;
use sha2::{Digest, Sha256};

use crate::client::{DaemonClient, empty_body, percent_encode};
use crate::exit::Exit;
use crate::output::{self, OutputFormat};
use crate::whole::AtomicFile;

/// Largest manifest that is read: the daemon's manifests have a few kilobytes.
const LARGEST_MANIFEST: usize = 16 << 20;
/// Block size of a tar archive (POSIX.1-2017, pax interchange format).
const BLOCK: u64 = 512;
/// Annotation of the image that names the blob with the service's record, as the daemon reads it.
const RECORD: &str = "org.cloudroid.record";

/// Export a service to a file for another server, where `cloudroidctl import FILE` publishes it.
///
/// The file is a tar archive of an OCI image layout, which skopeo, umoci and podman can read. Besides the image it
/// contains the service's interface, the commands and limits of its nodes, and its SLA table.
#[derive(Debug, clap::Args)]
pub struct ExportArgs {
    /// Service to export.
    service: String,
    /// Revision to export (default: the current one).
    #[arg(long, value_name = "N")]
    revision: Option<u64>,
    /// Output file (default: SERVICE.oci.tar). An existing file is replaced when the new one is complete.
    #[arg(short, long, value_name = "FILE")]
    output: Option<PathBuf>,
}

/// Summary of an export.
#[derive(Serialize)]
struct ExportSummary {
    service: String,
    revision: u64,
    /// Digest of the image's manifest.
    image: String,
    path: PathBuf,
    bytes: u64,
}

/// Reference to a blob (OCI image specification, descriptor).
#[derive(Debug, Clone, Deserialize)]
struct BlobDescriptor {
    digest: String,
    size: u64,
}

/// Fields of a manifest that refer to blobs.
#[derive(Debug, Deserialize)]
#[serde(rename_all = "camelCase")]
struct BlobManifest {
    media_type: String,
    config: BlobDescriptor,
    layers: Vec<BlobDescriptor>,
}

impl ExportArgs {
    /// Downloads the service and writes the file.
    pub async fn run(self, client: &DaemonClient, format: OutputFormat) -> anyhow::Result<()> {
        let path = format!("/api/v1/services/{}", percent_encode(&self.service));
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
        let target = self.output.unwrap_or_else(|| PathBuf::from(format!("{}.oci.tar", self.service)));
        let half = AtomicFile::create_beside(&target)?;
        let record = fetch_record(client, &self.service, number).await?;
        let name = format!("{}:{number}", self.service);
        let of = ExportedImage { service: &self.service, image: &revision.image, name: &name, record };
        let mut out = LayoutWriter::new(BufWriter::new(&half.file));
        copy_image(client, of, &mut out).await?;
        let bytes = out.finish().with_context(|| half.error_context())?;
        half.persist()?;
        let exported = ExportSummary {
            service: self.service,
            revision: number,
            image: revision.image.clone(),
            path: target,
            bytes,
        };
        match format {
            OutputFormat::Json => output::json(&exported),
            OutputFormat::Table => output::line(&format!(
                "{}: revision {number} of {} ({}), {}",
                exported.path.display(),
                exported.service,
                api::Size(bytes),
                exported.image
            )),
        }
    }
}

/// Downloads the record of a revision, which is not in its image; `None` if the caller may not see it.
async fn fetch_record(client: &DaemonClient, service: &str, number: u64) -> anyhow::Result<Option<Bytes>> {
    let service = percent_encode(service);
    let path = format!("/api/v1/services/{service}/record?revision={number}");
    let answer = match client.send(Method::GET, &path, empty_body()).await {
        Ok(answer) => answer,
        Err(error) if Exit::from_error(&error) == Exit::Forbidden => {
            output::eprint_line(
                "only the image is exported: start commands and limits, which an import needs, are shown to its \
                    deployers only",
            );
            return Ok(None);
        }
        Err(error) => return Err(error),
    };
    let limited = http_body_util::Limited::new(answer.into_body(), LARGEST_MANIFEST);
    match limited.collect().await {
        Ok(collected) => Ok(Some(collected.to_bytes())),
        Err(error) => bail!("the daemon did not send the record of the service: {error}"),
    }
}

/// Image to be written.
struct ExportedImage<'a> {
    service: &'a str,
    /// Digest of the manifest.
    image: &'a str,
    /// Name of the image in the archive.
    name: &'a str,
    record: Option<Bytes>,
}

/// Writes an image and its record to an archive.
async fn copy_image(
    client: &DaemonClient,
    of: ExportedImage<'_>,
    out: &mut LayoutWriter<impl Write>,
) -> anyhow::Result<()> {
    let ExportedImage { image, name, record, .. } = of;
    let service = percent_encode(of.service);
    let path = format!("/v2/{service}/manifests/{}", percent_encode(image));
    let answer = client.send(Method::GET, &path, empty_body()).await?;
    let limited = http_body_util::Limited::new(answer.into_body(), LARGEST_MANIFEST);
    let bytes = match limited.collect().await {
        Ok(collected) => collected.to_bytes(),
        Err(error) => bail!("the daemon did not send the manifest {image}: {error}"),
    };
    let manifest: BlobManifest =
        serde_json::from_slice(&bytes).with_context(|| format!("the manifest {image} cannot be read"))?;
    let mut annotations = json!({ "org.opencontainers.image.ref.name": name });
    let record = record.map(|record| {
        let named = BlobDescriptor { digest: sha256_digest(&record), size: record.len() as u64 };
        annotations[RECORD] = named.digest.clone().into();
        (named, record)
    });
    let index = json!({
        "schemaVersion": 2,
        "mediaType": "application/vnd.oci.image.index.v1+json",
        "manifests": [{
            "mediaType": manifest.media_type,
            "digest": image,
            "size": bytes.len(),
            "annotations": annotations,
        }],
    });
    out.write_file("oci-layout", br#"{"imageLayoutVersion":"1.0.0"}"#)?;
    out.write_file("index.json", &serde_json::to_vec(&index)?)?;
    let named = BlobDescriptor { digest: image.to_owned(), size: bytes.len() as u64 };
    out.write_blob(&named, futures_util::stream::iter([Ok(bytes)])).await?;
    if let Some((named, record)) = record {
        out.write_blob(&named, futures_util::stream::iter([Ok(record)])).await?;
    }
    let mut written = BTreeSet::new();
    for blob in std::iter::once(&manifest.config).chain(&manifest.layers) {
        // Layers may be identical.
        if !written.insert(&blob.digest) {
            continue;
        }
        let path = format!("/v2/{service}/blobs/{}", percent_encode(&blob.digest));
        let answer = client.send(Method::GET, &path, empty_body()).await?;
        let length = answer.headers().get(header::CONTENT_LENGTH);
        let length = length.and_then(|length| length.to_str().ok()?.parse::<u64>().ok());
        ensure!(
            length.is_none_or(|length| length == blob.size),
            "the daemon's blob {} does not have the {} bytes that the manifest states",
            blob.digest,
            blob.size
        );
        let parts = BodyStream::new(answer.into_body()).map(|frame| {
            let frame = frame.context("the daemon's response was cut off")?;
            Ok(frame.into_data().unwrap_or_default())
        });
        out.write_blob(blob, parts).await?;
    }
    Ok(())
}

fn sha256_digest(bytes: &[u8]) -> String {
    format!("sha256:{}", hex_digits(&Sha256::digest(bytes)))
}

fn hex_digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Writes a tar archive from streamed content.
struct LayoutWriter<W: Write> {
    out: W,
    bytes: u64,
}

impl<W: Write> LayoutWriter<W> {
    fn new(out: W) -> Self {
        LayoutWriter { out, bytes: 0 }
    }

    /// Writes a blob and verifies its digest and size.
    async fn write_blob(
        &mut self,
        named: &BlobDescriptor,
        parts: impl Stream<Item = anyhow::Result<Bytes>>,
    ) -> anyhow::Result<()> {
        let digest = &named.digest;
        let is_digit = |byte: u8| matches!(byte, b'0'..=b'9' | b'a'..=b'f');
        let hex = digest.strip_prefix("sha256:").unwrap_or_default();
        ensure!(
            hex.len() == 64 && hex.bytes().all(is_digit),
            "the manifest has an invalid digest {digest:?}: expected sha256: and 64 digits"
        );
        self.begin_entry(&format!("blobs/sha256/{hex}"), named.size)?;
        let mut hash = Sha256::new();
        let mut came = 0;
        let mut parts = std::pin::pin!(parts);
        while let Some(part) = parts.next().await {
            let part = part?;
            came += part.len() as u64;
            ensure!(came <= named.size, "the daemon sent more than the {} bytes of {digest}", named.size);
            hash.update(&part);
            self.write(&part)?;
        }
        ensure!(came == named.size, "the daemon sent {came} of the {} bytes of {digest}", named.size);
        let found = hex_digits(&hash.finalize());
        ensure!(found == hex, "the daemon's data for {digest} has the digest sha256:{found}; nothing was written");
        self.pad_entry(named.size)
    }

    /// Writes a small file.
    fn write_file(&mut self, name: &str, content: &[u8]) -> anyhow::Result<()> {
        self.begin_entry(name, content.len() as u64)?;
        self.write(content)?;
        self.pad_entry(content.len() as u64)
    }

    fn begin_entry(&mut self, name: &str, size: u64) -> anyhow::Result<()> {
        let mut head = tar::Header::new_ustar();
        head.set_path(name)?;
        head.set_size(size);
        head.set_mode(0o644);
        head.set_entry_type(tar::EntryType::Regular);
        head.set_cksum();
        self.write(head.as_bytes())
    }

    /// Pads the content to whole blocks.
    fn pad_entry(&mut self, size: u64) -> anyhow::Result<()> {
        let over = size.next_multiple_of(BLOCK) - size;
        self.write(&[0; BLOCK as usize][..over as usize])
    }

    fn write(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.out.write_all(bytes).context("cannot write the archive")?;
        self.bytes += bytes.len() as u64;
        Ok(())
    }

    /// Writes the end of the archive, two empty blocks, and returns its length.
    fn finish(mut self) -> anyhow::Result<u64> {
        self.write(&[0; 2 * BLOCK as usize])?;
        self.out.flush()?;
        Ok(self.bytes)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    /// SHA-256 of `abc` (FIPS 180-2, appendix B.1).
    const ABC: &str = "sha256:ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

    async fn export_blob(digest: &str, size: u64, parts: &[&'static str]) -> anyhow::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        let mut out = LayoutWriter::new(&mut bytes);
        out.write_file("oci-layout", b"{}")?;
        let parts = parts.iter().map(|part| Ok(Bytes::from_static(part.as_bytes())));
        let named = BlobDescriptor { digest: digest.to_owned(), size };
        out.write_blob(&named, futures_util::stream::iter(parts.collect::<Vec<_>>())).await?;
        let length = out.finish()?;
        assert_eq!(length, bytes.len() as u64);
        Ok(bytes)
    }

    #[tokio::test]
    async fn the_archive_is_one_that_others_read() {
        let bytes = export_blob(ABC, 3, &["a", "bc"]).await.expect("whole");
        let mut read = Vec::new();
        for entry in tar::Archive::new(&bytes[..]).entries().expect("a tar") {
            let mut entry = entry.expect("an entry");
            let mut content = String::new();
            entry.read_to_string(&mut content).expect("text");
            let path = entry.path().expect("a path").display().to_string();
            read.push((path, content));
        }
        let blob = format!("blobs/sha256/{}", &ABC["sha256:".len()..]);
        assert_eq!(read, [("oci-layout".to_owned(), "{}".to_owned()), (blob, "abc".to_owned())]);
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
            let refused = export_blob(digest, size, parts).await.expect_err(expected);
            assert!(refused.to_string().contains(expected), "{refused}");
        }
    }
}
