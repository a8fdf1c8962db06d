//! Networks that PyTorch, JAX and NumPy saved compute here what they computed there; ours come
//! back unchanged; anything else is refused with its name.
//!
//! `fixtures/tensors/make.py` wrote the files, `read_exported.py` has read ours.

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

/// Files with networks, and what the report must say.
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

/// Files that are refused, and why.
const REFUSED: [(&str, &str); 12] = [
    (
        "refused_shape.npz",
        "array `layer2.weight` has shape [4, 2], expected [width 1 to 64, inputs 4]; transpose it, or exchange .weight and .kernel in its name",
    ),
    (
        "refused_wide.npz",
        "array `layer1.weight` has shape [100, 3], expected [width 1 to 64, inputs 1 to 12]; save the array of a network with these sizes",
    ),
    (
        "refused_float16.npz",
        "array `layer1.bias` holds <f2, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_integers.npz",
        "array `layer1.bias` holds <i8, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_big_endian.npz",
        "array `layer1.weight` holds >f4, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_objects.npz",
        "array `layer1.bias` holds |O, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_bfloat16.safetensors",
        "array `layer1.weight` holds BF16, expected little-endian float32 or float64; convert it to float32",
    ),
    (
        "refused_nan.npz",
        "array `layer2.weight` holds NaN at [1, 2], expected finite numbers; train the network again or repair the value",
    ),
    (
        "refused_float64_range.npz",
        "array `layer1.bias` holds 1e300 at [1], beyond the largest float32, 3.4028235e38; scale the network so that its weights are smaller",
    ),
    (
        "refused_missing.npz",
        "has no array `layer2.bias`, it has `layer1.bias`, `layer1.weight`, `layer2.weight`, `outer.weight`; add the array, or give it this name",
    ),
    (
        "refused_unexpected.npz",
        "array `optimizer.step` is not part of a network, expected `layer1.weight`, `layer1.bias` and so on up to `outer.weight`; rename it or leave it out",
    ),
    (
        "refused_activation.npz",
        "activation `relu` is unknown, expected one of tanh, logistic, gaussian; train the network with one of these",
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
fn imported_networks_compute_what_they_computed_where_they_were_trained() {
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
fn the_report_tells_prefix_activations_and_rounding() {
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
fn the_caller_can_state_activations_that_the_file_does_not_contradict() {
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
        message.contains("for the activations logistic,gaussian, asked for are gaussian,logistic;"),
        "{message}"
    );
    let three = Activations::PerLayer(vec![Activation::Tanh; 3]);
    let message = refusal(&stated, three);
    assert!(message.contains("3 activations for 2 inner layers; give one"), "{message}");
}

#[test]
fn what_is_no_network_is_refused_by_name_and_with_a_mend() {
    for (name, message) in REFUSED {
        let path = fixture(name);
        let expected = format!("{}: {message}", path.display());
        assert_eq!(refusal(&path, Activations::FromFile), expected);
    }
}

#[test]
fn files_that_are_not_what_their_name_says_are_refused() {
    let folder = folder("misnamed");
    let text = "no arrays at all";
    for (name, message) in [
        ("net.npz", "is not a readable .npz file: "),
        ("net.safetensors", "is not a readable .safetensors file: "),
        ("net.mat", "ends in neither .npz nor .safetensors; "),
        ("npz", "ends in neither .npz nor .safetensors; "),
    ] {
        let path = folder.join(name);
        fs::write(&path, text).unwrap();
        let found = refusal(&path, Activations::FromFile);
        assert!(found.starts_with(&format!("{}: {message}", path.display())), "{found}");
    }
    let absent = refusal(&folder.join("absent.npz"), Activations::FromFile);
    assert!(absent.contains("absent.npz: ") && absent.ends_with("permission to read it"));
    let large = folder.join("large.npz");
    fs::File::create(&large).unwrap().set_len(tensors::FILE_BYTES_MAX + 1).unwrap();
    let found = refusal(&large, Activations::FromFile);
    assert!(found.contains("is larger than 4194304 bytes"), "{found}");
    fs::remove_file(&large).unwrap();
}

#[test]
fn exported_files_are_those_that_numpy_and_pytorch_have_read() {
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
fn arrays_that_do_not_fit_their_architecture_are_not_written() {
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
        (short, "25 inner parameters, the architecture has 26; "),
        (unsafe_inner, "inner parameter 3 is not finite; "),
        (long, "7 outer weights, the architecture has 6; "),
        (unsafe_outer, "outer weight 1 is not finite; "),
    ] {
        let found = tensors::write(&path, &arrays).unwrap_err().to_string();
        assert!(found.starts_with(&format!("{}: {message}", path.display())), "{found}");
        assert!(!path.exists());
    }
    let elsewhere = tensors::write(Path::new("net.onnx"), &imported("jax.npz").0).unwrap_err();
    assert!(matches!(elsewhere.problem, TensorProblem::Extension));
}

/// A folder of this test alone.
fn folder(name: &str) -> PathBuf {
    let folder = Path::new(env!("CARGO_TARGET_TMPDIR")).join("tensors").join(name);
    fs::create_dir_all(&folder).unwrap();
    folder
}

/// Any network, with finite weights of any bits.
fn networks() -> impl Strategy<Value = NetworkArrays> {
    let activation =
        prop::sample::select(&[Activation::Tanh, Activation::Logistic, Activation::Gaussian][..]);
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

/// A file of the fixtures, changed: bytes replaced, a stretch taken out or the end cut off.
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
    fn what_is_written_is_read_bit_for_bit(arrays in networks(), npz: bool) {
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
    fn damaged_files_are_refused_or_hold_a_network((kind, bytes) in damaged_files()) {
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
    fn any_bytes_are_refused(bytes in prop::collection::vec(any::<u8>(), 0..300), npz: bool) {
        let kind = if npz { FileKind::Npz } else { FileKind::Safetensors };
        let problem = tensors::from_bytes(kind, &bytes, Activations::FromFile).unwrap_err();
        prop_assert!(problem.to_string().contains("; "), "{}", problem);
    }
}
