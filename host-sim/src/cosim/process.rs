//! A child process that never outlives this one.
//!
//! A process that is killed cannot end its children. So a small shell guards each child: it reads
//! from a pipe that only this process holds open, and if the pipe closes without a message, it
//! kills the child and removes its folder.
//!
//! The child itself writes its number into that pipe before it becomes the program that was asked for, and
//! holds the pipe open until then. So there is no moment at which it runs and nothing guards it.

use std::collections::VecDeque;
use std::io::{self, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// How long a process may take to exit after SIGTERM.
const GRACE: Duration = Duration::from_secs(1);

/// Length of the console output that is kept. \[byte\]
const TAIL: usize = 2000;

/// Script of the guard; its arguments are the files and folders to remove.
const GUARD: &str = "read -r id || id=; [ \"$id\" = end ] && exit 0; read -r end && exit 0; \
                     [ -n \"$id\" ] && kill -KILL \"$id\"; rm -rf -- \"$@\"";

/// Script of the child, whose standard input is the guard's pipe; its arguments are the command.
const CHILD: &str = "echo \"$$\" >&0; exec \"$@\" </dev/null";

/// A running process. Dropping it ends the process and waits for it.
#[derive(Debug)]
pub struct Process {
    child: Child,
    guard: Child,
    console: Console,
}

impl Process {
    /// Starts `command` and keeps the end of its output. If this process is killed, `folders` are
    /// removed.
    ///
    /// # Errors
    /// The system's error.
    pub fn start(command: &mut Command, folders: &[&Path]) -> io::Result<Self> {
        find_program(command)?;
        let (console, output) = Console::open()?;
        let absolute = folders.iter().map(std::path::absolute).collect::<io::Result<Vec<_>>>()?;
        // Start the guard first, so that the child is always guarded.
        let mut guard = Command::new("/bin/sh")
            .args(["-c", GUARD, "sh"])
            .args(absolute)
            .current_dir("/")
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .process_group(0)
            .spawn()?;
        let pipe =
            guard.stdin.as_ref().map(|pipe| pipe.as_fd().try_clone_to_owned()).transpose()?;
        let mut announced = Command::new("/bin/sh");
        announced.args(["-c", CHILD, "sh"]).arg(command.get_program()).args(command.get_args());
        for (name, value) in command.get_envs() {
            match value {
                Some(value) => announced.env(name, value),
                None => announced.env_remove(name),
            };
        }
        if let Some(folder) = command.get_current_dir() {
            announced.current_dir(folder);
        }
        let child = announced
            .stdin(pipe.map_or(Stdio::null(), Stdio::from))
            .stdout(output.try_clone()?)
            .stderr(output)
            // Not in the terminal's process group: Ctrl-C is handled here.
            .process_group(0)
            .spawn();
        let child = match child {
            Ok(child) => child,
            Err(error) => {
                end_guard(&mut guard);
                return Err(error);
            }
        };
        // The command holds the other copy of the pipe.
        drop(announced);
        Ok(Self { child, guard, console })
    }

    /// Kills the process and waits for it.
    pub fn kill(&mut self) {
        if self.ended().is_none() {
            self.signal(Signal::SIGKILL);
            let _ = self.child.wait();
        }
    }

    /// Returns the process id.
    #[must_use]
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Returns the exit status if the process has exited.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().ok().flatten()
    }

    /// Waits up to `time` for the exit status.
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

    /// Returns the end of its output.
    #[must_use]
    pub fn output(&mut self) -> String {
        let ended = self.ended().is_some();
        self.console.tail(ended)
    }

    /// Sends SIGTERM, without waiting.
    pub fn terminate(&mut self) {
        if self.ended().is_none() {
            self.signal(Signal::SIGTERM);
        }
    }

    fn signal(&self, signal: Signal) {
        if let Ok(id) = i32::try_from(self.child.id()) {
            // It may just have exited; but it has not been waited for, so the id is still valid.
            let _ = kill(Pid::from_raw(id), signal);
        }
    }
}

/// Keeps the end of a process's output, in bounded memory.
#[derive(Debug)]
struct Console {
    tail: Arc<Mutex<VecDeque<u8>>>,
    reader: JoinHandle<()>,
}

impl Console {
    /// Creates a console, and the pipe for the process to write to.
    fn open() -> io::Result<(Self, io::PipeWriter)> {
        let (mut input, output) = io::pipe()?;
        let tail = Arc::new(Mutex::new(VecDeque::new()));
        let kept = Arc::clone(&tail);
        let reader = std::thread::Builder::new().name("console".to_owned()).spawn(move || {
            let mut buffer = [0; 4096];
            while let Ok(length @ 1..) = input.read(&mut buffer) {
                let mut tail = kept.lock().unwrap_or_else(PoisonError::into_inner);
                tail.extend(&buffer[..length]);
                let excess = tail.len().saturating_sub(TAIL);
                tail.drain(..excess);
            }
        })?;
        Ok((Self { tail, reader }, output))
    }

    /// Returns the end of the output; complete if the process has `ended`.
    fn tail(&self, ended: bool) -> String {
        // A child of the process may keep its output open for longer.
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
        end_guard(&mut self.guard);
    }
}

/// Ends a guard without anything being killed or removed.
fn end_guard(guard: &mut Child) {
    if let Some(mut pipe) = guard.stdin.take() {
        let _ = pipe.write_all(b"end\n");
    }
    let _ = guard.wait();
}

/// Checks that there is a program to start, because the shell that starts it only reports a failure in
/// its output.
fn find_program(command: &Command) -> io::Result<()> {
    let program = Path::new(command.get_program());
    let is_program = |path: &Path| {
        let data = path.metadata().ok()?;
        (data.is_file() && data.permissions().mode() & 0o111 != 0).then_some(())
    };
    let found = if program.components().count() > 1 {
        let folder = command.get_current_dir().unwrap_or(Path::new(""));
        is_program(&folder.join(program))
    } else {
        let own = command.get_envs().find(|(name, _)| *name == "PATH");
        let path = own.map_or_else(|| std::env::var_os("PATH"), |(_, path)| path.map(Into::into));
        std::env::split_paths(&path.unwrap_or_default())
            .find_map(|folder| is_program(&folder.join(program)))
    };
    found.ok_or_else(|| io::Error::from(io::ErrorKind::NotFound))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn start(script: &str) -> Process {
        Process::start(Command::new("sh").args(["-c", script]), &[]).unwrap()
    }

    fn exists(id: u32) -> bool {
        kill(Pid::from_raw(i32::try_from(id).unwrap()), None).is_ok()
    }

    #[test]
    fn dropping_a_process_ends_it() {
        let process = start("exec sleep 1000");
        let id = process.id();
        assert!(exists(id));
        drop(process);
        assert!(!exists(id));
    }

    #[test]
    fn a_process_that_ignores_sigterm_is_killed() {
        let mut process = start("trap '' TERM; echo ready; while :; do sleep 0.01; done");
        while process.output() != "ready" {
            std::thread::sleep(Duration::from_millis(1));
        }
        let id = process.id();
        drop(process);
        assert!(!exists(id));
    }

    #[test]
    fn output_and_exit_status_are_reported() {
        let mut process = start("echo fine; echo wrong >&2; exit 3");
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert_eq!((status.code(), process.output().as_str()), (Some(3), "fine\nwrong"));
    }

    #[test]
    fn a_program_that_is_missing_is_an_error_at_once() {
        for program in ["no-such-program", "/no/such/program", "/etc/passwd"] {
            let error = Process::start(&mut Command::new(program), &[]).unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::NotFound, "{program}");
        }
    }

    #[test]
    fn only_the_end_of_long_output_is_kept() {
        let script = "head -c 10000000 /dev/zero | tr '\\0' x; echo; echo the end";
        let mut process = start(script);
        assert!(process.ends_within(Duration::from_secs(60)).unwrap().success());
        let output = process.output();
        assert!(output.ends_with("x\nthe end") && output.len() < TAIL, "{} bytes", output.len());
    }

    #[test]
    fn the_guard_kills_the_process_and_removes_its_folder() {
        let folder = tempfile::tempdir().unwrap();
        let guarded = folder.path().join("guarded");
        std::fs::create_dir(&guarded).unwrap();
        let script = "trap '' TERM; while :; do sleep 0.01; done";
        let mut process =
            Process::start(Command::new("sh").args(["-c", script]), &[&guarded]).unwrap();
        // When this process is killed, the system closes its end of the pipe.
        drop(process.guard.stdin.take());
        assert!(process.guard.wait().unwrap().success());
        let status = process.ends_within(Duration::from_secs(10)).unwrap();
        assert!(!status.success() && !guarded.exists(), "{status}");
    }
}
