//! The firmware in QEMU, with its flash in a file that survives resets and kills.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use agent_core::store::Slot;
use host_sim::cosim::qemu::{FLASH_LENGTH, FLASH_ORIGIN, MACHINE, PROGRAM};
use host_sim::image::{ERASED, Image};
use host_sim::packages::PackageBytes;
use host_sim::service::Line;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use tempfile::TempDir;

use super::peer::DEADLINE;
use crate::cosim::loop_node::region;

/// A running emulator.
pub(super) struct Emulator {
    process: Child,
    firmware: PathBuf,
    flash: Vec<u8>,
    /// Removed at the end.
    folder: TempDir,
}

impl Emulator {
    /// Starts an emulator with this package in its flash.
    pub(super) fn start(firmware: &Path, package: &PackageBytes) -> Result<(Self, Line), String> {
        let folder = tempfile::Builder::new().prefix("soak-").tempdir().map_err(said)?;
        let region = region();
        let file = File::create(folder.path().join("flash")).map_err(said)?;
        file.set_len(FLASH_LENGTH).map_err(said)?;
        let mut flash = vec![ERASED; region.length as usize];
        for segment in Image::of_package(&region, Slot::A, package).map_err(said)?.segments() {
            let place = (segment.address - region.origin) as usize;
            flash[place..place + segment.bytes.len()].copy_from_slice(&segment.bytes);
        }
        file.write_all_at(&flash, offset()).map_err(said)?;
        for pipe in ["in", "out"] {
            mkfifo(&folder.path().join(pipe), Mode::S_IRUSR | Mode::S_IWUSR).map_err(said)?;
        }
        let mut process = started(firmware, folder.path())?;
        let line = connected(&mut process, folder.path())?;
        Ok((Self { process, firmware: firmware.to_owned(), flash, folder }, line))
    }

    /// Kills the emulator, and starts another with the contents of its flash.
    pub(super) fn cycle_power(&mut self) -> Result<Line, String> {
        self.process.kill().map_err(said)?;
        self.process.wait().map_err(said)?;
        let file = File::open(self.folder.path().join("flash")).map_err(said)?;
        file.read_exact_at(&mut self.flash, offset()).map_err(said)?;
        self.process = started(&self.firmware, self.folder.path())?;
        connected(&mut self.process, self.folder.path())
    }

    pub(super) fn flash(&self) -> &[u8] {
        &self.flash
    }
}

impl Drop for Emulator {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Returns the offset of the weights region in the file.
fn offset() -> u64 {
    u64::from(region().origin - FLASH_ORIGIN)
}

fn started(firmware: &Path, folder: &Path) -> Result<Child, String> {
    let path = |name: &str| folder.join(name).display().to_string().replace(',', ",,");
    let mut command = Command::new(PROGRAM);
    command
        .args(["-M", &format!("{MACHINE},memory-backend=flash"), "-object"])
        .arg(format!(
            "memory-backend-file,id=flash,size={FLASH_LENGTH},mem-path={},share=on",
            path("flash")
        ))
        .args(["-nographic", "-monitor", "none", "-serial", "none", "-semihosting-config"])
        .arg(format!(
            "enable=on,target=native,arg=node,arg=fifo,arg={},arg={}",
            path("in"),
            path("out")
        ))
        .arg("-kernel")
        .arg(firmware)
        .stdin(Stdio::null())
        .stdout(Stdio::null());
    command.spawn().map_err(|error| format!("{PROGRAM} cannot be started: {error}"))
}

fn connected(process: &mut Child, folder: &Path) -> Result<Line, String> {
    let alive = || matches!(process.try_wait(), Ok(None));
    Line::over_pipes(
        &folder.join("in"),
        &folder.join("out"),
        DEADLINE,
        alive,
        &std::sync::Arc::default(),
    )
    .map_err(|error| {
        // The process has not been handed over yet, so it is killed here.
        let _ = process.kill();
        let _ = process.wait();
        format!("the emulator did not open its pipes: {error}")
    })
}

fn said(error: impl std::fmt::Display) -> String {
    error.to_string()
}
