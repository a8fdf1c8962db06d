//! Builds the Python module as pip does from a checkout, but in the profile of the other tests, and tests it:
//! its bits and errors beside those of the command line, its type stubs, and its notebook in a bounded form.
//!
//! Everything that pip installs goes to `target/python`.

use std::process::Command;

use crate::{
    host::simulator,
    packages,
    step::{Failure, ask, run, target_folder, workspace},
};

/// Builds the wheel, installs it, and runs its tests.
///
/// # Errors
/// Something required is missing, or a test fails.
pub(crate) fn python(debian: bool) -> Result<(), Failure> {
    require(debian)?;
    let program = simulator()?;
    let folder = target_folder().join("python");
    if !folder.join("bin/pip").exists() {
        let mut command = Command::new("python3");
        let hint = "Python 3.10 or newer with the venv module is needed";
        run("Python", command.args(["-m", "venv"]).arg(&folder), hint)?;
    }
    let module = workspace().join("python");
    let mut install = Command::new(folder.join("bin/pip"));
    install.args(["install", "--quiet", "--disable-pip-version-check"]);
    install.arg(format!("{}[test]", module.display()));
    // The simulator in it is then the one that has been built for the other tests.
    install.env("MATURIN_PEP517_ARGS", "--profile dev");
    run(
        "the wheel",
        &mut install,
        "see the error above; pip has to be able to install packages here",
    )?;
    let python = |arguments: &[&str]| {
        let mut command = Command::new(folder.join("bin/python"));
        // Not in the folder of the module, where Python would find it without its native part.
        command.args(arguments).current_dir(workspace()).env("HOST_SIM", &program);
        command
    };
    let hint =
        "see the failures above; `target/python/bin/pytest python/tests -k NAME` repeats one";
    run("tests in Python", &mut python(&["-m", "pytest", "-q", "python/tests"]), hint)?;
    let config = "--mypy-config-file=python/pyproject.toml";
    let hint = "bring python/distributed_observer/_native.pyi up to date";
    let module = "distributed_observer";
    run("type stubs", &mut python(&["-m", "mypy.stubtest", config, module]), hint)?;
    let config = "--config-file=python/pyproject.toml";
    run("types", &mut python(&["-m", "mypy", config, "--package", module]), "follow mypy")
}

/// Installs what is missing, if that is allowed.
fn require(debian: bool) -> Result<(), Failure> {
    if ask(Command::new("python3").args(["-c", "import ensurepip, venv"])).is_some() {
        return Ok(());
    }
    if packages::allowed(debian) {
        return packages::install(&["python3-venv"]);
    }
    Err(Failure::new("not found: python3-venv", "sudo apt-get install python3-venv"))
}
