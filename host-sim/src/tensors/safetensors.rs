//! The safetensors format: a JSON header, then the elements of all arrays.
//!
//! The library checks that the arrays cover the file without gaps or overlap, so nothing is
//! allocated for the mere claims of a header. The activations are in the file's metadata, separated
//! by commas.

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

use super::array::{Element, StoredArray};
use super::names::NamedArray;
use super::{Contents, FileKind, TensorProblem};

/// Metadata key of the activations.
const ACTIVATIONS: &str = "activations";

pub(super) fn read(bytes: &[u8]) -> Result<Contents<'_>, TensorProblem> {
    let refused = |error: safetensors::SafeTensorError| TensorProblem::Format {
        kind: FileKind::Safetensors,
        reason: error.to_string(),
    };
    let (_, head) = SafeTensors::read_metadata(bytes).map_err(refused)?;
    let activations =
        head.metadata().as_ref().and_then(|metadata| metadata.get(ACTIVATIONS)).map(|names| {
            names.split(',').map(|name| name.trim().escape_debug().to_string()).collect()
        });
    let tensors = SafeTensors::deserialize(bytes).map_err(refused)?;
    let arrays = tensors
        .iter()
        .map(|(name, tensor)| StoredArray {
            name: name.escape_debug().to_string(),
            shape: tensor.shape().to_vec(),
            element: match tensor.dtype() {
                Dtype::F32 => Element::Float32,
                Dtype::F64 => Element::Float64,
                other => Element::Other(other.to_string()),
            },
            first_index_fastest: false,
            bytes: tensor.data().into(),
        })
        .collect();
    Ok(Contents { arrays, activations })
}

pub(super) fn write(arrays: &[NamedArray], activations: &[&str]) -> Result<Vec<u8>, String> {
    let elements: Vec<Vec<u8>> = arrays
        .iter()
        .map(|array| array.values.iter().flat_map(|value| value.to_le_bytes()).collect())
        .collect();
    let views = arrays
        .iter()
        .zip(&elements)
        .map(|(array, elements)| {
            let view = TensorView::new(Dtype::F32, array.shape.clone(), elements)?;
            Ok((array.name.as_str(), view))
        })
        .collect::<Result<Vec<_>, safetensors::SafeTensorError>>();
    let metadata = [(ACTIVATIONS.to_owned(), activations.join(","))].into_iter().collect();
    views
        .and_then(|views| safetensors::serialize(views, Some(metadata)))
        .map_err(|error| error.to_string())
}
