//! NumPy's archives of arrays: a ZIP file with one `.npy` file per array.
//!
//! No more of an array is unpacked than an array of a network can have, so a header or compressed
//! stream that claims gigabytes is harmless. Checksums of the data used are verified.

use std::io::{Read, Write};

use agent_core::observer::network::INNER_LAYERS_MAX;
use flate2::bufread::DeflateDecoder;
use rawzip::{CompressionMethod, ZipArchive, ZipArchiveWriter};

use super::array::{ELEMENTS_MAX, Element, StoredArray, element_count};
use super::names::NamedArray;
use super::npy::Head;
use super::{Contents, FileKind, TensorProblem};

/// Name of the array with the activations.
const ACTIVATIONS: &str = "activations";
/// Limit for the length of an activation's name, in characters.
const ACTIVATION_LENGTH_MAX: usize = 64;
/// Limit for the number of arrays. A network has at most 18; a few more are listed in the error
/// message.
const ENTRIES_MAX: usize = 256;
/// NumPy stores a character in 4 bytes (UCS-4).
const CHARACTER_BYTES: usize = 4;

pub(super) fn read(bytes: &[u8]) -> Result<Contents<'_>, TensorProblem> {
    let refused = |reason: String| TensorProblem::Format { kind: FileKind::Npz, reason };
    let archive = ZipArchive::from_slice(bytes).map_err(|error| refused(error.to_string()))?;
    let mut contents = Contents { arrays: Vec::new(), activations: None };
    let mut entries = archive.entries();
    let mut count = 0;
    while let Some(entry) = entries.next_entry().map_err(|error| refused(error.to_string()))? {
        count += 1;
        if count > ENTRIES_MAX {
            return Err(refused(format!("more than {ENTRIES_MAX} entries")));
        }
        let path = String::from_utf8_lossy(entry.file_path().as_bytes()).escape_debug().to_string();
        let name = path.strip_suffix(".npy").unwrap_or(&path).to_owned();
        let unreadable = |reason| TensorProblem::Array { array: name.clone(), reason };
        let local =
            archive.get_entry(entry.wayfinder()).map_err(|error| unreadable(error.to_string()))?;
        let unpacked = match entry.compression_method() {
            CompressionMethod::STORE => unpack(local.verifying_reader(local.data()), &name),
            CompressionMethod::DEFLATE => {
                unpack(local.verifying_reader(DeflateDecoder::new(local.data())), &name)
            }
            other => Err(format!("unsupported compression {other}, expected stored or deflated")),
        };
        match unpacked.map_err(unreadable)? {
            Unpacked::Array(array) => contents.arrays.push(array),
            Unpacked::Activations(names) => {
                if contents.activations.replace(names).is_some() {
                    return Err(TensorProblem::Twice { array: ACTIVATIONS.to_owned() });
                }
            }
        }
    }
    Ok(contents)
}

pub(super) fn write(arrays: &[NamedArray], activations: &[&str]) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut archive = ZipArchiveWriter::new(&mut bytes);
    for NamedArray { name, shape, values } in arrays {
        let values = values.iter().flat_map(|value| value.to_le_bytes());
        let entry: Vec<u8> = Head::row_major("<f4", shape).into_iter().chain(values).collect();
        store(&mut archive, name, &entry).map_err(|error| error.to_string())?;
    }
    store(&mut archive, ACTIVATIONS, &text_array(activations))
        .map_err(|error| error.to_string())?;
    archive.finish().map_err(|error| error.to_string())?;
    Ok(bytes)
}

fn store(
    archive: &mut ZipArchiveWriter<&mut Vec<u8>>,
    name: &str,
    bytes: &[u8],
) -> Result<(), rawzip::Error> {
    let path = format!("{name}.npy");
    let (mut entry, config) =
        archive.new_file(&path).compression_method(CompressionMethod::STORE).start()?;
    let mut writer = config.wrap(&mut entry);
    writer.write_all(bytes)?;
    let (_, descriptor) = writer.finish()?;
    entry.finish(descriptor)?;
    Ok(())
}

/// Encodes a vector of strings as NumPy does: all as long as the longest, padded with zeros.
fn text_array(strings: &[&str]) -> Vec<u8> {
    let width = strings.iter().map(|string| string.chars().count()).max().unwrap_or(0);
    let mut bytes = Head::row_major(&format!("<U{width}"), &[strings.len()]);
    for string in strings {
        let padding = std::iter::repeat('\0');
        let characters = string.chars().chain(padding).take(width);
        bytes.extend(characters.flat_map(|character| u32::from(character).to_le_bytes()));
    }
    bytes
}

enum Unpacked {
    Array(StoredArray<'static>),
    Activations(Vec<String>),
}

fn unpack(mut source: impl Read, name: &str) -> Result<Unpacked, String> {
    let head = Head::read(&mut source)?;
    if name == ACTIVATIONS {
        return texts(&head, source).map(Unpacked::Activations);
    }
    let Head { descr, fortran_order: first_index_fastest, shape } = head;
    let element = match descr.as_str() {
        "<f4" => Element::Float32,
        "<f8" => Element::Float64,
        other => Element::Other(other.escape_debug().to_string()),
    };
    let count = element_count(&shape).filter(|&count| count <= ELEMENTS_MAX);
    let bytes = match (count, element.size()) {
        (Some(count), Some(size)) => exactly(source, count * size)?,
        // The array will be rejected for its shape or element type.
        _ => Vec::new(),
    };
    let name = name.to_owned();
    Ok(Unpacked::Array(StoredArray {
        name,
        shape,
        element,
        first_index_fastest,
        bytes: bytes.into(),
    }))
}

/// Reads the strings of a vector, or of an array without dimensions.
fn texts(head: &Head, source: impl Read) -> Result<Vec<String>, String> {
    let width = head
        .descr
        .strip_prefix("<U")
        .and_then(|width| width.parse().ok())
        .filter(|width| (1..=ACTIVATION_LENGTH_MAX).contains(width));
    let count = match head.shape.as_slice() {
        [] => Some(1),
        &[count] => Some(count).filter(|count| (1..=INNER_LAYERS_MAX).contains(count)),
        _ => None,
    };
    let (Some(width), Some(count)) = (width, count) else {
        return Err(format!(
            "elements {} in shape {:?}, expected a vector of at most {INNER_LAYERS_MAX} strings (<U8)",
            head.descr.escape_debug(),
            head.shape
        ));
    };
    let bytes = exactly(source, count * width * CHARACTER_BYTES)?;
    bytes
        .chunks_exact(width * CHARACTER_BYTES)
        .map(|string| {
            let string: Option<String> = string
                .as_chunks()
                .0
                .iter()
                .map(|&character| char::from_u32(u32::from_le_bytes(character)))
                .collect();
            let string = string.ok_or("invalid characters")?;
            // MATLAB pads with blanks.
            Ok(string.trim_end_matches('\0').trim_end().escape_debug().to_string())
        })
        .collect()
}

/// Returns the `length` bytes left in `source`; fewer or more are an error.
fn exactly(source: impl Read, length: usize) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::with_capacity(length + 1);
    // Reading one more byte makes the reader reach its end and verify the checksum.
    source.take(length as u64 + 1).read_to_end(&mut bytes).map_err(|error| error.to_string())?;
    match bytes.len() {
        found if found < length => Err(format!("unexpected end after {found} of {length} bytes")),
        found if found > length => Err(format!("more data than its {length} bytes")),
        _ => Ok(bytes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strings_are_read_without_padding() {
        for strings in [&["tanh", "logistic"][..], &["tanh    ", "logistic"]] {
            let Ok(Unpacked::Activations(names)) =
                unpack(text_array(strings).as_slice(), ACTIVATIONS)
            else {
                panic!("{strings:?} cannot be read");
            };
            assert_eq!(names, ["tanh", "logistic"]);
        }
    }
}
