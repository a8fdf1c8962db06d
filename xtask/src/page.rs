//! Looks at pages about results in a real browser: `tests/browser`.
//!
//! playwright-core drives Debian's Chromium, and axe-core judges whether a page is accessible; npm installs
//! both into `target/page`, where the tests leave their results and screenshots.

use std::{fs, process::Command};

use crate::{
    host::simulator,
    packages,
    step::{Failure, ask, run, target_folder, workspace},
};

/// What npm installs.
const MODULES: [&str; 2] = ["playwright-core@1.65.1", "axe-core@4.14.1"];

/// Names of the browser, by distribution.
const BROWSERS: [&str; 3] = ["chromium", "chromium-browser", "google-chrome"];

/// Builds the program and runs the tests.
///
/// # Errors
/// A test fails, or something required is missing.
pub(crate) fn page(debian: bool) -> Result<(), Failure> {
    let browser = require(debian)?;
    let program = simulator()?;
    let folder = target_folder().join("page");
    fs::create_dir_all(&folder)
        .map_err(|error| Failure::new(format!("{}: {error}", folder.display()), "free the path"))?;
    let mut install = Command::new("npm");
    install.args([
        "install",
        "--no-save",
        "--no-package-lock",
        "--no-audit",
        "--no-fund",
        "--silent",
    ]);
    install.arg("--prefix").arg(&folder).args(MODULES).current_dir(&folder);
    run("playwright-core and axe-core", &mut install, "check the network, or npm's settings")?;
    let mut test = Command::new("node");
    test.args(["--test", "--test-reporter=spec"])
        .arg(workspace().join("tests/browser/page.test.mjs"))
        .env("HOST_SIM", program)
        .env("FOLDER", &folder)
        .env("CHROMIUM", browser);
    run(
        "pages in a browser",
        &mut test,
        "see the failed test above; screenshots are in target/page",
    )
}

/// Installs what is missing, if that is allowed; returns the browser.
fn require(debian: bool) -> Result<&'static str, Failure> {
    let has = |program: &str| ask(Command::new(program).arg("--version")).is_some();
    let browser = || BROWSERS.into_iter().find(|browser| has(browser));
    let missing: Vec<&str> =
        [(has("node"), "nodejs"), (has("npm"), "npm"), (browser().is_some(), "chromium")]
            .into_iter()
            .filter_map(|(is_there, package)| (!is_there).then_some(package))
            .collect();
    if !missing.is_empty() {
        if !packages::allowed(debian) {
            let names = missing.join(" ");
            let hint = format!("sudo apt-get install {names}");
            return Err(Failure::new(format!("not found: {names}"), hint));
        }
        packages::install(&missing)?;
    }
    browser().ok_or_else(|| Failure::new("chromium does not start", "run chromium --version"))
}
