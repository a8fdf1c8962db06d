use super::*;
use crate::scenario::PAPER;

/// A separate folder for a test, removed at its end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("run-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn write(&self, name: &str, text: &str) {
        fs::write(self.0.join(name), text).unwrap();
    }

    fn read(&self, name: &str) -> String {
        fs::read_to_string(self.0.join(name)).unwrap()
    }

    fn names(&self) -> Vec<String> {
        names_in(&self.0).unwrap().into_iter().collect()
    }

    /// A run that writes these tables.
    fn run(&self, names: &[&str], content: &str) -> Result<String, CommandError> {
        let planned: Vec<_> = names.iter().map(|&name| name.to_owned()).collect();
        let folder = RunFolder::claim(&self.0, &planned)?;
        for name in names {
            fs::write(folder.stage().join(name), table(content)).unwrap();
        }
        let scenario = Scenario::parse("paper.toml", PAPER).unwrap();
        folder.publish(&scenario, 7).map(|(_, others)| others)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn table(content: &str) -> String {
    format!("agent,what\n1,{content}\n")
}

#[test]
fn a_run_replaces_exactly_the_files_of_the_previous_run() {
    let folder = Folder::new("replaces");
    folder.write("notes.txt", "mine");
    folder.write("extra.csv", &table("mine"));
    assert_eq!(
        folder.run(&["a.csv", "b.csv"], "1").unwrap(),
        "Not from this run: extra.csv, notes.txt\n"
    );
    folder.run(&["b.csv", "c.csv"], "2").unwrap();
    assert_eq!(folder.names(), ["b.csv", "c.csv", "extra.csv", "notes.txt", "run.json"]);
    assert_eq!((folder.read("b.csv"), folder.read("notes.txt")), (table("2"), "mine".into()));
    let manifest = Manifest::read(&folder.0).unwrap();
    assert!(manifest.complete && manifest.files.iter().eq(["b.csv", "c.csv"]));
    let value: serde_json::Value = serde_json::from_str(&folder.read("run.json")).unwrap();
    assert_eq!((&value["scenario"], &value["seed"]), (&"paper".into(), &7.into()));
    assert!(value["command"].is_array() && value["scenario_hash"].is_string());
}

#[test]
fn a_file_that_is_not_a_result_is_refused_before_the_run_and_kept() {
    let folder = Folder::new("foreign");
    folder.write("a.csv", "price list\n");
    let error = folder.run(&["a.csv"], "1").unwrap_err().to_string();
    assert!(error.contains("a.csv: not a table"), "{error}");
    assert_eq!(
        (folder.names(), folder.read("a.csv")),
        (vec!["a.csv".into()], "price list\n".into())
    );
    folder.write("run.json", "{}");
    assert!(folder.run(&["b.csv"], "1").is_err());
    fs::create_dir(folder.0.join("c.csv")).unwrap();
    fs::remove_file(folder.0.join("run.json")).unwrap();
    assert!(folder.run(&["c.csv"], "1").is_err());
    assert_eq!(folder.names(), ["a.csv", "c.csv"]);
}

#[test]
fn a_file_that_only_looks_like_a_result_is_refused_and_kept() {
    let folder = Folder::new("looks");
    let mine = [
        ("a.csv", table("mine")),
        ("a.pdf", "%PDF-1.7 mine".to_owned()),
        ("a.svg", "<svg>mine</svg>".to_owned()),
    ];
    for (name, text) in mine {
        folder.write(name, &text);
        let error = folder.run(&[name], "1").unwrap_err().to_string();
        assert!(error.contains(&format!("{name}: not from a previous run here")), "{error}");
        assert_eq!(folder.read(name), text);
        fs::remove_file(folder.0.join(name)).unwrap();
    }
    // What a run wrote is replaced, unless it is of another kind by now.
    folder.run(&["a.csv"], "1").unwrap();
    folder.run(&["a.csv"], "2").unwrap();
    folder.write("a.csv", "price list\n");
    assert!(folder.run(&["a.csv"], "3").is_err());
    assert_eq!(folder.read("a.csv"), "price list\n");
    // An empty file can be replaced.
    folder.write("a.csv", "");
    folder.run(&["a.csv"], "4").unwrap();
    assert_eq!(folder.read("a.csv"), table("4"));
}

#[test]
fn a_concurrent_run_into_the_same_folder_fails() {
    let folder = Folder::new("lock");
    let first = RunFolder::claim(&folder.0, &[]).unwrap();
    let error = RunFolder::claim(&folder.0, &[]).unwrap_err();
    assert!(error.code() == crate::commands::ErrorCode::FolderInUse, "{error}");
    drop(first);
    assert!(folder.run(&["a.csv"], "1").is_ok());
}

#[test]
fn a_manifest_cannot_affect_other_files() {
    let folder = Folder::new("hostile");
    let inner = Folder(folder.0.join("run"));
    fs::create_dir_all(&inner.0).unwrap();
    folder.write("outside.csv", &table("outside"));
    inner.run(&["a.csv"], "1").unwrap();
    inner.write("mine.csv", "not a result");
    let text = inner.read("run.json");
    let outside = folder.0.join("outside.csv");
    let names =
        format!("\"../outside.csv\", {:?}, \"mine.csv\", \"a.csv\"", outside.to_str().unwrap());
    inner.write("run.json", &text.replace("\"a.csv\"", &names));
    inner.run(&["b.csv"], "2").unwrap();
    assert_eq!(folder.read("outside.csv"), table("outside"));
    assert_eq!(inner.names(), ["b.csv", "mine.csv", "run.json"]);
}

#[test]
fn leftovers_of_a_killed_run_are_removed() {
    let folder = Folder::new("killed");
    fs::create_dir(folder.0.join(".host-sim-1-1.partial")).unwrap();
    folder.write(".host-sim-1-1.partial/a.csv", "half");
    folder.write(".host-sim-1-2.partial", "half");
    folder.run(&["a.csv"], "1").unwrap();
    assert_eq!(folder.names(), ["a.csv", "run.json"]);
}

#[cfg(unix)]
#[test]
fn a_symlinked_result_is_written_through_the_link() {
    let folder = Folder::new("link");
    fs::create_dir(folder.0.join("disk")).unwrap();
    folder.write("disk/real.csv", "");
    std::os::unix::fs::symlink("disk/real.csv", folder.0.join("a.csv")).unwrap();
    folder.run(&["a.csv"], "1").unwrap();
    assert!(fs::symlink_metadata(folder.0.join("a.csv")).unwrap().is_symlink());
    assert_eq!(folder.read("disk/real.csv"), table("1"));
    folder.write("disk/real.csv", "mine");
    folder.write("run.json", &folder.read("run.json").replace("a.csv", "z.csv"));
    assert!(folder.run(&["a.csv"], "2").is_err());
    assert_eq!(folder.read("disk/real.csv"), "mine");
}
