use std::io::ErrorKind;

use super::*;

/// Text that starts with "test" is of the kind used in these tests.
const KIND: FileKind = FileKind { name: "a test", recognises: |bytes| bytes.starts_with(b"test") };

fn write(path: &Path, text: &str) -> Result<(), OutputError> {
    write_whole(path, KIND, |file| file.write_all(text.as_bytes()))
}

fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).unwrap();
    let mut names: Vec<_> =
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

/// A separate folder for a test, removed at its end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("output-{name}-{}", std::process::id()));
        fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn failed_write_keeps_the_old_file() {
    let folder = Folder::new("failed");
    let path = folder.path("made/on/the/way/result");
    write(&path, "test: whole").unwrap();
    let failed = write_whole(&path, KIND, |file| {
        file.write_all(b"test: half")?;
        Err(io::Error::other("the power went"))
    });
    let message = failed.unwrap_err().to_string();
    assert!(message.contains("result") && message.contains("the power went"), "{message}");
    assert_eq!(fs::read(&path).unwrap(), b"test: whole");
    assert_eq!(names(path.parent().unwrap()), ["result"], "temporary file left behind");
}

#[test]
fn dropping_a_prepared_file_leaves_nothing() {
    let folder = Folder::new("prepared");
    let output = OutputFile::prepare(&folder.path("a/b/result"), KIND).unwrap();
    assert_eq!(names(&folder.path("a/b")).len(), 1);
    drop(output);
    assert!(names(&folder.0).is_empty());
}

#[test]
fn replaces_only_empty_files_and_its_own_kind() {
    let folder = Folder::new("kinds");
    let path = folder.path("result");
    for (before, replaced) in [("", true), ("test: old", true), ("mine", false)] {
        fs::write(&path, before).unwrap();
        let written = write(&path, "test: new");
        assert_eq!(written.is_ok(), replaced, "{before}");
        if let Err(error) = written {
            assert!(error.is_refusal() && error.to_string().contains("not a test"), "{error}");
            assert_eq!(fs::read(&path).unwrap(), before.as_bytes());
        } else {
            assert_eq!(fs::read(&path).unwrap(), b"test: new");
        }
    }
    let error = write(&folder.0, "test").unwrap_err();
    assert!(matches!(error, OutputError::NotAFile { what: "a folder", .. }), "{error}");
    assert_eq!(names(&folder.0), ["result"]);
}

#[test]
fn a_file_in_place_of_a_folder_is_named() {
    let folder = Folder::new("file-for-folder");
    let file = folder.path("results");
    fs::write(&file, "mine").unwrap();
    let [inner, deep] = ["inner", "inner/deep"].map(|path| file.join(path));
    for error in [
        make_folder(&file).unwrap_err(),
        make_folder(&deep).unwrap_err(),
        write(&inner, "test").unwrap_err(),
        write(&deep, "test").unwrap_err(),
    ] {
        let text = error.to_string();
        assert!(text.ends_with("results is not a folder; choose another one"), "{text}");
    }
    assert_eq!(fs::read(&file).unwrap(), b"mine");
}

#[test]
fn keeps_a_file_that_appears_after_prepare() {
    let folder = Folder::new("meanwhile");
    let path = folder.path("result");
    let output = OutputFile::prepare(&path, KIND).unwrap();
    fs::write(&path, "mine").unwrap();
    let error = output.write(|file| file.write_all(b"test")).unwrap_err();
    assert!(error.is_refusal(), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"mine");
    assert_eq!(names(&folder.0), ["result"]);
}

#[test]
fn rejects_a_path_without_a_file_name() {
    assert!(matches!(write(Path::new("/"), ""), Err(OutputError::NotAFile { .. })));
    let error = write(Path::new(""), "").unwrap_err();
    assert!(
        matches!(&error, OutputError::Write { error, .. } if error.kind() == ErrorKind::InvalidInput),
        "{error}"
    );
}

#[test]
fn recognises_tables_and_pictures() {
    for (kind, own, other) in [
        (FileKind::TABLE, &b"agent,rmse [state unit]\n1,0.5\n"[..], &b"name,price\n"[..]),
        (FileKind::TABLE, b"time [s],x1 [state unit]\n", b"time [s]\n"),
        (FileKind::TABLE, b"agent,sequence", b"agents of the company\n"),
        (FileKind::SVG, b"<svg xmlns=''></svg>", b"<html><svg></svg></html>"),
        (FileKind::SVG, b"<?xml version='1.0'?>\n<svg/>", b"<?xml version='1.0'?>\n<note/>"),
        (FileKind::PNG, b"\x89PNG\r\n\x1a\n....", b"GIF89a"),
    ] {
        assert!((kind.recognises)(own) && !(kind.recognises)(other), "{kind:?}");
    }
    assert!(!(FileKind::NEW.recognises)(b"anything"));
}

#[cfg(unix)]
mod unix {
    use std::io::Read;
    use std::os::unix::fs::{FileTypeExt, PermissionsExt, symlink};
    use std::os::unix::net::UnixListener;

    use super::*;

    #[test]
    fn follows_links_and_keeps_modes() {
        let folder = Folder::new("links");
        fs::create_dir(folder.path("versions")).unwrap();
        let target = folder.path("versions/3");
        fs::write(&target, "test: old").unwrap();
        fs::set_permissions(&target, fs::Permissions::from_mode(0o640)).unwrap();
        symlink("versions/3", folder.path("current")).unwrap();
        symlink("current", folder.path("link-to-link")).unwrap();
        write(&folder.path("link-to-link"), "test: new").unwrap();
        assert_eq!(fs::read(&target).unwrap(), b"test: new");
        assert_eq!(fs::metadata(&target).unwrap().permissions().mode() & 0o7777, 0o640);
        for link in ["current", "link-to-link"] {
            assert!(fs::symlink_metadata(folder.path(link)).unwrap().is_symlink(), "{link}");
        }
        assert_eq!(names(&folder.path("versions")), ["3"]);

        symlink("new/4", folder.path("dangling")).unwrap();
        write(&folder.path("dangling"), "test: made").unwrap();
        assert_eq!(fs::read(folder.path("new/4")).unwrap(), b"test: made");
        assert!(fs::symlink_metadata(folder.path("dangling")).unwrap().is_symlink());

        symlink("circle", folder.path("circle")).unwrap();
        assert!(write(&folder.path("circle"), "test").is_err());
    }

    #[test]
    fn writes_to_pipes_and_rejects_sockets() {
        let folder = Folder::new("pipes");
        let pipe = folder.path("pipe");
        nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
        let error = write(&pipe, "test").unwrap_err();
        assert!(matches!(error, OutputError::NoReader { .. }), "{error}");
        let reader = std::thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut text = String::new();
                File::open(pipe).unwrap().read_to_string(&mut text).unwrap();
                text
            }
        });
        // More than a pipe can hold, so that writing waits for the reader.
        let long = "test ".repeat(100_000);
        write(&pipe, &long).unwrap();
        assert_eq!(reader.join().unwrap(), long);
        assert!(fs::symlink_metadata(&pipe).unwrap().file_type().is_fifo());

        let _listener = UnixListener::bind(folder.path("socket")).unwrap();
        let error = write(&folder.path("socket"), "test").unwrap_err();
        assert!(error.to_string().contains("is a socket"), "{error}");
        assert_eq!(names(&folder.0), ["pipe", "socket"]);
    }

    #[test]
    fn writes_to_devices() {
        write(Path::new("/dev/null"), "test").unwrap();
        assert!(fs::metadata("/dev/null").unwrap().file_type().is_char_device());
        #[cfg(target_os = "linux")]
        {
            let error = write(Path::new("/dev/full"), "test").unwrap_err();
            assert!(!error.is_refusal() && error.to_string().contains("disk is not full"));
            let error = write(Path::new("/proc/no/x"), "test").unwrap_err();
            assert!(matches!(error, OutputError::Write { .. }), "{error}");
        }
    }
}
