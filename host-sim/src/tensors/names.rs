//! Maps array names to the parts of a network.
//!
//! `layer{q}.bias`, `layer{q}.weight` or `layer{q}.kernel` for `q = 1..=ell`, `outer.weight` or
//! `outer.kernel`. A weight has the shape `[outputs, inputs]`, as in PyTorch's `Linear`, a kernel
//! `[inputs, outputs]`, as in JAX's libraries and in the core.

use std::collections::BTreeMap;

use agent_core::INPUTS_MAX;
use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, INNER_LAYERS_MAX, LAYER_WIDTH_MAX, Layer};

use super::array::{Rounding, StoredArray};
use super::{Extent, NetworkArrays, TensorProblem};

/// The numbers of a network, without its activations.
pub(super) struct Parts {
    pub(super) inputs: usize,
    /// Widths of the inner layers, at least one.
    pub(super) widths: Vec<usize>,
    pub(super) inner: Vec<f32>,
    pub(super) outer: Vec<f32>,
    pub(super) prefix: String,
    pub(super) rounding: Option<Rounding>,
}

/// An array to write.
pub(super) struct NamedArray {
    pub(super) name: String,
    pub(super) shape: Vec<usize>,
    pub(super) values: Vec<f32>,
}

impl Parts {
    /// Returns the architecture with one activation per layer.
    pub(super) fn architecture(
        &self,
        activations: &[Activation],
    ) -> Result<Architecture, TensorProblem> {
        let layers: Vec<Layer> = self
            .widths
            .iter()
            .zip(activations)
            // At most LAYER_WIDTH_MAX; the architecture rejects 0.
            .map(|(&width, &activation)| Layer {
                width: u8::try_from(width).unwrap_or(0),
                activation,
            })
            .collect();
        Architecture::new(self.inputs, &layers).map_err(TensorProblem::Network)
    }
}

/// Assembles a network from `arrays`; each of them must belong to it.
pub(super) fn assemble(arrays: Vec<StoredArray<'_>>) -> Result<Parts, TensorProblem> {
    let mut named = BTreeMap::new();
    for array in arrays {
        if let Some(twice) = named.insert(array.name.clone(), array) {
            return Err(TensorProblem::Twice { array: twice.name });
        }
    }
    let prefix = common_prefix(named.keys())?;
    let names = named.keys().cloned().collect();
    let mut found = Found { arrays: named, names, prefix, rounding: None };
    let layers = found.count_layers()?;

    let mut widths = Vec::with_capacity(layers);
    let mut inner = Vec::new();
    let mut inputs = None;
    for layer in 1..=layers {
        let from = match widths.last() {
            None => Extent::UpTo("inputs", INPUTS_MAX),
            Some(&width) => Extent::Exactly("inputs", width),
        };
        let (shape, weights) =
            found.matrix(&format!("layer{layer}"), from, Extent::UpTo("width", LAYER_WIDTH_MAX))?;
        inputs.get_or_insert(shape[0]);
        inner.extend(found.bias(&format!("layer{layer}"), shape[1])?);
        inner.extend(weights);
        widths.push(shape[1]);
    }
    let inputs = inputs.unwrap_or(0);
    let features = widths.last().copied().unwrap_or(0);
    let (_, outer) = found.matrix(
        "outer",
        Extent::Exactly("features", features),
        Extent::Exactly("state components", inputs),
    )?;
    match found.arrays.pop_first() {
        Some((array, _)) => Err(TensorProblem::Unexpected { array, prefix: found.prefix }),
        None => Ok(Parts {
            inputs,
            widths,
            inner,
            outer,
            prefix: found.prefix,
            rounding: found.rounding,
        }),
    }
}

/// Returns the arrays of a network under their canonical names, in order of evaluation.
pub(super) fn disassemble(arrays: &NetworkArrays) -> Vec<NamedArray> {
    let NetworkArrays { architecture, inner, outer } = arrays;
    let mut named = Vec::new();
    let mut rest = inner.as_slice();
    for (index, (inputs, layer)) in architecture.shapes().enumerate() {
        let width = usize::from(layer.width);
        let (biases, after) = rest.split_at(width);
        let (weights, after) = after.split_at(inputs * width);
        rest = after;
        named.push(NamedArray {
            name: format!("layer{}.weight", index + 1),
            shape: vec![width, inputs],
            values: transposed(weights, inputs),
        });
        named.push(NamedArray {
            name: format!("layer{}.bias", index + 1),
            shape: vec![width],
            values: biases.to_vec(),
        });
    }
    let (features, state) = (architecture.features(), architecture.inputs());
    named.push(NamedArray {
        name: "outer.weight".to_owned(),
        shape: vec![state, features],
        values: transposed(outer, features),
    });
    named
}

/// Returns the prefix of `layer1.weight` or `layer1.kernel`: empty, or words that end in a dot.
fn common_prefix<'n>(
    names: impl Iterator<Item = &'n String> + Clone,
) -> Result<String, TensorProblem> {
    names
        .clone()
        .find_map(|name| {
            ["layer1.weight", "layer1.kernel"]
                .into_iter()
                .find_map(|first| name.strip_suffix(first))
                .filter(|prefix| prefix.is_empty() || prefix.ends_with('.'))
        })
        .map(str::to_owned)
        .ok_or_else(|| TensorProblem::Missing {
            array: "layer1.weight".to_owned(),
            found: names.cloned().collect(),
        })
}

/// The contents of a file during assembly.
struct Found<'f> {
    /// The arrays not yet used.
    arrays: BTreeMap<String, StoredArray<'f>>,
    /// The names of all arrays.
    names: Vec<String>,
    prefix: String,
    rounding: Option<Rounding>,
}

impl<'f> Found<'f> {
    /// Returns the largest layer number.
    fn count_layers(&self) -> Result<usize, TensorProblem> {
        let mut count = 0;
        for name in self.arrays.keys() {
            let Some((number, _)) = name
                .strip_prefix(&self.prefix)
                .and_then(|name| name.strip_prefix("layer"))
                .and_then(|name| name.split_once('.'))
            else {
                continue;
            };
            if number.is_empty() || !number.bytes().all(|digit| digit.is_ascii_digit()) {
                continue;
            }
            match number.parse() {
                Ok(layer) if (1..=INNER_LAYERS_MAX).contains(&layer) => count = count.max(layer),
                _ => return Err(TensorProblem::LayerNumber { array: name.clone() }),
            }
        }
        Ok(count)
    }

    fn take(&mut self, name: &str) -> Option<StoredArray<'f>> {
        self.arrays.remove(&format!("{}{name}", self.prefix))
    }

    fn missing(&self, name: &str) -> TensorProblem {
        TensorProblem::Missing {
            array: format!("{}{name}", self.prefix),
            found: self.names.clone(),
        }
    }

    /// Reads a matrix in either orientation: its shape `[from, to]` and its rows, one per input.
    fn matrix(
        &mut self,
        part: &str,
        from: Extent,
        to: Extent,
    ) -> Result<([usize; 2], Vec<f32>), TensorProblem> {
        let (weight, kernel) = (format!("{part}.weight"), format!("{part}.kernel"));
        match (self.take(&weight), self.take(&kernel)) {
            (Some(weight), None) => {
                let values = weight.values(&[to, from], &mut self.rounding)?;
                let (outputs, inputs) = (weight.shape[0], weight.shape[1]);
                Ok(([inputs, outputs], transposed(&values, outputs)))
            }
            (None, Some(kernel)) => {
                let values = kernel.values(&[from, to], &mut self.rounding)?;
                Ok(([kernel.shape[0], kernel.shape[1]], values))
            }
            (None, None) => Err(self.missing(&weight)),
            (Some(weight), Some(kernel)) => {
                Err(TensorProblem::BothOrientations { weight: weight.name, kernel: kernel.name })
            }
        }
    }

    fn bias(&mut self, part: &str, width: usize) -> Result<Vec<f32>, TensorProblem> {
        let name = format!("{part}.bias");
        let bias = self.take(&name).ok_or_else(|| self.missing(&name))?;
        bias.values(&[Extent::Exactly("width", width)], &mut self.rounding)
    }
}

/// Transposes a row-major matrix with this many rows.
fn transposed(values: &[f32], rows: usize) -> Vec<f32> {
    let columns = values.len() / rows;
    (0..columns).flat_map(|column| values[column..].iter().step_by(columns).copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::super::array::Element;
    use super::*;

    fn array(name: &str, shape: &[usize], first: u16) -> StoredArray<'static> {
        let count = shape.iter().product::<usize>() as u16;
        let bytes: Vec<u8> =
            (first..first + count).flat_map(|v| f32::from(v).to_le_bytes()).collect();
        StoredArray {
            name: name.to_owned(),
            shape: shape.to_vec(),
            element: Element::Float32,
            first_index_fastest: false,
            bytes: bytes.into(),
        }
    }

    /// Creates a network with two inputs and three nodes.
    fn small(prefix: &str) -> Vec<StoredArray<'static>> {
        let named = |name: &str| format!("{prefix}{name}");
        vec![
            array(&named("layer1.weight"), &[3, 2], 1),
            array(&named("layer1.bias"), &[3], 7),
            array(&named("outer.kernel"), &[3, 2], 10),
        ]
    }

    fn refused(arrays: Vec<StoredArray<'_>>) -> String {
        assemble(arrays).map(|_| ()).unwrap_err().to_string()
    }

    #[test]
    fn parameters_are_biases_then_one_row_per_input() {
        let parts = assemble(small("")).unwrap();
        assert_eq!(parts.inner, [7.0, 8.0, 9.0, 1.0, 3.0, 5.0, 2.0, 4.0, 6.0]);
        assert_eq!(parts.outer, [10.0, 11.0, 12.0, 13.0, 14.0, 15.0]);
        assert_eq!((parts.inputs, parts.widths, parts.prefix.as_str()), (2, vec![3], ""));
    }

    #[test]
    fn drops_a_common_prefix() {
        let parts = assemble(small("net.inner.")).unwrap();
        assert_eq!((parts.inner.len(), parts.prefix.as_str()), (9, "net.inner."));
        let mut mixed = small("net.");
        mixed.push(array("layer2.bias", &[3], 1));
        let message = refused(mixed);
        assert!(message.contains("`layer2.bias` is not part") && message.contains("net.layer1"));
        assert!(
            refused(small("net_")).contains("missing array `layer1.weight` (found: `net_layer1")
        );
    }

    #[test]
    fn rejects_unknown_and_duplicate_arrays() {
        for (extra, message) in [
            ("layer1.kernel", "contains both `layer1.weight` and `layer1.kernel`"),
            ("layer1.bias", "contains array `layer1.bias` twice"),
            ("layer1.scale", "`layer1.scale` is not part of a network"),
            ("layer3.bias", "missing array `layer2.weight`"),
            ("layer9.weight", "`layer9.weight` does not belong to a layer from 1 to 8"),
            ("layer0.weight", "`layer0.weight` does not belong to a layer from 1 to 8"),
            ("layer99999999999999999999.weight", "does not belong to a layer from 1 to 8"),
            ("layer01.weight", "`layer01.weight` is not part of a network"),
            ("layer.weight", "`layer.weight` is not part of a network"),
        ] {
            let mut arrays = small("");
            arrays.push(array(extra, &[3, 2], 0));
            let found = refused(arrays);
            assert!(found.contains(message), "{extra}: {found}");
        }
    }

    #[test]
    fn missing_array_error_lists_the_names_found() {
        for missing in 0..3 {
            let mut arrays = small("a.");
            let name = arrays.remove(missing).name.replace("kernel", "weight");
            let name = if missing == 0 { "layer1.weight" } else { &name };
            let found = refused(arrays);
            assert!(found.contains(&format!("missing array `{name}` (found: ")), "{found}");
        }
        assert!(refused(Vec::new()).contains("(found: none); add"));
    }

    #[test]
    fn rejects_sizes_that_do_not_match_or_exceed_limits() {
        for (name, shape, message) in [
            ("layer1.weight", &[65, 2][..], "[65, 2], expected [width 1 to 64, inputs 1 to 12]"),
            ("layer1.weight", &[3, 13], "[3, 13], expected [width 1 to 64, inputs 1 to 12]"),
            ("layer1.weight", &[3], "[3], expected [width 1 to 64, inputs 1 to 12]"),
            ("layer1.bias", &[2], "[2], expected [width 3]"),
            ("outer.kernel", &[2, 3], "[2, 3], expected [features 3, state components 2]"),
        ] {
            let mut arrays = small("");
            let place = arrays.iter().position(|array| array.name == name).unwrap();
            arrays[place] = array(name, shape, 0);
            let found = refused(arrays);
            assert!(found.contains(message), "{found}");
        }
    }
}
