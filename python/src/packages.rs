//! Weight packages as Python sees them: bytes, or the path of a file.

use std::path::{Path, PathBuf};

use agent_core::package::{Requirements, Serial, StepRange};
use host_sim::error::ErrorReport;
use host_sim::packages::check::{self, requirements};
use host_sim::packages::refusal::refused;
use host_sim::packages::{Facts, PackageBytes, PackageFileError};
use host_sim::signing::{KeyFileError, KeyPair, OperatorKey, fingerprint, read_public_key};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyBytes, PyDict};
use zeroize::Zeroizing;

use crate::bytes::bytes;
use crate::errors::OrRaise;
use crate::json;

/// Reads a package; returns it with its name in errors.
pub(crate) fn read(package: &Bound<'_, PyAny>) -> PyResult<(PackageBytes, PathBuf)> {
    let py = package.py();
    if let Ok(bytes) = bytes("package", package) {
        return Ok((from_bytes(py, &bytes)?, name()));
    }
    let path: PathBuf = package.extract().map_err(|_| {
        let found = package.get_type().to_string();
        PyTypeError::new_err(format!("a package is of type {found}; give bytes or a path"))
    })?;
    Ok((PackageBytes::load(&path).or_raise(py)?, path))
}

/// The name of packages in memory.
fn name() -> PathBuf {
    PathBuf::from("package")
}

fn from_bytes(py: Python<'_>, bytes: &[u8]) -> PyResult<PackageBytes> {
    let package = PackageBytes::new(bytes);
    package.map_err(|error| PackageFileError::Package { path: name(), error }).or_raise(py)
}

/// Return what a package contains, as `host-sim weights inspect --format json` does.
#[pyfunction]
pub(crate) fn inspect<'py>(package: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
    let (bytes, _) = read(package)?;
    json::to_python(package.py(), &Facts::new(&bytes))
}

/// Check a package as a node does: with the public key in the file `key`, if the node has one, and with the
/// package that the node has `in_use`.
#[pyfunction]
#[pyo3(signature = (package, key = None, *, in_use = None))]
pub(crate) fn verify<'py>(
    package: &Bound<'py, PyAny>,
    key: Option<PathBuf>,
    in_use: Option<&Bound<'py, PyAny>>,
) -> PyResult<Bound<'py, PyDict>> {
    let py = package.py();
    let key = key.as_deref().map(read_public_key).transpose().or_raise(py)?;
    let in_use = in_use.map(read).transpose()?;
    let (bytes, path) = read(package)?;
    let requirements = Requirements {
        step_range: StepRange::DEFAULT,
        ..requirements(key.as_slice(), in_use.as_ref().map(|(bytes, _)| bytes))
    };
    let accepted = check::check(&bytes, &requirements);
    let accepted = accepted.map_err(|refusal| refused(&path, &refusal)).or_raise(py)?;
    let report = PyDict::new(py);
    report.set_item("agent", accepted.node.agent)?;
    report.set_item("epoch", accepted.epoch)?;
    report.set_item("version", accepted.version)?;
    report.set_item("signed", bytes.is_signed())?;
    report.set_item("signature_checked", key.is_some())?;
    report.set_item("key_fingerprint", key.as_ref().map(fingerprint))?;
    report.set_item("test_vectors", accepted.test_vectors().count())?;
    Ok(report)
}

/// Return the package with a signature by the private key in the file `key`, which `passphrase` decrypts.
/// `epoch` lets nodes go back to an older network.
#[pyfunction]
#[pyo3(signature = (package, key, *, passphrase = None, replace_signature = false, epoch = None))]
pub(crate) fn sign<'py>(
    package: &Bound<'py, PyAny>,
    key: PathBuf,
    passphrase: Option<String>,
    replace_signature: bool,
    epoch: Option<u32>,
) -> PyResult<Bound<'py, PyBytes>> {
    let py = package.py();
    let passphrase = passphrase.map(Zeroizing::new);
    let (mut bytes, path) = read(package)?;
    let mut ask = |path: &Path| {
        let needed = || KeyFileError::PassphraseNeeded { path: path.to_owned() };
        passphrase.clone().ok_or_else(needed)
    };
    let key = OperatorKey::read_encrypted(&key, &mut ask).or_raise(py)?;
    check::check_signature_before(&path, &bytes, &key, replace_signature).or_raise(py)?;
    if let Some(epoch) = epoch {
        let serial = Serial { epoch, ..bytes.package().serial() };
        let unfit = |error| ErrorReport::usage(format!("{}: {error}", path.display()));
        bytes = bytes.with_serial(serial).map_err(unfit).or_raise(py)?;
    }
    let signed = check::signed(&path, &bytes, &key).or_raise(py)?;
    Ok(PyBytes::new(py, signed.as_bytes()))
}

/// Generate a pair of keys for signing: the files `name` with the endings `.key` and `.pub`.
#[pyfunction]
pub(crate) fn keygen(py: Python<'_>, name: PathBuf) -> PyResult<Bound<'_, PyDict>> {
    let pair = KeyPair::write(&name).or_raise(py)?;
    let report = PyDict::new(py);
    report.set_item("private_key", pair.private)?;
    report.set_item("public_key", pair.public)?;
    report.set_item("fingerprint", fingerprint(pair.key.public_key()))?;
    Ok(report)
}
