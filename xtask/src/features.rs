//! Checks that the Python module, built alone, uses the dependencies of the workspace with the same features.
//!
//! Cargo chooses the features of a dependency for everything that it builds in one go. One that only tests ask
//! for has the dependency, and all that depends on it, built again for the module.

use std::collections::BTreeSet;

use crate::step::{Failure, ask, cargo};

/// The crate that is built alone.
const ALONE: &str = "distributed-observer";

/// Dependencies of the program, and with those of the build itself; `dev` adds those of tests.
const EDGES: [&str; 2] = ["normal,dev", "normal,build,dev"];

/// Compares the features of dependencies.
///
/// # Errors
/// A dependency has features that differ from those in a workspace build.
pub(crate) fn check() -> Result<(), Failure> {
    let mut count = 0;
    for edges in EDGES {
        let alone = tree(&["--package", ALONE], edges)?;
        let different = different(&alone, &tree(&["--workspace"], edges)?);
        if !different.is_empty() {
            return Err(Failure::new(
                format!(
                    "{ALONE} on its own is built with features that differ from the workspace's: {}",
                    different.join("; ")
                ),
                "`cargo tree --workspace --edges features --invert CRATE` shows which crate enables more features; \
                 enable the same in the workspace's Cargo.toml, or fewer in that crate",
            ));
        }
        count += alone.lines().count();
    }
    println!("features: {count} dependencies of {ALONE} are those of the workspace");
    Ok(())
}

/// Returns the lines of `alone` that are not in `workspace`.
fn different<'a>(alone: &'a str, workspace: &str) -> Vec<&'a str> {
    let workspace: BTreeSet<&str> = workspace.lines().collect();
    let alone: BTreeSet<&str> = alone.lines().collect();
    alone.into_iter().filter(|line| !workspace.contains(line)).collect()
}

/// Lists every dependency that is built, with its version and features, one in a line.
fn tree(selection: &[&str], edges: &str) -> Result<String, Failure> {
    let mut tree = cargo("tree");
    tree.args(selection).args(["--edges", edges, "--prefix", "none", "--no-dedupe"]);
    tree.args(["--format", "{p} {f}"]);
    let hint = "run `cargo tree --workspace` to see its message";
    ask(&mut tree)
        .filter(|answer| !answer.is_empty())
        .ok_or_else(|| Failure::new("cargo tree failed", hint))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_feature_that_only_the_workspace_has_is_found() {
        let alone = "clap v4.6.9 default,derive\nrand v0.10.4 std\nrand v0.10.4 std\n";
        assert!(different(alone, alone).is_empty());
        let workspace = "clap v4.6.9 default,derive,env\nrand v0.10.4 std\nmore v1.0.0\n";
        assert_eq!(different(alone, workspace), ["clap v4.6.9 default,derive"]);
    }
}
