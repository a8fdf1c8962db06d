//! Command lines of common tools that flash an image.
//!
//! Sources: manuals and source code of probe-rs 0.32, OpenOCD 0.12, stlink 1.8, dfu-util 0.11 and
//! picotool 2.2. Not obvious from these:
//! - OpenOCD and st-flash fill the gap in an Intel HEX file, like a `bin` file; probe-rs fills it
//!   with zeros in a UF2 file, so that combination is not suggested.
//! - dfu-util's `:leave` would start executing at the download address, which holds weights, so the
//!   board must be reset manually.

use core::fmt;
use std::path::Path;

use super::{Format, Image};
use crate::shell::{path_argument, quoted};

/// How a tool writes an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ToolCommand {
    /// Name of the tool.
    pub tool: &'static str,
    /// How it uses the file.
    pub usage: ToolUse,
}

/// How a tool uses a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ToolUse {
    /// A command line for a Unix shell. The user replaces words in capital letters.
    Line(String),
    /// It does not support this format, only these.
    Needs(&'static [Format]),
}

impl fmt::Display for ToolCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.usage {
            ToolUse::Line(line) => write!(f, "{}: {line}", self.tool),
            ToolUse::Needs(formats) => {
                write!(f, "{}: does not support this format; use --format ", self.tool)?;
                for (at, format) in formats.iter().enumerate() {
                    write!(f, "{}{format}", if at == 0 { "" } else { " or " })?;
                }
                Ok(())
            }
        }
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bin => "bin",
            Self::Hex => "hex",
            Self::Uf2 => "uf2",
        })
    }
}

/// Returns how each tool writes `image`, stored as `file` in `format`.
#[must_use]
pub fn commands_for(image: &Image, file: &Path, format: Format) -> Vec<ToolCommand> {
    use Format::{Bin, Hex, Uf2};
    let base = format!("{:#x}", image.base());
    let path = path_argument(file);
    let word = quoted(&path);
    let reset = "probe-rs reset --chip CHIP";
    let probe_rs = match format {
        Bin => Ok(format!(
            "probe-rs download --chip CHIP --binary-format bin --base-address {base} \
             --restore-unwritten --verify {word} && {reset}"
        )),
        Hex => Ok(format!(
            "probe-rs download --chip CHIP --binary-format hex --restore-unwritten \
             --verify {word} && {reset}"
        )),
        Uf2 => Err([Hex, Bin].as_slice()),
    };
    let program = |address: &str| {
        let script = format!("program {} verify reset exit{address}", tcl_word(&path));
        Ok(format!("openocd -f BOARD.cfg -c {}", quoted(&script)))
    };
    let openocd = match format {
        Bin => program(&format!(" {base}")),
        Hex => program(""),
        Uf2 => Err([Hex, Bin].as_slice()),
    };
    let st_flash = match format {
        Bin => Ok(format!("st-flash --reset write {word} {base}")),
        Hex => Ok(format!("st-flash --reset --format ihex write {word}")),
        Uf2 => Err([Bin, Hex].as_slice()),
    };
    let dfu_util = match format {
        Bin => Ok(format!("dfu-util -a 0 -s {base} -D {word}")),
        Hex | Uf2 => Err([Bin].as_slice()),
    };
    let picotool = match format {
        Bin => Ok(format!("picotool load -v {word} -t bin -o {base} && picotool reboot")),
        Uf2 => Ok(format!("picotool load -v {word} -t uf2 && picotool reboot")),
        Hex => Err([Uf2, Bin].as_slice()),
    };
    let drive = match format {
        Uf2 => Ok(format!("cp {word} DRIVE")),
        Bin | Hex => Err([Uf2].as_slice()),
    };
    [
        ("probe-rs", probe_rs),
        ("OpenOCD", openocd),
        ("st-flash", st_flash),
        ("dfu-util", dfu_util),
        ("picotool", picotool),
        ("USB drive of a bootloader", drive),
    ]
    .into_iter()
    .map(|(tool, usage)| ToolCommand {
        tool,
        usage: usage.map_or_else(ToolUse::Needs, ToolUse::Line),
    })
    .collect()
}

/// Quotes `path` as one word of a Tcl script.
fn tcl_word(path: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./".contains(c);
    let escaped = path.chars().flat_map(|c| {
        let backslash = (!plain(c)).then_some('\\');
        backslash.into_iter().chain([c])
    });
    escaped.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_become_one_tcl_word() {
        for (name, word) in [
            ("a/b-1.hex", "a/b-1.hex"),
            ("two words", "two\\ words"),
            ("x} ; exec reboot {", "x\\}\\ \\;\\ exec\\ reboot\\ \\{"),
            ("[exec reboot]", "\\[exec\\ reboot\\]"),
            ("$HOME", "\\$HOME"),
        ] {
            assert_eq!(tcl_word(name), word);
        }
    }
}
