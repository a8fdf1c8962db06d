//! Long work alongside Python: the interpreter is free meanwhile, Ctrl-C ends the work, and progress is told on
//! the thread that waits.
//!
//! The work runs in a pool of threads of its own, so several threads of Python can do this at once. The waiting
//! thread looks after signals and progress twenty times a second.

use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::time::Duration;

use host_sim::engine::Progress;
use host_sim::error::{ErrorCode, ErrorReport};
use pyo3::prelude::*;

use crate::errors::{OrRaise, usage};

/// Interval at which signals and progress are checked.
const LOOK: Duration = Duration::from_millis(50);

/// Largest number of threads, as on the command line.
const THREADS_MAX: u16 = 1024;

/// How far the work is.
#[derive(Debug, Default)]
pub(crate) struct Watch {
    done: AtomicU64,
    total: AtomicU64,
    is_stopped: AtomicBool,
}

impl Watch {
    /// Reports that `done` of `total` parts are done.
    pub(crate) fn reached(&self, done: u64, total: u64) {
        self.total.store(total, Ordering::Relaxed);
        self.done.store(done, Ordering::Relaxed);
    }

    /// Whether the work is to end.
    pub(crate) fn is_stopped(&self) -> bool {
        self.is_stopped.load(Ordering::Relaxed)
    }
}

impl Progress for Watch {
    fn step(&self, tick: u64, steps: u64) {
        self.reached(tick, steps);
    }

    fn is_stopped(&self) -> bool {
        Watch::is_stopped(self)
    }
}

/// Does `work` on this many threads, 0 for one per core. `progress` is what the caller passed for it: `None` for a
/// bar in notebooks, a truth value, or a callable that gets the parts done and their total.
pub(crate) fn attended<R: Send>(
    py: Python<'_>,
    threads: u16,
    progress: Option<&Bound<'_, PyAny>>,
    work: impl FnOnce(&Watch) -> R + Send,
) -> PyResult<R> {
    if threads > THREADS_MAX {
        let text = format!("threads is {threads}; give 0 to {THREADS_MAX}");
        return Err(usage(py, text));
    }
    let follower = py
        .import("distributed_observer._progress")?
        .call_method1("follower", (progress,))?
        .unbind();
    let follower = (!follower.is_none(py)).then_some(follower);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build();
    let pool = pool
        .map_err(|_| {
            let text = format!("cannot start {threads} threads; choose fewer with threads=");
            ErrorReport::new(ErrorCode::Threads, text)
        })
        .or_raise(py)?;
    let (watch, result) = (Watch::default(), Mutex::new(None));
    let looked = py.detach(|| {
        let (sender, receiver) = channel();
        pool.in_place_scope(|scope| {
            let (watch, result) = (&watch, &result);
            scope.spawn(move |_| {
                let done = work(watch);
                if let Ok(mut result) = result.lock() {
                    *result = Some(done);
                }
                // The receiver is there until the scope ends.
                let _ = sender.send(());
            });
            loop {
                match receiver.recv_timeout(LOOK) {
                    Err(RecvTimeoutError::Timeout) => {}
                    Ok(()) | Err(RecvTimeoutError::Disconnected) => return Ok(()),
                }
                let looked = Python::attach(|py| look(py, watch, follower.as_ref()));
                if let Err(error) = looked {
                    watch.is_stopped.store(true, Ordering::Relaxed);
                    return Err(error);
                }
            }
        })
    });
    if let Some(follower) = &follower {
        let told = if looked.is_ok() { tell(py, &watch, follower) } else { Ok(()) };
        follower.call_method0(py, "close")?;
        told?;
    }
    looked?;
    let result = result.into_inner().ok().flatten();
    // Without a result the work has panicked, and the scope has passed that on.
    result.ok_or_else(|| usage(py, "the work ended without a result; please report this"))
}

fn look(py: Python<'_>, watch: &Watch, follower: Option<&Py<PyAny>>) -> PyResult<()> {
    py.check_signals()?;
    follower.map_or(Ok(()), |follower| tell(py, watch, follower))
}

fn tell(py: Python<'_>, watch: &Watch, follower: &Py<PyAny>) -> PyResult<()> {
    let (done, total) = (watch.done.load(Ordering::Relaxed), watch.total.load(Ordering::Relaxed));
    if total > 0 {
        follower.call_method1(py, "update", (done.min(total), total))?;
    }
    Ok(())
}
