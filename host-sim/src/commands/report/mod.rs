//! `report`: a page about the results in a folder.

mod pages;

use std::path::{Path, PathBuf};

use clap::Args;
use serde::Serialize;

use super::run_folder::{PAGE, command_of};
use super::{CommandError, Format, print_json, print_text};
use crate::files::output::write_whole;
use crate::page::KIND;

/// Arguments of `report`.
#[derive(Debug, Args)]
pub(super) struct Arguments {
    /// Folder that `run` or `sweep` wrote
    folder: PathBuf,
    /// The page [default: report.html in the folder]
    #[arg(long, value_name = "FILE.html")]
    out: Option<PathBuf>,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Written<'a> {
        report: &'a Path,
        bytes: usize,
    }
    let folder = &arguments.folder;
    let out = arguments.out.clone().unwrap_or_else(|| folder.join(PAGE));
    let page = of_folder(folder, || command_of(folder))?;
    write(&out, &page)?;
    match arguments.format {
        Format::Json => print_json(&Written { report: &out, bytes: page.len() }),
        Format::Text => {
            let kilobytes = page.len().div_ceil(1000);
            print_text(&format!("Written to {} ({kilobytes} kB)\n", out.display()))
        }
    }
}

/// Returns the page about the results in `folder`; `command` returns the arguments of the command that wrote
/// a run.
pub(super) fn of_folder(
    folder: &Path,
    command: impl FnOnce() -> Vec<String>,
) -> Result<String, CommandError> {
    pages::of_folder(folder, command)
}

/// Writes a page; another one is replaced, any other file is refused.
pub(super) fn write(path: &Path, page: &str) -> Result<(), CommandError> {
    Ok(write_whole(path, KIND, |file| file.write_all(page.as_bytes()))?)
}
