//! Files whose headers claim more or less than they contain.

use std::io::{Read, Write};

use rawzip::{CompressionMethod, ZipArchiveWriter};

use super::npy::Head;
use super::*;

/// Creates an archive with one deflated entry: a header for float32 of this shape, then zeros.
fn zeros_in_npz(name: &str, shape: &[usize], zeros: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut archive = ZipArchiveWriter::new(&mut bytes);
    let (mut entry, config) =
        archive.new_file(name).compression_method(CompressionMethod::DEFLATE).start().unwrap();
    let fast = flate2::Compression::fast();
    let mut writer = config.wrap(flate2::write::DeflateEncoder::new(&mut entry, fast));
    writer.write_all(&Head::row_major("<f4", shape)).unwrap();
    io::copy(&mut io::repeat(0).take(zeros), &mut writer).unwrap();
    let (encoder, descriptor) = writer.finish().unwrap();
    encoder.finish().unwrap();
    entry.finish(descriptor).unwrap();
    archive.finish().unwrap();
    bytes
}

fn refused(kind: FileKind, bytes: &[u8]) -> String {
    from_bytes(kind, bytes, Activations::FromFile).unwrap_err().to_string()
}

#[test]
fn does_not_unpack_oversized_entries() {
    const MANY: u64 = 256 << 20;
    let honest = zeros_in_npz("layer1.weight.npy", &[8192, 8192], MANY);
    assert!((honest.len() as u64) < FILE_BYTES_MAX, "rejected for the file size alone");
    let message = refused(FileKind::Npz, &honest);
    assert!(message.contains("has shape [8192, 8192], expected"), "{message}");
    let modest = zeros_in_npz("layer1.weight.npy", &[64, 12], MANY);
    let message = refused(FileKind::Npz, &modest);
    assert!(message.contains("`layer1.weight` cannot be read: more data than its 3072 bytes"));
}

#[test]
fn rejects_shapes_that_exceed_memory() {
    for shape in [[usize::MAX, usize::MAX], [1 << 40, 1 << 20], [1 << 13, 1 << 13]] {
        let message = refused(FileKind::Npz, &zeros_in_npz("layer1.weight.npy", &shape, 64));
        assert!(message.contains("array `layer1.weight` has shape"), "{message}");
    }
    for head in [
        r#"{"layer1.weight":{"dtype":"F32","shape":[4294967296,4294967296],"data_offsets":[0,64]}}"#,
        r#"{"layer1.weight":{"dtype":"F32","shape":[65536,65536],"data_offsets":[0,17179869184]}}"#,
    ] {
        let mut bytes = (head.len() as u64).to_le_bytes().to_vec();
        bytes.extend(head.bytes());
        bytes.extend([0; 64]);
        assert!(refused(FileKind::Safetensors, &bytes).contains("not a valid .safetensors"));
        bytes[..8].copy_from_slice(&u64::MAX.to_le_bytes());
        assert!(refused(FileKind::Safetensors, &bytes).contains("header too large"));
    }
}

#[test]
fn rejects_truncated_arrays() {
    let message = refused(FileKind::Npz, &zeros_in_npz("layer1.weight.npy", &[3, 2], 23));
    assert!(
        message.contains("cannot be read: unexpected end after 23 of 24 bytes; save"),
        "{message}"
    );
}

#[test]
fn error_names_an_entry_that_is_not_an_array() {
    let mut bytes = Vec::new();
    let mut archive = ZipArchiveWriter::new(&mut bytes);
    archive.new_dir("weights/").create().unwrap();
    archive.finish().unwrap();
    let message = refused(FileKind::Npz, &bytes);
    assert!(
        message.contains("array `weights/` cannot be read: unexpected end of the header"),
        "{message}"
    );
}

#[test]
fn detects_a_wrong_checksum() {
    let mut bytes = zeros_in_npz("layer1.weight.npy", &[3, 2], 24);
    // The checksum in the directory, 16 bytes after its signature.
    let place = bytes.windows(4).rposition(|four| four == b"PK\x01\x02").unwrap() + 16;
    bytes[place] ^= 1;
    let message = refused(FileKind::Npz, &bytes);
    assert!(message.contains("`layer1.weight` cannot be read: "), "{message}");
    assert!(message.to_lowercase().contains("check"), "{message}");
}
