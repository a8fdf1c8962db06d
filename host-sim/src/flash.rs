//! Writes an image into a microcontroller, with the program probe-rs, and reads it back.
//!
//! 1. `probe-rs download` writes the image from a temporary Intel HEX file. It erases the sectors
//!    that the image touches, `--restore-unwritten` puts back what else lay in them: a memory map
//!    whose erase unit is smaller than the chip's costs no firmware.
//! 2. `probe-rs read` reads every segment back, and each byte is compared. The commit area comes
//!    first, since it is what a firmware that runs meanwhile may change.
//! 3. `probe-rs reset` restarts the firmware: the download used its RAM.
//!
//! Any error leaves the chip as it is at that moment; flashing again repairs it.
//!
//! The options are those of probe-rs 0.24 and later. Other settings (the protocol, the speed, a
//! description of the chip) reach it through its own environment variables.

use std::ffi::OsStr;
use std::fmt;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::files::output::temporary::Temporary;
use crate::image::{Image, ImageError, ImageFormat, Segment};
use crate::interruption;

/// The program's name.
const PROGRAM: &str = "probe-rs";

/// An installed probe-rs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ProbeRs {
    program: PathBuf,
}

/// The microcontroller, in probe-rs's words.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FlashTarget {
    /// Its name: `--chip`. Without one, probe-rs finds out if it can.
    pub chip: Option<String>,
    /// The debug probe: `--probe`. Without one, there is only one.
    pub probe: Option<String>,
}

/// What is done at the moment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FlashStep {
    /// So many bytes are written.
    Download {
        /// Bytes of all segments.
        bytes: usize,
    },
    /// A segment is read back.
    ReadBack {
        /// What it is.
        name: &'static str,
        /// Its first address.
        address: u32,
        /// Its length \[bytes\].
        bytes: usize,
    },
    /// The firmware is restarted.
    Reset,
}

impl fmt::Display for FlashStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Download { bytes } => write!(f, "writing {bytes} bytes"),
            Self::ReadBack { name, address, bytes } => {
                write!(f, "reading {name} back: {bytes} bytes at {address:#010x}")
            }
            Self::Reset => f.write_str("resetting the chip"),
        }
    }
}

/// Why flashing failed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FlashError {
    /// There is no probe-rs.
    #[error(
        "{}: there is no such program; install it (https://probe.rs/docs/getting-started/installation, \
         or `cargo install probe-rs-tools --locked`) or name it with --probe-rs PATH",
        program.display()
    )]
    NotInstalled {
        /// What was looked for.
        program: PathBuf,
    },
    /// The program cannot be started.
    #[error("{}: cannot be started: {error}; name another with --probe-rs PATH", program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// The file for the program cannot be written.
    #[error("{}: {error}; free the disk, or set TMPDIR to a folder that can be written to", path.display())]
    TemporaryFile {
        /// The file.
        path: PathBuf,
        /// What the system says.
        #[source]
        error: io::Error,
    },
    /// A signal asked for the end.
    #[error("interrupted at {step}; the chip is as it was left, flash it again")]
    Interrupted {
        /// What was not done, or not to its end.
        step: FlashStep,
    },
    /// The image cannot be written as a file.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The program reports an error.
    #[error(
        "{step} failed, `{command}` says:\n{said}\ncheck the debug probe's cable, the board's power \
         and the name of the chip (`probe-rs chip list`)"
    )]
    Failed {
        /// During which step.
        step: FlashStep,
        /// The command line.
        command: String,
        /// What it wrote to standard error.
        said: String,
    },
    /// What the program printed is not what was read.
    #[error(
        "{step}: cannot understand what `{command}` prints ({problem}); use probe-rs 0.24 or later"
    )]
    Unreadable {
        /// During which step.
        step: FlashStep,
        /// The command line.
        command: String,
        /// What is wrong.
        problem: String,
    },
    /// The chip holds something else than what was written.
    #[error(
        "{name} reads back differently: at {address:#010x} {expected:#04x} was written and \
         {found:#04x} is there; flash again, and see that WEIGHTS in memory.x is flash of this chip"
    )]
    Differs {
        /// Which segment.
        name: &'static str,
        /// The first address that differs.
        address: u64,
        /// What was written there.
        expected: u8,
        /// What was read there.
        found: u8,
    },
}

impl ProbeRs {
    /// The program at `named`, or the one on `PATH`.
    ///
    /// # Errors
    /// There is none.
    pub fn find(named: Option<&Path>) -> Result<Self, FlashError> {
        match named {
            Some(program) if program.is_file() => Ok(Self::at(program)),
            Some(program) => Err(FlashError::NotInstalled { program: program.to_owned() }),
            None => Self::find_in(&std::env::var_os("PATH").unwrap_or_default()),
        }
    }

    /// The program in one of the folders of `path`, which is written as the variable `PATH` is.
    ///
    /// # Errors
    /// There is none.
    pub fn find_in(path: &OsStr) -> Result<Self, FlashError> {
        let name = format!("{PROGRAM}{}", std::env::consts::EXE_SUFFIX);
        std::env::split_paths(path)
            .map(|folder| folder.join(&name))
            .find(|program| program.is_file())
            .map(|program| Self::at(&program))
            .ok_or_else(|| FlashError::NotInstalled { program: PROGRAM.into() })
    }

    /// A name without a folder would be looked for on `PATH` once more.
    fn at(program: &Path) -> Self {
        let absolute = std::path::absolute(program);
        Self { program: absolute.unwrap_or_else(|_| program.to_owned()) }
    }

    /// Where the program is.
    #[must_use]
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// Writes `image` into the chip, compares what then is there, and resets it. Every step is
    /// announced to `progress`.
    ///
    /// # Errors
    /// Every [`FlashError`] but the first.
    pub fn flash(
        &self,
        target: &FlashTarget,
        image: &Image,
        progress: &mut dyn FnMut(FlashStep),
    ) -> Result<(), FlashError> {
        let file = temporary_file(&image.encode(ImageFormat::Hex)?)?;
        let bytes = image.segments().iter().map(|segment| segment.bytes.len()).sum();
        let step = FlashStep::Download { bytes };
        progress(step);
        let mut download = self.command("download", target);
        download.args(["--binary-format", "hex", "--restore-unwritten"]).arg(file.path());
        run(step, &mut download)?;
        // The commit area first: see the module's description.
        let region = image.region();
        let mut segments: Vec<_> = image.segments().iter().collect();
        segments.sort_by_key(|segment| segment.address != region.commit);
        for segment in segments {
            let step = FlashStep::ReadBack {
                name: segment.name,
                address: segment.address,
                bytes: segment.bytes.len(),
            };
            progress(step);
            self.compare(target, segment, step)?;
        }
        progress(FlashStep::Reset);
        run(FlashStep::Reset, &mut self.command("reset", target))?;
        Ok(())
    }

    fn compare(
        &self,
        target: &FlashTarget,
        segment: &Segment,
        step: FlashStep,
    ) -> Result<(), FlashError> {
        let mut read = self.command("read", target);
        read.arg("b8").arg(format!("{:#x}", segment.address)).arg(segment.bytes.len().to_string());
        let printed = run(step, &mut read)?;
        let found = bytes_of(&printed, segment).map_err(|problem| FlashError::Unreadable {
            step,
            command: line_of(&read),
            problem,
        })?;
        let differs = segment
            .span()
            .zip(segment.bytes.iter().zip(&found))
            .find(|(_, (expected, found))| expected != found);
        match differs {
            None => Ok(()),
            Some((address, (&expected, &found))) => {
                Err(FlashError::Differs { name: segment.name, address, expected, found })
            }
        }
    }

    fn command(&self, what: &str, target: &FlashTarget) -> Command {
        let mut command = Command::new(&self.program);
        command.arg(what);
        for (option, value) in [("--chip", &target.chip), ("--probe", &target.probe)] {
            if let Some(value) = value {
                command.args([option, value]);
            }
        }
        command
    }
}

/// Runs `command` to its end and returns what it printed. A signal has to wait for
/// that: a program that writes flash is not to be stopped in the middle.
fn run(step: FlashStep, command: &mut Command) -> Result<String, FlashError> {
    if interruption::requested() {
        return Err(FlashError::Interrupted { step });
    }
    // Without an input, a question of which probe to take is an error, and nobody waits.
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|error| FlashError::Start { program: command.get_program().into(), error })?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    if interruption::requested() {
        // Ctrl-C reaches every program of the terminal.
        return Err(FlashError::Interrupted { step });
    }
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    let said = if said.is_empty() { output.status.to_string() } else { said };
    Err(FlashError::Failed { step, command: line_of(command), said })
}

fn line_of(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ")
}

/// The bytes in what `probe-rs read b8` printed: two hexadecimal digits each. Since version 0.32
/// each line begins with the address of its first byte.
fn bytes_of(printed: &str, segment: &Segment) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::with_capacity(segment.bytes.len());
    for word in printed.split_whitespace() {
        if let Some(address) = word.strip_suffix(':') {
            let expected = segment.span().start + bytes.len() as u64;
            if u64::from_str_radix(address, 16) != Ok(expected) {
                return Err(format!("found the address {address:?} instead of {expected:08x}"));
            }
        } else {
            let digits = word.len() == 2 && word.bytes().all(|digit| digit.is_ascii_hexdigit());
            let byte = u8::from_str_radix(word, 16).ok().filter(|_| digits);
            bytes.push(byte.ok_or_else(|| format!("found {word:?} instead of a byte"))?);
        }
    }
    if bytes.len() != segment.bytes.len() {
        return Err(format!("found {} bytes instead of {}", bytes.len(), segment.bytes.len()));
    }
    Ok(bytes)
}

/// A file for another program to read, removed at the end.
fn temporary_file(content: &[u8]) -> Result<Temporary, FlashError> {
    let folder = std::env::temp_dir();
    let failed = |path: &Path, error| FlashError::TemporaryFile { path: path.to_owned(), error };
    let (made, mut file) =
        Temporary::file(&folder, Some(0o600)).map_err(|error| failed(&folder, error))?;
    file.write_all(content).map_err(|error| failed(made.path(), error))?;
    Ok(made)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn segment(length: u8) -> Segment {
        Segment { name: "test", address: 0x30_0000, bytes: (0..length).collect() }
    }

    #[test]
    fn what_every_version_prints_is_understood() {
        let bytes: Vec<u8> = (0..10).collect();
        let list = "00 01 02 03 04 05 06 07 08 09\n";
        assert_eq!(bytes_of(list, &segment(10)), Ok(bytes.clone()));
        let table = "00300000: 00 01 02 03 04 05 06 07\n00300008: 08 09\n";
        assert_eq!(bytes_of(table, &segment(10)), Ok(bytes));
    }

    #[test]
    fn what_is_not_understood_is_named() {
        for (printed, part) in [
            ("00 01", "2 bytes instead of 3"),
            ("00 01 02 03", "4 bytes instead of 3"),
            ("00 01 zz", "\"zz\""),
            ("000102", "\"000102\""),
            ("00 +1 02", "\"+1\""),
            ("00300008: 00 01 02", "00300000"),
            ("", "0 bytes"),
        ] {
            let problem = bytes_of(printed, &segment(3)).unwrap_err();
            assert!(problem.contains(part), "{printed}: {problem}");
        }
    }
}
