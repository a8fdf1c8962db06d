//! Copies of a scenario in other folders: a copy names the files of the original by their places from
//! where it lies, so that it can be run there. Everything else stays as it is written.

use std::fs::canonicalize;
use std::path::{Component, Path};

use toml_edit::{DocumentMut, Item};

use super::changes::replace;

/// The keys that name a file, relative to the scenario's folder.
const FILES: [[&str; 2]; 1] = [["plant", "file"]];

/// Returns the scenario's text for a copy in the folder `to`; `name` identifies the scenario in errors,
/// as in [`super::ScenarioSource`].
#[must_use]
pub fn copied(name: &str, text: &str, to: &Path) -> String {
    let from = Path::new(name).parent().unwrap_or(Path::new(""));
    with_files(text, |file| {
        let is_relative = Path::new(file).is_relative();
        is_relative.then(|| place_from(&from.join(file), to)).flatten()
    })
}

/// Returns a text that is the same for copies in different folders. Lines keep their numbers.
#[must_use]
pub fn without_files(text: &str) -> String {
    with_files(text, |_| Some(String::new()))
}

/// Replaces the name of each file that has been renamed.
fn with_files(text: &str, renamed: impl Fn(&str) -> Option<String>) -> String {
    let Ok(mut document) = text.parse::<DocumentMut>() else { return text.to_owned() };
    let mut is_changed = false;
    for [table, key] in FILES {
        let table = document.get_mut(table).and_then(Item::as_table_like_mut);
        let Some(item) = table.and_then(|table| table.get_mut(key)) else { continue };
        if let Some(name) = item.as_str().and_then(&renamed) {
            replace(item, &name.into());
            is_changed = true;
        }
    }
    if is_changed { document.to_string() } else { text.to_owned() }
}

/// Returns the path of a file from a folder; an absolute one if they have no root in common, and `None`
/// if one of them does not exist or TOML cannot hold the path.
fn place_from(file: &Path, folder: &Path) -> Option<String> {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let (file, folder) = (canonicalize(file).ok()?, canonicalize(folder).ok()?);
    let file_parts: Vec<Component<'_>> = file.components().collect();
    let folder_parts: Vec<Component<'_>> = folder.components().collect();
    let pairs = file_parts.iter().zip(&folder_parts);
    let common = pairs.take_while(|(one, other)| one == other).count();
    if common == 0 {
        return file.to_str().map(str::to_owned);
    }
    let up = folder_parts[common..].iter().map(|_| Some(".."));
    let down = file_parts[common..].iter().map(|part| part.as_os_str().to_str());
    Some(up.chain(down).collect::<Option<Vec<_>>>()?.join("/"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn a_copy_names_files_from_where_it_lies() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        fs::create_dir_all(path("data")).unwrap();
        fs::create_dir_all(path("out/study")).unwrap();
        fs::write(path("data/a.csv"), "").unwrap();
        let text =
            "# mine\n[plant]\nmodel = 'recording' # measured\n  file =  'data/a.csv' # here\n";
        let name = path("mine.toml").display().to_string();
        let copy = copied(&name, text, &path("out/study"));
        assert_eq!(copy, text.replace("'data/a.csv'", "\"../../data/a.csv\""));
        assert!(path("out/study").join("../../data/a.csv").exists());
        // A copy of the copy.
        let name = path("out/study/scenario.toml").display().to_string();
        let again = copied(&name, &copy, &path("data"));
        assert_eq!(again, text.replace("'data/a.csv'", "\"a.csv\""));
        assert_eq!(without_files(&copy), without_files(text));
        let inline = "plant = { file = \"data/a.csv\" }\n";
        assert_eq!(
            copied(&path("mine.toml").display().to_string(), inline, &path("out")),
            "plant = { file = \"../data/a.csv\" }\n"
        );
        let absolute = format!("[plant]\nfile = '{}'\n", path("data/a.csv").display());
        for text in [&*absolute, "[plant]\nfile = 'none.csv'\n", "[plant]\nmodel = 1\n", "not TOML"]
        {
            assert_eq!(copied(&name, text, folder.path()), text);
        }
    }
}
