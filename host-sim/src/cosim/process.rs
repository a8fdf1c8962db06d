//! A process that ends with the one who holds it, however that one ends.
//!
//! A process that is told to end can end its children, one that is killed cannot. So a small shell
//! stands guard: it reads from a pipe that only this process holds open, and if the pipe ends without
//! a word, it kills the process that it guards and removes its folder.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How long a process may take to end when it is told to.
const GRACE: Duration = Duration::from_secs(1);

/// Bytes of its console that are shown when it has ended.
const TAIL: usize = 2000;

/// What the guard does: its arguments are the files and folders to be removed.
const GUARD: &str =
    "read -r id || exit 0; read -r end && exit 0; kill -KILL \"$id\"; rm -rf -- \"$@\"";

/// A running process. Dropping it ends it and waits for its end.
#[derive(Debug)]
pub struct Process {
    child: Child,
    guard: Child,
    console: Console,
}

impl Process {
    /// Starts `command`; of what it writes to its outputs, the end is kept. If this process is
    /// killed, `folders` are removed.
    ///
    /// # Errors
    /// The system's error.
    pub fn start(command: &mut Command, folders: &[&Path]) -> io::Result<Self> {
        let (console, output) = Console::open()?;
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
        let mut process = Self { child, guard, console };
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
    pub fn said(&mut self) -> String {
        let ended = self.ended().is_some();
        self.console.tail(ended)
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

/// The end of what a process writes to its outputs: what is before it is forgotten, however much
/// it is.
#[derive(Debug)]
struct Console {
    tail: Arc<Mutex<VecDeque<u8>>>,
    reader: JoinHandle<()>,
}

impl Console {
    /// The console, and where the process is to write.
    fn open() -> io::Result<(Self, io::PipeWriter)> {
        let (mut input, output) = io::pipe()?;
        let tail = Arc::new(Mutex::new(VecDeque::new()));
        let kept = Arc::clone(&tail);
        let reader = std::thread::Builder::new().name("console".to_owned()).spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(length @ 1..) = input.read(&mut buffer) {
                let mut tail = kept.lock().unwrap_or_else(PoisonError::into_inner);
                tail.extend(&buffer[..length]);
                let forgotten = tail.len().saturating_sub(TAIL);
                tail.drain(..forgotten);
            }
        })?;
        Ok((Self { tail, reader }, output))
    }

    /// The end; all of it, if the process has `ended`.
    fn tail(&self, ended: bool) -> String {
        // A child of the process may hold its outputs open for longer.
        let deadline = Instant::now() + GRACE;
        while ended && !self.reader.is_finished() && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(1));
        }
        let mut tail = self.tail.lock().unwrap_or_else(PoisonError::into_inner);
        String::from_utf8_lossy(tail.make_contiguous()).trim().to_owned()
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

    fn start(script: &str) -> Process {
        Process::start(Command::new("sh").args(["-c", script]), &[]).unwrap()
    }

    fn is_there(id: u32) -> bool {
        kill(Pid::from_raw(i32::try_from(id).unwrap()), None).is_ok()
    }

    #[test]
    fn a_process_ends_with_its_holder() {
        let process = start("exec sleep 1000");
        let id = process.id();
        assert!(is_there(id));
        drop(process);
        assert!(!is_there(id));
    }

    #[test]
    fn a_process_that_does_not_listen_is_killed() {
        let mut process = start("trap '' TERM; echo ready; while :; do sleep 0.01; done");
        while process.said() != "ready" {
            std::thread::sleep(Duration::from_millis(1));
        }
        let id = process.id();
        drop(process);
        assert!(!is_there(id));
    }

    #[test]
    fn what_it_said_and_how_it_ended_are_known() {
        let mut process = start("echo fine; echo wrong >&2; exit 3");
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert_eq!((status.code(), process.said().as_str()), (Some(3), "fine\nwrong"));
    }

    #[test]
    fn of_endless_output_only_the_end_is_kept() {
        let script = "head -c 10000000 /dev/zero | tr '\\0' x; echo; echo the end";
        let mut process = start(script);
        assert!(process.ends_within(Duration::from_secs(60)).unwrap().success());
        let said = process.said();
        assert!(said.ends_with("x\nthe end") && said.len() < TAIL, "{} bytes", said.len());
    }

    #[test]
    fn a_process_whose_holder_is_killed_is_killed_and_its_folder_removed() {
        let folder = tempfile::tempdir().unwrap();
        let guarded = folder.path().join("guarded");
        std::fs::create_dir(&guarded).unwrap();
        let script = "trap '' TERM; while :; do sleep 0.01; done";
        let mut process =
            Process::start(Command::new("sh").args(["-c", script]), &[&guarded]).unwrap();
        // What the system does for a holder that is killed: its end of the pipe is closed.
        drop(process.guard.stdin.take());
        assert!(process.guard.wait().unwrap().success());
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert!(!status.success() && !guarded.exists(), "{status}");
    }
}
