//! Networks saved by PyTorch, JAX and NumPy give the same outputs here; exported networks read back
//! unchanged; invalid files are rejected.
//!
//! `fixtures/tensors/make.py` created the files, `read_exported.py` has read the exported ones.

use std::fs;
use std::path::{Path, PathBuf};

use agent_core::math::activation::Activation;
use agent_core::observer::network::{Architecture, InnerNetwork, Layer, Scratch};
use host_sim::tensors::{
    self, Activations, ActivationsSource, FileKind, ImportReport, NetworkArrays, TensorProblem,
};
use proptest::prelude::*;
use test_support::close;

use crate::core::bits::bits;

/// Valid files with the expected report.
const READABLE: [(&str, &str, ActivationsSource); 9] = [
    ("numpy.npz", "", ActivationsSource::Assumed),
    ("numpy_fortran.npz", "", ActivationsSource::Assumed),
    ("numpy_compressed.npz", "", ActivationsSource::Assumed),
    ("numpy_float64.npz", "", ActivationsSource::Assumed),
    ("numpy_activations.npz", "", ActivationsSource::File),
    ("torch.safetensors", "", ActivationsSource::Assumed),
    ("torch_prefixed.safetensors", "model.", ActivationsSource::File),
    ("jax.npz", "", ActivationsSource::Assumed),
    ("jax.safetensors", "", ActivationsSource::Assumed),
];

/// Invalid files with their error messages.
const REFUSED: [(&str, &str); 12] = [
    (
        "refused_shape.npz",
        "array `layer2.weight` has shape [4, 2], expected [width 1 to 64, inputs 4]; transpose it, or swap .weight and .kernel in its name",
    ),
    (
        "refused_wide.npz",
        "array `layer1.weight` has shape [100, 3], expected [width 1 to 64, inputs 1 to 12]; save a network with these sizes",
    ),
    (
        "refused_float16.npz",
        "array `layer1.bias` contains <f2, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_integers.npz",
        "array `layer1.bias` contains <i8, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_big_endian.npz",
        "array `layer1.weight` contains >f4, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_objects.npz",
        "array `layer1.bias` contains |O, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_bfloat16.safetensors",
        "array `layer1.weight` contains BF16, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_nan.npz",
        "array `layer2.weight` contains NaN at [1, 2], expected finite numbers; train the network again or correct the value",
    ),
    (
        "refused_float64_range.npz",
        "array `layer1.bias` contains 1e300 at [1], beyond the largest float32, 3.4028235e38; scale the network so that its weights are smaller",
    ),
    (
        "refused_missing.npz",
        "missing array `layer2.bias` (found: `layer1.bias`, `layer1.weight`, `layer2.weight`, `outer.weight`); add or rename the array",
    ),
    (
        "refused_unexpected.npz",
        "array `optimizer.step` is not part of a network, expected `layer1.weight`, `layer1.bias` and so on up to `outer.weight`; rename it or leave it out",
    ),
    (
        "refused_activation.npz",
        "unknown activation `relu`, expected one of tanh, logistic, gaussian; train the network with one of these",
    ),
];

/// float32 sums of at most five terms of order one, and activations within 3 ulp.
const RTOL: f64 = 4e-6;
const ATOL: f64 = 2e-6;

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("fixtures/tensors").join(name)
}

fn imported(name: &str) -> (NetworkArrays, ImportReport) {
    tensors::read(&fixture(name), Activations::FromFile).unwrap_or_else(|error| panic!("{error}"))
}

fn refusal(path: &Path, activations: Activations) -> String {
    tensors::read(path, activations).expect_err("a refusal").to_string()
}

/// `W_hat^T sigma(Phi_hat(x))`.
fn outputs(arrays: &NetworkArrays, x: &[f32]) -> Vec<f32> {
    let network = InnerNetwork::new(arrays.architecture.clone(), &arrays.inner).unwrap();
    let mut scratch = Scratch::NEW;
    let features = network.features(x, &mut scratch).unwrap();
    let mut outputs = vec![0.0; x.len()];
    for (row, feature) in arrays.outer.chunks_exact(x.len()).zip(features) {
        for (output, weight) in outputs.iter_mut().zip(row) {
            *output += weight * feature;
        }
    }
    outputs
}

#[test]
fn imported_networks_match_the_original_outputs() {
    let expected: serde_json::Value =
        serde_json::from_str(include_str!("../fixtures/tensors/expected.json")).unwrap();
    let rows = |value: &serde_json::Value| -> Vec<Vec<f32>> {
        serde_json::from_value(value.clone()).unwrap()
    };
    let inputs = rows(&expected["inputs"]);
    assert_eq!(expected["outputs"].as_object().unwrap().len(), READABLE.len());
    for (name, _, _) in READABLE {
        let (arrays, _) = imported(name);
        let there = rows(&expected["outputs"][name]);
        assert_eq!(there.len(), inputs.len());
        for (x, there) in inputs.iter().zip(&there) {
            let here = outputs(&arrays, x);
            assert_eq!(here.len(), there.len());
            for (&here, &there) in here.iter().zip(there) {
                assert!(
                    close(here.into(), there.into(), RTOL, ATOL),
                    "{name} at {x:?}: {here} here, {there} there"
                );
            }
        }
    }
}

#[test]
fn report_has_prefix_activations_and_rounding() {
    for (name, prefix, source) in READABLE {
        let (arrays, report) = imported(name);
        assert_eq!((report.prefix.as_str(), report.activations), (prefix, source), "{name}");
        let layers = arrays.architecture.layers();
        assert_eq!((arrays.architecture.inputs(), layers[0].width, layers[1].width), (3, 4, 2));
        match report.rounding {
            None => assert_ne!(name, "numpy_float64.npz"),
            Some(rounding) => {
                assert_eq!(name, "numpy_float64.npz");
                // Half a unit in the last place, for values of this size.
                let half_ulp = rounding.value.abs() * f64::from(f32::EPSILON) / 2.0;
                assert!(rounding.error > 0.0 && rounding.error <= half_ulp, "{rounding:?}");
            }
        }
    }
    let activations = |name| {
        let (arrays, _) = imported(name);
        arrays.architecture.layers().iter().map(|layer| layer.activation).collect::<Vec<_>>()
    };
    assert_eq!(activations("numpy_activations.npz"), [Activation::Logistic, Activation::Gaussian]);
    assert_eq!(activations("torch.safetensors"), [Activation::Tanh; 2]);
}

#[test]
fn caller_may_state_activations_unless_the_file_differs() {
    let each = Activations::PerLayer(vec![Activation::Gaussian, Activation::Logistic]);
    for (asked, first, second) in [
        (Activations::All(Activation::Gaussian), Activation::Gaussian, Activation::Gaussian),
        (each.clone(), Activation::Gaussian, Activation::Logistic),
    ] {
        let (arrays, report) = tensors::read(&fixture("jax.npz"), asked).unwrap();
        assert_eq!(report.activations, ActivationsSource::Caller);
        let layers = arrays.architecture.layers();
        assert_eq!((layers[0].activation, layers[1].activation), (first, second));
    }
    let stated = fixture("numpy_activations.npz");
    let message = refusal(&stated, each);
    assert!(
        message
            .contains("the activations logistic,gaussian, but gaussian,logistic were requested;"),
        "{message}"
    );
    let three = Activations::PerLayer(vec![Activation::Tanh; 3]);
    let message = refusal(&stated, three);
    assert!(message.contains("3 activations for 2 inner layers; pass one"), "{message}");
}

#[test]
fn rejects_invalid_networks_with_array_and_hint() {
    for (name, message) in REFUSED {
        let path = fixture(name);
        let expected = format!("{}: {message}", path.display());
        assert_eq!(refusal(&path, Activations::FromFile), expected);
    }
}

#[test]
fn rejects_files_that_do_not_match_their_extension() {
    let folder = folder("misnamed");
    let text = "no arrays at all";
    for (name, message) in [
        ("net.npz", "not a valid .npz file: "),
        ("net.safetensors", "not a valid .safetensors file: "),
        ("net.mat", "unknown file extension; "),
        ("npz", "unknown file extension; "),
    ] {
        let path = folder.join(name);
        fs::write(&path, text).unwrap();
        let found = refusal(&path, Activations::FromFile);
        assert!(found.starts_with(&format!("{}: {message}", path.display())), "{found}");
    }
    let absent = refusal(&folder.join("absent.npz"), Activations::FromFile);
    assert!(absent.contains("absent.npz: ") && absent.ends_with("its read permission"));
    let large = folder.join("large.npz");
    fs::File::create(&large).unwrap().set_len(tensors::FILE_BYTES_MAX + 1).unwrap();
    let found = refusal(&large, Activations::FromFile);
    assert!(found.contains("larger than 4194304 bytes"), "{found}");
    fs::remove_file(&large).unwrap();
}

#[test]
fn exported_files_match_those_read_by_numpy_and_pytorch() {
    let (arrays, _) = imported("numpy_activations.npz");
    let written = ["exported.npz", "exported.safetensors"].map(|name| {
        let path = folder("exported").join(name);
        tensors::write(&path, &arrays).unwrap();
        (name, path)
    });
    for (name, path) in written {
        assert!(
            fs::read(&path).unwrap() == fs::read(fixture(name)).unwrap(),
            "{} changed: let read_exported.py read it, then replace {name}",
            path.display()
        );
    }
}

#[test]
fn does_not_write_arrays_that_do_not_match_their_architecture() {
    let path = folder("unfit").join("net.npz");
    let (good, _) = imported("jax.npz");
    let mut short = good.clone();
    short.inner.pop();
    let mut unsafe_inner = good.clone();
    unsafe_inner.inner[3] = f32::NAN;
    let mut long = good.clone();
    long.outer.push(0.0);
    let mut unsafe_outer = good;
    unsafe_outer.outer[1] = f32::INFINITY;
    for (arrays, message) in [
        (short, "25 inner parameters, expected 26; "),
        (unsafe_inner, "inner parameter 3 is not finite; "),
        (long, "7 outer weights, but the architecture has 6; "),
        (unsafe_outer, "outer weight 1 is not finite; "),
    ] {
        let found = tensors::write(&path, &arrays).unwrap_err().to_string();
        assert!(found.starts_with(&format!("{}: {message}", path.display())), "{found}");
        assert!(!path.exists());
    }
    let elsewhere = tensors::write(Path::new("net.onnx"), &imported("jax.npz").0).unwrap_err();
    assert!(matches!(elsewhere.problem, TensorProblem::Extension));
}

/// Creates a separate folder for a test.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("tensors").join(name);
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// Random networks with arbitrary finite weights.
fn networks() -> impl Strategy<Value = NetworkArrays> {
    let activation = prop::sample::select(&Activation::ALL[..]);
    let layer = (1..=64u8, activation).prop_map(|(width, activation)| Layer { width, activation });
    (1..=12usize, prop::collection::vec(layer, 1..=8)).prop_flat_map(|(inputs, layers)| {
        let architecture = Architecture::new(inputs, &layers).unwrap();
        let finite = any::<u32>()
            .prop_map(f32::from_bits)
            .prop_map(|value| if value.is_finite() { value } else { 0.5 });
        let inner = prop::collection::vec(finite.clone(), architecture.parameter_count());
        let outer = prop::collection::vec(finite, architecture.features() * inputs);
        (Just(architecture), inner, outer).prop_map(|(architecture, inner, outer)| NetworkArrays {
            architecture,
            inner,
            outer,
        })
    })
}

/// Damaged fixtures: bytes replaced, a section removed, or truncated.
fn damaged_files() -> impl Strategy<Value = (FileKind, Vec<u8>)> {
    let names: Vec<&str> = READABLE.iter().map(|(name, _, _)| *name).collect();
    let changes = prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6);
    let cut = prop::option::weighted(0.3, (any::<prop::sample::Index>(), 1..40usize));
    (prop::sample::select(names), changes, cut).prop_map(|(name, changes, cut)| {
        let path = fixture(name);
        let mut bytes = fs::read(&path).unwrap();
        for (place, byte) in changes {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        if let Some((place, length)) = cut {
            let start = place.index(bytes.len());
            let end = (start + length).min(bytes.len());
            bytes.drain(start..end);
        }
        (FileKind::of(&path).unwrap(), bytes)
    })
}

fn cases(cases: u32) -> ProptestConfig {
    ProptestConfig { cases, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(cases(48))]

    #[test]
    fn written_networks_read_back_bit_for_bit(arrays in networks(), npz: bool) {
        let name = if npz { "net.npz" } else { "net.safetensors" };
        let path = folder("round_trip").join(name);
        tensors::write(&path, &arrays).unwrap();
        let (again, report) = tensors::read(&path, Activations::FromFile).unwrap();
        prop_assert_eq!(bits(&again.inner), bits(&arrays.inner));
        prop_assert_eq!(bits(&again.outer), bits(&arrays.outer));
        prop_assert_eq!(again.architecture, arrays.architecture);
        prop_assert_eq!(report.activations, ActivationsSource::File);
        prop_assert_eq!(report.rounding, None);
    }
}

proptest! {
    #![proptest_config(cases(4000))]

    #[test]
    fn damaged_files_are_rejected_or_contain_a_valid_network((kind, bytes) in damaged_files()) {
        match tensors::from_bytes(kind, &bytes, Activations::FromFile) {
            Ok((arrays, _)) => {
                let outer = arrays.architecture.features() * arrays.architecture.inputs();
                prop_assert_eq!(arrays.outer.len(), outer);
                prop_assert!(arrays.outer.iter().all(|weight| weight.is_finite()));
                prop_assert!(InnerNetwork::new(arrays.architecture, arrays.inner).is_ok());
            }
            Err(problem) => prop_assert!(problem.to_string().contains("; "), "{}", problem),
        }
    }

    #[test]
    fn rejects_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300), npz: bool) {
        let kind = if npz { FileKind::Npz } else { FileKind::Safetensors };
        let problem = tensors::from_bytes(kind, &bytes, Activations::FromFile).unwrap_err();
        prop_assert!(problem.to_string().contains("; "), "{}", problem);
    }
}
