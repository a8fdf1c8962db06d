//! Runs a task in a process of its own, beside others: much of what tests wait for uses one core.

use std::{
    env,
    fs::{self, File},
    io,
    path::PathBuf,
    process::{Child, Command, Stdio},
    time::Instant,
};

use crate::step::{Failure, giving_way, target_folder, workspace};

/// A running task. Its output goes to a file and is printed when it has ended.
///
/// Dropping it waits for its end.
#[derive(Debug)]
pub(crate) struct Background {
    task: &'static str,
    child: Child,
    log: PathBuf,
    start: Instant,
    ended: bool,
}

impl Background {
    /// Starts `cargo xtask <task>`.
    ///
    /// # Errors
    /// The process cannot be started, or its file cannot be written.
    pub(crate) fn start(task: &'static str, debian: bool) -> Result<Self, Failure> {
        Self::started(task, debian, Command::new)
    }

    /// Starts it at low priority, so that it gives way to everything else.
    ///
    /// # Errors
    /// As [`Self::start`].
    pub(crate) fn start_giving_way(task: &'static str, debian: bool) -> Result<Self, Failure> {
        Self::started(task, debian, |program| giving_way(&Command::new(program)))
    }

    fn started(
        task: &'static str,
        debian: bool,
        command: impl Fn(PathBuf) -> Command,
    ) -> Result<Self, Failure> {
        let log = target_folder().join(format!("xtask-{task}.log"));
        let failed = |error: io::Error| {
            Failure::new(
                format!("{task}, written to {}: {error}", log.display()),
                "check that the file is writable",
            )
        };
        fs::create_dir_all(target_folder()).map_err(failed)?;
        let output = File::create(&log).map_err(failed)?;
        let errors = output.try_clone().map_err(failed)?;
        let mut command = command(env::current_exe().map_err(failed)?);
        command.arg(task).args(debian.then_some("--debian")).current_dir(workspace());
        command.stdin(Stdio::null()).stdout(output).stderr(errors);
        println!("==> {task}: at the same time as the next steps; output in {}", log.display());
        let child = command.spawn().map_err(failed)?;
        Ok(Self { task, child, log, start: Instant::now(), ended: false })
    }

    /// Waits for the end and prints the output; returns `beside`, the outcome of what ran meanwhile.
    ///
    /// # Errors
    /// That of `beside`, or the task failed.
    pub(crate) fn finish_after<T>(self, beside: Result<T, Failure>) -> Result<T, Failure> {
        if let Err(failure) = &beside {
            eprintln!("{failure}\nwaiting for `{}` to finish", self.task);
        }
        match (beside, self.finish()) {
            (Ok(result), ended) => ended.map(|()| result),
            (Err(failure), Ok(())) => Err(failure),
            (Err(failure), Err(own)) => {
                eprintln!("{own}");
                Err(failure)
            }
        }
    }

    /// Waits for the end and prints the output.
    ///
    /// # Errors
    /// The task failed.
    fn finish(mut self) -> Result<(), Failure> {
        self.ended = true;
        let status = self.child.wait();
        print!("{}", String::from_utf8_lossy(&fs::read(&self.log).unwrap_or_default()));
        let success = status.as_ref().is_ok_and(std::process::ExitStatus::success);
        let what = self.task;
        if !success {
            let hint = format!("see its output above, or in {}", self.log.display());
            return Err(Failure::new(format!("{what} failed"), hint));
        }
        println!("<== {what}: ok, {:.1} s", self.start.elapsed().as_secs_f64());
        Ok(())
    }
}

impl Drop for Background {
    fn drop(&mut self) {
        if !self.ended {
            println!("waiting for {}, which is still running", self.task);
            let _ = self.child.wait();
        }
    }
}
