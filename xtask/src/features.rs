//! Checks that one crate of the workspace is built with the dependencies of all: cargo chooses the features of
//! a dependency for everything that it builds in one go, so a feature that only tests ask for makes it build
//! the dependency, and all that depends on it, once more for the Python module alone.

use std::collections::BTreeSet;

use crate::step::{Failure, ask, cargo};

/// The crate that is built alone.
const ALONE: &str = "distributed-observer";

/// Compares the features of dependencies.
///
/// # Errors
/// A dependency has other features than in a build of the workspace.
pub(crate) fn check() -> Result<(), Failure> {
    let alone = packages(&["--package", ALONE])?;
    let workspace = packages(&["--workspace"])?;
    let different: Vec<&str> = alone.difference(&workspace).map(String::as_str).collect();
    if different.is_empty() && !alone.is_empty() {
        println!("features: {} dependencies of {ALONE} are those of the workspace", alone.len());
        return Ok(());
    }
    Err(Failure::new(
        format!(
            "{ALONE} alone is built with other features than the workspace: {}",
            different.join("; ")
        ),
        "`cargo tree --workspace -e features -i CRATE` names who asks for more; ask for the same in the \
         workspace's Cargo.toml, or for less there",
    ))
}

/// Returns every dependency that is built, with its version and features.
fn packages(selection: &[&str]) -> Result<BTreeSet<String>, Failure> {
    let mut tree = cargo("tree");
    tree.args(selection).args(["--edges", "normal,build,dev", "--prefix", "none"]);
    tree.args(["--no-dedupe", "--format", "{p} {f}"]);
    let answer = ask(&mut tree)
        .ok_or_else(|| Failure::new("cargo tree failed", "run it to see its message"))?;
    Ok(answer.lines().map(str::to_owned).collect())
}
