//! `export`: a revision's image as one file, which tools of containers read (OCI image specification 1.1, image layout).

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

use crate::client::{Client, empty, escaped};
use crate::exit::Exit;
use crate::output::{self, Format};
use crate::whole::Half;

/// The largest manifest that is read: that of an image of the daemon has some kilobytes.
const LARGEST_MANIFEST: usize = 16 << 20;
/// What a tar archive is counted in (POSIX.1-2017, pax interchange format).
const BLOCK: u64 = 512;
/// The annotation of the image that names the blob of the service's record, as the daemon reads it.
const RECORD: &str = "org.cloudroid.record";

/// Write a service into one file, for another server: `cloudroidctl import FILE` publishes it there.
///
/// The file is a tar archive of an OCI image layout, which skopeo, umoci and podman read, too; beside the image it has the service's
/// interface, how its nodes are started and limited, and its dictionary.
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
        let record = record(client, &self.service, number).await?;
        let name = format!("{}:{number}", self.service);
        let of = Named {
            service: &self.service,
            image: &revision.image,
            name: &name,
            record,
        };
        let mut out = Archive::new(BufWriter::new(&half.file));
        copy(client, of, &mut out).await?;
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

/// What of a revision is not in its image; none for who may not see it.
async fn record(client: &Client, service: &str, number: u64) -> anyhow::Result<Option<Bytes>> {
    let service = escaped(service);
    let path = format!("/api/v1/services/{service}/record?revision={number}");
    let answer = match client.send(Method::GET, &path, empty()).await {
        Ok(answer) => answer,
        Err(error) if Exit::of(&error) == Exit::Forbidden => {
            output::complain(
                "only the image is exported: how the service is started and limited is shown to who may deploy it; import needs that",
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

/// What is written.
struct Named<'a> {
    service: &'a str,
    /// Digest of the manifest.
    image: &'a str,
    /// The image's name in the archive.
    name: &'a str,
    record: Option<Bytes>,
}

/// Writes an image and its record.
async fn copy(client: &Client, of: Named<'_>, out: &mut Archive<impl Write>) -> anyhow::Result<()> {
    let Named {
        image,
        name,
        record,
        ..
    } = of;
    let service = escaped(of.service);
    let path = format!("/v2/{service}/manifests/{}", escaped(image));
    let answer = client.send(Method::GET, &path, empty()).await?;
    let limited = http_body_util::Limited::new(answer.into_body(), LARGEST_MANIFEST);
    let bytes = match limited.collect().await {
        Ok(collected) => collected.to_bytes(),
        Err(error) => bail!("the daemon did not send the manifest {image}: {error}"),
    };
    let manifest: Manifest = serde_json::from_slice(&bytes)
        .with_context(|| format!("the manifest {image} cannot be read"))?;
    let mut annotations = json!({ "org.opencontainers.image.ref.name": name });
    let record = record.map(|record| {
        let named = Descriptor {
            digest: digest_of(&record),
            size: record.len() as u64,
        };
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
    out.file("oci-layout", br#"{"imageLayoutVersion":"1.0.0"}"#)?;
    out.file("index.json", &serde_json::to_vec(&index)?)?;
    let named = Descriptor {
        digest: image.to_owned(),
        size: bytes.len() as u64,
    };
    out.blob(&named, futures_util::stream::iter([Ok(bytes)]))
        .await?;
    if let Some((named, record)) = record {
        out.blob(&named, futures_util::stream::iter([Ok(record)]))
            .await?;
    }
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

fn digest_of(bytes: &[u8]) -> String {
    format!("sha256:{}", hex_digits(&Sha256::digest(bytes)))
}

fn hex_digits(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
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
        let found = hex_digits(&hash.finalize());
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
}
