//! The folder of a run's results, which are replaced as a whole.
//!
//! The results are written to a hidden subfolder and moved into place together at the end. The
//! manifest, [`manifest::NAME`], lists them: the next run replaces exactly these files and removes
//! those that it does not write. Other files are left alone, whatever their kind; if one has the name of a planned
//! result, the run is refused before it starts. The folder is locked until the process ends.

mod manifest;

use std::collections::BTreeSet;
use std::fs::{self, File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};

pub(super) use manifest::{
    FRONTIER, FRONTIER_KIND, PAGE, RESULTS, RESULTS_KIND, command_line, command_of, is_complete,
};
use manifest::{Manifest, kind_of, shows_origin};

use super::CommandError;
use crate::files::output::temporary::{Temporary, is_temporary, uninterrupted};
use crate::files::output::{OutputError, copy_attributes, destination, make_folder};
use crate::scenario::Scenario;
use crate::terminal;

/// A folder that is locked for one run.
#[derive(Debug)]
pub(super) struct RunFolder {
    path: PathBuf,
    /// Where the results are written.
    stage: Temporary,
    /// File names of the previous run.
    before: BTreeSet<String>,
    /// Held until the end of the run.
    _lock: Option<File>,
}

impl RunFolder {
    /// Creates and locks the folder for a run that may write files with the planned names.
    pub(super) fn claim(path: &Path, planned: &[String]) -> Result<Self, CommandError> {
        make_folder(path)?;
        let lock = lock(path)?;
        remove_stages(path);
        let before = Manifest::read(path).map(|manifest| manifest.files).unwrap_or_default();
        for name in planned.iter().map(String::as_str).chain([manifest::NAME]) {
            check(path, name, &before)?;
        }
        let stage = Temporary::folder(path)
            .map_err(|error| OutputError::Write { path: path.to_owned(), error })?;
        Ok(Self { path: path.to_owned(), stage, before, _lock: lock })
    }

    /// Returns the folder to write results to, until [`Self::publish`].
    pub(super) fn stage(&self) -> &Path {
        self.stage.path()
    }

    /// Replaces the path of a staged file in an error with its final path.
    pub(super) fn placed(&self, error: CommandError) -> CommandError {
        error.renamed(self.stage(), &self.path)
    }

    /// Moves the results into place and removes those of the previous run. Returns their names, and
    /// a line listing any other files in the folder.
    pub(super) fn publish(
        self,
        scenario: &Scenario,
        seed: u64,
    ) -> Result<(Vec<String>, String), CommandError> {
        let files = names_in(self.stage())
            .map_err(|error| OutputError::Write { path: self.stage().to_owned(), error })?;
        for name in &files {
            check(&self.path, name, &self.before)?;
        }
        let mut manifest = Manifest::new(scenario, seed);
        uninterrupted(|| self.move_into_place(&mut manifest, &files))?;
        let others = others(&self.path, &files);
        Ok((files.into_iter().collect(), others))
    }

    fn move_into_place(
        &self,
        manifest: &mut Manifest,
        files: &BTreeSet<String>,
    ) -> Result<(), OutputError> {
        let place = |name: &str| self.path.join(name);
        let named = |name: &str, error| OutputError::Write { path: self.path.join(name), error };
        let staged = self.stage().join(manifest::NAME);
        let write = |manifest: &Manifest| {
            let written = manifest.write(&staged);
            written
                .and_then(|()| fs::rename(&staged, place(manifest::NAME)))
                .map_err(|error| named(manifest::NAME, error))
        };
        // List both runs' files first, so that the next run knows them all after a power failure.
        manifest.files = files.union(&self.before).cloned().collect();
        write(manifest)?;
        for name in files {
            install(&self.stage().join(name), &place(name))?;
        }
        for name in self.before.difference(files) {
            remove_result(&place(name)).map_err(|error| named(name, error))?;
        }
        // `report` may have made a page of the previous run.
        if !files.contains(PAGE) {
            remove_page(&self.path)?;
        }
        manifest.files.clone_from(files);
        manifest.complete = true;
        write(manifest)
    }
}

/// Locks the folder itself, which leaves no lock file behind.
pub(super) fn lock(path: &Path) -> Result<Option<File>, CommandError> {
    let locked = File::open(path).map_err(TryLockError::Error).and_then(|folder| {
        folder.try_lock()?;
        Ok(folder)
    });
    match locked {
        Ok(folder) => Ok(Some(folder)),
        Err(TryLockError::WouldBlock) => Err(CommandError::folder_in_use(path)),
        Err(TryLockError::Error(error)) => {
            terminal::warning(format_args!(
                "{}: cannot lock the folder ({error}); make sure that no other run writes to it",
                path.display()
            ));
            Ok(None)
        }
    }
}

/// Refuses a name that is taken by something other than a result of the previous run.
fn check(folder: &Path, name: &str, before: &BTreeSet<String>) -> Result<(), OutputError> {
    let path = folder.join(name);
    let Some(kind) = kind_of(name) else { return Ok(()) };
    let target = match fs::symlink_metadata(&path) {
        Ok(found) if found.is_file() => Some(path.clone()),
        Ok(found) if found.is_symlink() => destination(&path)?,
        Ok(_) => None,
        Err(_) => return Ok(()),
    };
    match target {
        None => Err(OutputError::OtherInFolder { path, kind: kind.name }),
        Some(target) if target.exists() && !kind.replaces(&target) => {
            Err(OutputError::OtherInFolder { path, kind: kind.name })
        }
        Some(target) if kind.is_at(&target) && !before.contains(name) && !shows_origin(name) => {
            Err(OutputError::NotOurs { path })
        }
        Some(_) => Ok(()),
    }
}

/// Moves a staged file to its final path; an existing symlink is followed.
fn install(staged: &Path, place: &Path) -> Result<(), OutputError> {
    let failed = |error| OutputError::Write { path: place.to_owned(), error };
    let target = match fs::symlink_metadata(place) {
        Ok(found) if found.is_symlink() => destination(place)?.unwrap_or_else(|| place.to_owned()),
        _ => place.to_owned(),
    };
    if let Ok(before) = fs::metadata(&target) {
        // Best effort: the result is valid even if its owner cannot be restored.
        let _ = copy_attributes(staged, &before);
    }
    match fs::rename(staged, &target) {
        // A link into another file system.
        Err(error) if error.kind() == io::ErrorKind::CrossesDevices => {
            fs::copy(staged, &target).map(drop).map_err(failed)
        }
        moved => moved.map_err(failed),
    }
}

/// Removes the page about results in `folder` that are about to change; any other file of its name is left.
pub(super) fn remove_page(folder: &Path) -> Result<(), OutputError> {
    let path = folder.join(PAGE);
    remove_result(&path).map_err(|error| OutputError::Write { path, error })
}

/// Removes a result of the previous run, if it still is one.
pub(super) fn remove_result(path: &Path) -> io::Result<()> {
    let name = path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
    let is_file = fs::symlink_metadata(path).is_ok_and(|found| found.is_file());
    match kind_of(name) {
        Some(kind) if is_file && kind.replaces(path) => fs::remove_file(path),
        _ => Ok(()),
    }
}

/// Removes the leftovers of killed runs from a locked folder.
fn remove_stages(folder: &Path) {
    for name in names_in(folder).unwrap_or_default().iter().filter(|name| is_temporary(name)) {
        let path = folder.join(name);
        // Best effort: a leftover is hidden and harmless.
        let is_folder = fs::symlink_metadata(&path).is_ok_and(|found| found.is_dir());
        let _ = if is_folder { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    }
}

fn names_in(folder: &Path) -> io::Result<BTreeSet<String>> {
    let names = fs::read_dir(folder)?.map(|entry| Ok(entry?.file_name()));
    names.map(|name| name.map(|name| name.to_string_lossy().into_owned())).collect()
}

/// Returns a line listing the files that are not from this run, so that they are not mistaken for
/// its results.
fn others(folder: &Path, files: &BTreeSet<String>) -> String {
    let mut others = names_in(folder).unwrap_or_default();
    others.retain(|name| !files.contains(name) && name != manifest::NAME && !is_temporary(name));
    match others.len() {
        0 => String::new(),
        1..=12 => {
            let names: Vec<_> = others.iter().map(|name| terminal::one_line(name)).collect();
            format!("Not from this run: {}\n", names.join(", "))
        }
        count => format!("Not from this run: {count} other files\n"),
    }
}

#[cfg(test)]
mod tests;
