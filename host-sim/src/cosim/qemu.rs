//! Emulated nodes: one QEMU process each, with the flash in a file.
//!
//! The firmware keeps its weights in the board's memory at [`FLASH_ORIGIN`]. That memory is backed
//! by a file, so its contents survive resets, as in a real flash. Initially the file is erased,
//! with the start package in slot A.
//!
//! Semihosting arguments select the node's channel: `node fifo IN OUT` or `node uart`.

use std::fs::File;
use std::io::{self, ErrorKind};
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::{Duration, Instant};

use agent_core::package::signature::PublicKey;
use agent_core::store::Slot;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use tempfile::TempDir;

use super::board::Board;
use super::fault::Fault;
use super::process::Process;
use super::stopped_node::package_in_use;
use crate::image::{ERASED, Image, RamFlash};
use crate::memory_map::WeightsRegion;
use crate::packages::PackageBytes;
use crate::service::{Line, LineError};
use crate::stop::Stop;

/// Name of the emulator program.
pub const PROGRAM: &str = "qemu-system-arm";

/// The emulated board.
pub const MACHINE: &str = "mps2-an386";

/// Start of the memory backed by the file.
pub const FLASH_ORIGIN: u32 = 0x2100_0000;

/// Length of that memory on the board. \[byte\]
pub const FLASH_LENGTH: u64 = 16 << 20;

/// Connection between host and node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Channel {
    /// Two named pipes, which the node opens through semihosting.
    Pipes,
    /// The board's serial line, connected to a socket.
    Uart,
}

/// Starts emulated nodes.
#[derive(Clone, Debug)]
pub struct Qemu {
    /// The emulator: a path, or a name to find on `PATH`.
    pub program: PathBuf,
    /// The firmware, an ELF file.
    pub firmware: PathBuf,
    /// The firmware's weights region.
    pub region: WeightsRegion,
    /// Timeout for starting.
    pub timeout: Duration,
    /// Ends every wait for a node.
    pub stop: Arc<Stop>,
}

impl Qemu {
    /// Starts a node with `package` in its flash, which is removed with the node.
    ///
    /// # Errors
    /// See [`Fault`]; nothing is then left behind.
    pub fn start(&self, channel: Channel, package: &PackageBytes) -> Result<Board, Fault> {
        let folder = Self::folder()?;
        let flash = folder.path().join("flash");
        self.write_flash(&flash, Some(package))?;
        self.start_in(channel, folder, &flash, false, None)
    }

    /// Starts a node with the flash in this file. A missing file is created, with `package` in it;
    /// an existing one is used as it is. If this process is killed, the folder `temporary` is
    /// removed.
    ///
    /// # Errors
    /// See [`Fault`]; nothing but the flash is then left behind.
    pub fn start_on(
        &self,
        channel: Channel,
        package: Option<&PackageBytes>,
        flash: &Path,
        temporary: Option<&Path>,
    ) -> Result<Board, Fault> {
        let folder = Self::folder()?;
        let persistent = flash.exists();
        if !persistent {
            self.write_flash(flash, package)?;
        }
        self.start_in(channel, folder, flash, persistent, temporary)
    }

    fn folder() -> Result<TempDir, Fault> {
        let folder = tempfile::Builder::new().prefix("host-sim-node-").tempdir();
        folder.map_err(|error| {
            let place = std::env::temp_dir();
            let hint = "free some disk space, or set TMPDIR to a writable folder";
            Fault::Start(format!("{}: {error}; {hint}", place.display()))
        })
    }

    fn start_in(
        &self,
        channel: Channel,
        folder: TempDir,
        flash: &Path,
        persistent: bool,
        temporary: Option<&Path>,
    ) -> Result<Board, Fault> {
        let mut command = Command::new(&self.program);
        command
            .args(["-M", &format!("{MACHINE},memory-backend=flash"), "-object"])
            .arg(format!(
                "memory-backend-file,id=flash,size={FLASH_LENGTH},mem-path={},share=on",
                option(flash)
            ))
            .args(["-nographic", "-monitor", "none", "-kernel"])
            .arg(&self.firmware);
        let removed: Vec<_> = [Some(folder.path()), temporary].into_iter().flatten().collect();
        match channel {
            Channel::Pipes => self.start_with_pipes(command, &folder, &removed, persistent),
            Channel::Uart => self.start_with_uart(command, &folder, &removed, persistent),
        }
        .map(|(board, process)| board.with_process(process, folder))
    }

    fn start_with_pipes(
        &self,
        mut command: Command,
        folder: &TempDir,
        removed: &[&Path],
        persistent: bool,
    ) -> Result<(Board, Process), Fault> {
        let (input, output) = (folder.path().join("in"), folder.path().join("out"));
        for pipe in [&input, &output] {
            mkfifo(pipe, Mode::S_IRUSR | Mode::S_IWUSR).map_err(|e| Fault::System(e.into()))?;
        }
        command.args(["-serial", "none", "-semihosting-config"]).arg(format!(
            "enable=on,target=native,arg=node,arg=fifo,arg={},arg={}",
            option(&input),
            option(&output)
        ));
        let mut process = self.spawn(&mut command, removed)?;
        let alive = || process.ended().is_none();
        match Line::over_pipes(&input, &output, self.timeout, alive, &self.stop) {
            Ok(line) => Ok((Board::new(line, "qemu", persistent), process)),
            Err(LineError::Silent) => Err(self.not_started(&mut process)),
            Err(LineError::Interrupted) => Err(Fault::Interrupted),
            Err(LineError::System(error)) => Err(Fault::System(error)),
            Err(LineError::Closed) => Err(Fault::Closed),
        }
    }

    fn start_with_uart(
        &self,
        mut command: Command,
        folder: &TempDir,
        removed: &[&Path],
        persistent: bool,
    ) -> Result<(Board, Process), Fault> {
        // QEMU connects to this socket before it starts, so that no byte is lost.
        let path = folder.path().join("uart");
        let listener = UnixListener::bind(&path).map_err(Fault::System)?;
        listener.set_nonblocking(true).map_err(Fault::System)?;
        command.arg("-serial").arg(format!("unix:{}", option(&path)));
        command.args(["-semihosting-config", "enable=on,target=native,arg=node,arg=uart"]);
        let mut process = self.spawn(&mut command, removed)?;
        let deadline = Instant::now() + self.timeout;
        loop {
            match listener.accept() {
                Ok((socket, _)) => {
                    let line = Line::over_socket(socket, &self.stop).map_err(Fault::System)?;
                    return Ok((Board::new(line, "qemu-uart", persistent), process));
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {}
                Err(error) => return Err(Fault::System(error)),
            }
            if self.stop.is_requested() {
                return Err(Fault::Interrupted);
            }
            if process.ended().is_some() || Instant::now() >= deadline {
                return Err(self.not_started(&mut process));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn spawn(&self, command: &mut Command, removed: &[&Path]) -> Result<Process, Fault> {
        Process::start(command, removed).map_err(|error| {
            let program = self.program.display();
            Fault::Start(if error.kind() == ErrorKind::NotFound {
                format!(
                    "{program}: program not found; install QEMU (on Debian `apt-get install \
                     --no-install-recommends qemu-system-arm`; `cargo xtask test` does so if \
                     permitted), or give its path with --qemu PATH"
                )
            } else {
                format!("{program}: cannot start: {error}; give another program with --qemu PATH")
            })
        })
    }

    fn not_started(&self, process: &mut Process) -> Fault {
        match process.ended() {
            Some(status) => Fault::Ended { status: status.to_string(), output: process.output() },
            None => Fault::Silent {
                expected: "connection",
                seconds: self.timeout.as_secs_f64(),
                damaged: 0,
            },
        }
    }

    /// Returns the package that a node with the flash in this file would use after a reset, if any.
    /// With `key`, it must be signed with the private half.
    ///
    /// # Errors
    /// The system's error, or that the file is not the flash of this board.
    pub fn package_in(
        &self,
        flash: &Path,
        key: Option<&PublicKey>,
    ) -> io::Result<Option<PackageBytes>> {
        let file = File::open(flash)?;
        let wrong = |what: &str| io::Error::new(ErrorKind::InvalidData, what.to_owned());
        if file.metadata()?.len() != FLASH_LENGTH {
            return Err(wrong("not the flash of an emulated node"));
        }
        let origin = u64::from(self.region.origin).checked_sub(FLASH_ORIGIN.into());
        let origin = origin.filter(|_| self.region.end() <= u64::from(FLASH_ORIGIN) + FLASH_LENGTH);
        let origin =
            origin.ok_or_else(|| wrong("the memory map places WEIGHTS outside this flash"))?;
        let mut bytes = vec![0; self.region.length as usize];
        file.read_exact_at(&mut bytes, origin)?;
        let found = package_in_use(RamFlash::new(&bytes), &self.region, key.copied());
        found.map_err(|error| wrong(&error.to_string()))
    }

    /// Writes an erased flash with an optional package, atomically.
    fn write_flash(&self, path: &Path, package: Option<&PackageBytes>) -> Result<(), Fault> {
        let offset = |address: u64| address.checked_sub(FLASH_ORIGIN.into());
        let origin = offset(self.region.origin.into());
        let end = offset(self.region.end()).filter(|&end| end <= FLASH_LENGTH);
        let (Some(origin), Some(_)) = (origin, end) else {
            return Err(Fault::Start(format!(
                "WEIGHTS at {:#010x} is outside the flash of {MACHINE}, {FLASH_ORIGIN:#010x} to {:#010x}; \
                 give the memory map of that board with --memory",
                self.region.origin,
                u64::from(FLASH_ORIGIN) + FLASH_LENGTH
            )));
        };
        let image = package.map(|package| Image::of_package(&self.region, Slot::A, package));
        let image = image.transpose().map_err(|error| Fault::Start(error.to_string()))?;
        let made = path.with_extension("new");
        let write = || -> io::Result<()> {
            let file = File::create(&made)?;
            file.set_len(FLASH_LENGTH)?;
            file.write_all_at(&vec![ERASED; self.region.length as usize], origin)?;
            for segment in image.iter().flat_map(Image::segments) {
                let place = offset(segment.address.into()).unwrap_or(origin);
                file.write_all_at(&segment.bytes, place)?;
            }
            std::fs::rename(&made, path)
        };
        write().map_err(|error| {
            Fault::Start(format!(
                "{}: {error}; free some disk space, or set TMPDIR to a folder with more space",
                path.display()
            ))
        })
    }
}

/// Escapes a path for one of QEMU's options, where commas are doubled.
fn option(path: &Path) -> String {
    path.display().to_string().replace(',', ",,")
}
