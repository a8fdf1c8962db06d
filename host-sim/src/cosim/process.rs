//! A process that ends with the one who holds it, however that one ends.
//!
//! A process that is told to end can end its children, one that is killed cannot. So a small shell
//! stands guard: it reads from a pipe that only this process holds open, and if the pipe ends without
//! a word, it kills the process that it guards and removes its folder.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom, Write};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How long a process may take to end when it is told to.
const GRACE: Duration = Duration::from_secs(1);

/// Bytes of its console that are shown when it has ended.
const TAIL: u64 = 2000;

/// What the guard does: its arguments are the files and folders to be removed.
const GUARD: &str =
    "read -r id || exit 0; read -r end && exit 0; kill -KILL \"$id\"; rm -rf -- \"$@\"";

/// A running process. Dropping it ends it and waits for its end.
#[derive(Debug)]
pub struct Process {
    child: Child,
    guard: Child,
    console: PathBuf,
}

impl Process {
    /// Starts `command`; what it writes to its outputs goes to the file `console`. If this process is
    /// killed, `folders` are removed.
    ///
    /// # Errors
    /// The system's error.
    pub fn start(command: &mut Command, console: &Path, folders: &[&Path]) -> io::Result<Self> {
        let output = File::create(console)?;
        let absolute = folders.iter().map(std::path::absolute).collect::<io::Result<Vec<_>>>()?;
        // The guard is there first, so that there is no time without it.
        let mut guard = Command::new("/bin/sh")
            .args(["-c", GUARD, "sh"])
            .args(absolute)
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()?;
        let child = command
            .stdin(Stdio::null())
            .stdout(output.try_clone()?)
            .stderr(output)
            // Ctrl-C is for us; we end it in good order.
            .process_group(0)
            .spawn();
        let child = match child {
            Ok(child) => child,
            Err(error) => {
                // Its pipe ends before it knows of any process, so it ends, too.
                drop(guard.stdin.take());
                let _ = guard.wait();
                return Err(error);
            }
        };
        let mut process = Self { child, guard, console: console.to_owned() };
        let id = process.id();
        // If this fails, dropping the process ends it.
        process.tell_guard(&format!("{id}\n"))?;
        Ok(process)
    }

    fn tell_guard(&mut self, text: &str) -> io::Result<()> {
        match &mut self.guard.stdin {
            Some(pipe) => pipe.write_all(text.as_bytes()),
            None => Ok(()),
        }
    }

    /// Ends it at once, and waits for its end.
    pub fn kill(&mut self) {
        if self.ended().is_none() {
            self.signal(Signal::SIGKILL);
            let _ = self.child.wait();
        }
    }

    /// Its number.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// How it has ended, if it has.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// How it has ended, if it does so in this time.
    pub fn ends_within(&mut self, time: Duration) -> Option<ExitStatus> {
        let deadline = Instant::now() + time;
        loop {
            let status = self.ended();
            if status.is_some() || Instant::now() >= deadline {
                return status;
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    /// The end of what it has written.
    #[must_use]
    pub fn said(&self) -> String {
        let read = || -> io::Result<Vec<u8>> {
            let mut file = File::open(&self.console)?;
            let length = file.metadata()?.len();
            file.seek(SeekFrom::Start(length.saturating_sub(TAIL)))?;
            let mut text = Vec::new();
            file.take(TAIL).read_to_end(&mut text)?;
            Ok(text)
        };
        String::from_utf8_lossy(&read().unwrap_or_default()).trim().to_owned()
    }

    /// Tells it to end, without waiting.
    pub fn terminate(&mut self) {
        if self.ended().is_none() {
            self.signal(Signal::SIGTERM);
        }
    }

    fn signal(&self, signal: Signal) {
        if let Ok(id) = i32::try_from(self.child.id()) {
            // It may end by itself at this very moment; it is not waited for yet, so the number is
            // still its own.
            let _ = kill(Pid::from_raw(id), signal);
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.terminate();
        if self.ends_within(GRACE).is_none() {
            self.kill();
        }
        let _ = self.tell_guard("end\n");
        drop(self.guard.stdin.take());
        let _ = self.guard.wait();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn start(folder: &Path, script: &str) -> Process {
        Process::start(Command::new("sh").args(["-c", script]), &folder.join("console"), &[])
            .unwrap()
    }

    fn is_there(id: u32) -> bool {
        kill(Pid::from_raw(i32::try_from(id).unwrap()), None).is_ok()
    }

    #[test]
    fn a_process_ends_with_its_holder() {
        let folder = tempfile::tempdir().unwrap();
        let process = start(folder.path(), "exec sleep 1000");
        let id = process.id();
        assert!(is_there(id));
        drop(process);
        assert!(!is_there(id));
    }

    #[test]
    fn a_process_that_does_not_listen_is_killed() {
        let folder = tempfile::tempdir().unwrap();
        let process =
            start(folder.path(), "trap '' TERM; echo ready; while :; do sleep 0.01; done");
        while process.said() != "ready" {
            std::thread::sleep(Duration::from_millis(1));
        }
        let id = process.id();
        drop(process);
        assert!(!is_there(id));
    }

    #[test]
    fn what_it_said_and_how_it_ended_are_known() {
        let folder = tempfile::tempdir().unwrap();
        let mut process = start(folder.path(), "echo fine; echo wrong >&2; exit 3");
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert_eq!((status.code(), process.said().as_str()), (Some(3), "fine\nwrong"));
    }

    #[test]
    fn a_process_whose_holder_is_killed_is_killed_and_its_folder_removed() {
        let folder = tempfile::tempdir().unwrap();
        let guarded = folder.path().join("guarded");
        std::fs::create_dir(&guarded).unwrap();
        let script = "trap '' TERM; while :; do sleep 0.01; done";
        let mut process = Process::start(
            Command::new("sh").args(["-c", script]),
            &guarded.join("console"),
            &[&guarded],
        )
        .unwrap();
        // What the system does for a holder that is killed: its end of the pipe is closed.
        drop(process.guard.stdin.take());
        assert!(process.guard.wait().unwrap().success());
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert!(!status.success() && !guarded.exists(), "{status}");
    }
}
