//! Writes an image to a microcontroller with probe-rs, and verifies it.
//!
//! 1. `probe-rs download` writes the image from a temporary Intel HEX file. It erases every sector
//!    that the image touches; `--restore-unwritten` restores the rest of these sectors, so an erase
//!    unit in the memory map that is smaller than the chip's does not destroy firmware.
//! 2. `probe-rs read` reads every segment back for a byte-by-byte comparison. The commit area comes
//!    first, because running firmware may change it.
//! 3. `probe-rs reset` restarts the firmware, because the download used its RAM.
//!
//! After an error the chip is left as it is; flashing again repairs it.
//!
//! The options work with probe-rs 0.24 and later. Other settings (protocol, speed, chip
//! description) are passed through probe-rs's own environment variables.

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

/// The microcontroller, in probe-rs's terms.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FlashTarget {
    /// Name of the chip: `--chip`. If `None`, probe-rs tries to detect it.
    pub chip: Option<String>,
    /// The debug probe: `--probe`. If `None`, only one may be connected.
    pub probe: Option<String>,
}

/// A step of flashing.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum FlashStep {
    /// Writing the image.
    Download {
        /// Total length of all segments. \[bytes\]
        bytes: usize,
    },
    /// Reading a segment back.
    ReadBack {
        /// Name of the segment.
        name: &'static str,
        /// Its first address.
        address: u32,
        /// Length of the region. \[bytes\]
        bytes: usize,
    },
    /// Restarting the firmware.
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
    /// probe-rs was not found.
    #[error(
            "{}: program not found; install probe-rs \
             (https://probe.rs/docs/getting-started/installation, or \
             `cargo install probe-rs-tools --locked`) or pass its path with --probe-rs PATH",
        program.display()
    )]
    NotInstalled {
        /// The program looked for.
        program: PathBuf,
    },
    /// The program could not be started.
    #[error("{}: cannot start: {error}; pass another program with --probe-rs PATH", program.display())]
    Start {
        /// The program.
        program: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// The temporary file could not be written.
    #[error("{}: {error}; free some disk space, or set TMPDIR to a writable folder", path.display())]
    TemporaryFile {
        /// The file.
        path: PathBuf,
        /// The system's error.
        #[source]
        error: io::Error,
    },
    /// Interrupted by a signal.
    #[error("interrupted while {step}; the chip may be partly written, flash it again")]
    Interrupted {
        /// The step that was not completed.
        step: FlashStep,
    },
    /// The image could not be encoded.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The program reported an error.
    #[error(
        "{step} failed; `{command}` reported:\n{stderr}\ncheck the cable of the debug probe, the board's \
             power and the chip name (`probe-rs chip list`)"
    )]
    Failed {
        /// The step.
        step: FlashStep,
        /// The command line.
        command: String,
        /// Its standard error.
        stderr: String,
    },
    /// The output of the program could not be parsed.
    #[error(
        "{step}: cannot parse the output of `{command}` ({problem}); use probe-rs 0.24 or later"
    )]
    Unreadable {
        /// The step.
        step: FlashStep,
        /// The command line.
        command: String,
        /// What is wrong.
        problem: String,
    },
    /// The chip's contents differ from the image.
    #[error(
        "{name} does not match after flashing: at {address:#010x} wrote {expected:#04x}, read \
             {found:#04x}; flash again, and check that WEIGHTS in memory.x is in the flash of this chip"
    )]
    Differs {
        /// Name of the segment.
        name: &'static str,
        /// The first address that differs.
        address: u64,
        /// The byte written.
        expected: u8,
        /// The byte read.
        found: u8,
    },
}

impl ProbeRs {
    /// Returns the program at `named`, or the one on `PATH`.
    ///
    /// # Errors
    /// If the program does not exist.
    pub fn find(named: Option<&Path>) -> Result<Self, FlashError> {
        match named {
            Some(program) if program.is_file() => Ok(Self::at(program)),
            Some(program) => Err(FlashError::NotInstalled { program: program.to_owned() }),
            None => Self::find_in(&std::env::var_os("PATH").unwrap_or_default()),
        }
    }

    /// Returns the program in one of the folders of `path`, written like the variable `PATH`.
    ///
    /// # Errors
    /// If the program does not exist.
    pub fn find_in(path: &OsStr) -> Result<Self, FlashError> {
        let name = format!("{PROGRAM}{}", std::env::consts::EXE_SUFFIX);
        std::env::split_paths(path)
            .map(|folder| folder.join(&name))
            .find(|program| program.is_file())
            .map(|program| Self::at(&program))
            .ok_or_else(|| FlashError::NotInstalled { program: PROGRAM.into() })
    }

    /// Makes the path absolute: a bare name would be searched on `PATH` again.
    fn at(program: &Path) -> Self {
        let absolute = std::path::absolute(program);
        Self { program: absolute.unwrap_or_else(|_| program.to_owned()) }
    }

    /// Returns the program's path.
    #[must_use]
    pub fn program(&self) -> &Path {
        &self.program
    }

    /// Writes `image` to the chip, verifies it, and resets the chip. Each step is reported to
    /// `progress`.
    ///
    /// # Errors
    /// Every [`FlashError`] except `NotInstalled`.
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
        // The commit area first: see the module docs.
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
        let found = parse_bytes(&printed, segment).map_err(|problem| FlashError::Unreadable {
            step,
            command: command_line(&read),
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

/// Runs `command` to its end and returns its output. A signal has to wait: a program that is
/// writing flash must not be stopped half-way.
fn run(step: FlashStep, command: &mut Command) -> Result<String, FlashError> {
    if interruption::requested() {
        return Err(FlashError::Interrupted { step });
    }
    // Without input, probe-rs fails instead of asking which probe to use.
    let output = command
        .stdin(Stdio::null())
        .output()
        .map_err(|error| FlashError::Start { program: command.get_program().into(), error })?;
    if output.status.success() {
        return Ok(String::from_utf8_lossy(&output.stdout).into_owned());
    }
    if interruption::requested() {
        // Ctrl-C reaches every process of the terminal.
        return Err(FlashError::Interrupted { step });
    }
    let stderr = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    let stderr = if stderr.is_empty() { output.status.to_string() } else { stderr };
    Err(FlashError::Failed { step, command: command_line(command), stderr })
}

fn command_line(command: &Command) -> String {
    let words = std::iter::once(command.get_program()).chain(command.get_args());
    words.map(OsStr::to_string_lossy).collect::<Vec<_>>().join(" ")
}

/// Parses the output of `probe-rs read b8`: two hexadecimal digits per byte. Since version 0.32
/// each line starts with the address of its first byte.
fn parse_bytes(printed: &str, segment: &Segment) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::with_capacity(segment.bytes.len());
    for word in printed.split_whitespace() {
        if let Some(address) = word.strip_suffix(':') {
            let expected = segment.span().start + bytes.len() as u64;
            if u64::from_str_radix(address, 16) != Ok(expected) {
                return Err(format!("expected address {expected:08x}, found {address:?}"));
            }
        } else {
            let digits = word.len() == 2 && word.bytes().all(|digit| digit.is_ascii_hexdigit());
            let byte = u8::from_str_radix(word, 16).ok().filter(|_| digits);
            bytes.push(byte.ok_or_else(|| format!("expected a byte, found {word:?}"))?);
        }
    }
    if bytes.len() != segment.bytes.len() {
        return Err(format!("expected {} bytes, found {}", segment.bytes.len(), bytes.len()));
    }
    Ok(bytes)
}

/// Creates a file for another program to read; dropping it removes the file.
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
    fn parses_the_output_of_every_version() {
        let bytes: Vec<u8> = (0..10).collect();
        let list = "00 01 02 03 04 05 06 07 08 09\n";
        assert_eq!(parse_bytes(list, &segment(10)), Ok(bytes.clone()));
        let table = "00300000: 00 01 02 03 04 05 06 07\n00300008: 08 09\n";
        assert_eq!(parse_bytes(table, &segment(10)), Ok(bytes));
    }

    #[test]
    fn errors_quote_unexpected_output() {
        for (printed, part) in [
            ("00 01", "expected 3 bytes, found 2"),
            ("00 01 02 03", "expected 3 bytes, found 4"),
            ("00 01 zz", "\"zz\""),
            ("000102", "\"000102\""),
            ("00 +1 02", "\"+1\""),
            ("00300008: 00 01 02", "00300000"),
            ("", "found 0"),
        ] {
            let problem = parse_bytes(printed, &segment(3)).unwrap_err();
            assert!(problem.contains(part), "{printed}: {problem}");
        }
    }
}
