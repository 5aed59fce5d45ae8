//! Writing of an image as a tar archive of an image layout, which [`Store::receive`] of another store accepts.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

use crate::entry::{Entry, Kind};
use crate::oci::{Descriptor, Index, LAYOUT_VERSION, Layout, MEDIA_MANIFEST};
use crate::store::to_json;
use crate::tar_writer::TarWriter;
use crate::{Digest, Error, Store};

/// Bytes copied at a time.
const CHUNK: usize = 256 << 10;

impl Store {
    /// Writes an image to `out` as a tar archive of an image layout. `documents` are added as blobs; each is named by
    /// an annotation of the image's index entry.
    ///
    /// # Errors
    /// [`Error::UnknownImage`], or a failed read or write.
    pub fn write_layout(&self, image: &Digest, documents: &BTreeMap<&str, Vec<u8>>, out: &File) -> Result<(), Error> {
        let _hold = self.hold()?;
        let unknown = || Error::UnknownImage { digest: *image, store: self.images_dir().to_owned() };
        let bytes = self.read_document(image)?.ok_or_else(unknown)?;
        let manifest = self.read_manifest(image)?.ok_or_else(unknown)?;
        let mut entry = Descriptor::new(MEDIA_MANIFEST, *image, bytes.len() as u64);
        for (annotation, document) in documents {
            entry.annotations.insert((*annotation).to_owned(), Digest::compute(document).to_string());
        }
        let layout = to_json(&Layout { image_layout_version: LAYOUT_VERSION.to_owned() });
        let index = to_json(&Index { manifests: vec![entry], ..Index::default() });
        let failed = |error: io::Error| Error::file("write", Path::new("the image's archive"), error);
        let mut archive = LayoutArchive { tar: TarWriter::new(BufWriter::new(out)), buffer: vec![0; CHUNK] };
        archive.add("oci-layout", &layout).map_err(failed)?;
        archive.add("index.json", &index).map_err(failed)?;
        archive.add_blob(image, &bytes[..], bytes.len() as u64).map_err(failed)?;
        for document in documents.values() {
            archive.add_blob(&Digest::compute(document), &document[..], document.len() as u64).map_err(failed)?;
        }
        for part in std::iter::once(&manifest.config).chain(&manifest.layers) {
            let blob = self.blob(&part.digest)?.ok_or_else(unknown)?;
            archive.add_blob(&part.digest, blob.file, blob.size).map_err(failed)?;
        }
        archive.tar.finish().and_then(|mut out| out.flush()).map_err(failed)
    }
}

/// The archive while it is written.
struct LayoutArchive<W> {
    tar: TarWriter<W>,
    buffer: Vec<u8>,
}

impl<W: Write> LayoutArchive<W> {
    fn add_blob(&mut self, digest: &Digest, content: impl io::Read, size: u64) -> io::Result<()> {
        self.add_file(&format!("blobs/sha256/{}", digest.hex()), content, size)
    }

    fn add(&mut self, name: &str, content: &[u8]) -> io::Result<()> {
        self.add_file(name, content, content.len() as u64)
    }

    fn add_file(&mut self, name: &str, content: impl io::Read, size: u64) -> io::Result<()> {
        foreign::cancel::check().map_err(io::Error::other)?;
        let entry = Entry { size, ..Entry::new(name, Kind::File, 0o644) };
        self.tar.write_file(&entry, content, &mut self.buffer)
    }
}

#[cfg(test)]
mod tests {
    use foreign::Tree;

    use super::*;
    use crate::{ImageSpec, Limits, TreeOptions, read_layout_document, unpack};

    #[test]
    fn another_store_receives_what_was_written() {
        let place = tempfile::tempdir().expect("a directory");
        let at = |name: &str| place.path().join(name);
        let store = |name: &str| Store::open(&at(&format!("{name}/images")), &at(&format!("{name}/layers")));
        for name in ["one", "other", "tree/opt"] {
            std::fs::create_dir_all(at(name)).expect("made");
        }
        std::fs::write(at("tree/opt/file"), "content").expect("written");
        let one = store("one").expect("a store");
        let layer = one.layer_from_tree(&at("tree"), &TreeOptions::default()).expect("a layer");
        let spec = ImageSpec { layers: vec![layer], created: 1_700_000_000, ..ImageSpec::default() };
        let image = one.put_image(&spec).expect("an image");
        let documents = BTreeMap::from([("org.example.about", b"{}".to_vec())]);
        let archive = File::create_new(at("archive.tar")).expect("made");
        one.write_layout(&image, &documents, &archive).expect("written");
        let unpacked = at("unpacked");
        let mut archive = File::open(at("archive.tar")).expect("there");
        unpack(&mut archive, &unpacked, &Limits::default()).expect("a tar archive");
        let layout = Tree::open(&unpacked).expect("a directory");
        let received = store("other").expect("a store").receive(&layout, &Limits::default()).expect("a valid layout");
        assert_eq!((received.image.digest, received.image.spec.created), (image, 1_700_000_000));
        let named = received.annotations["org.example.about"].parse().expect("a digest");
        assert_eq!(read_layout_document(&layout, &named).expect("there"), b"{}");
    }
}
