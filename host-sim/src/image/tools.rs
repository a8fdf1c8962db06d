//! The command lines with which common tools write an image.
//!
//! Sources: the tools' own manuals and sources, of probe-rs 0.32, OpenOCD 0.12, stlink 1.8,
//! dfu-util 0.11 and picotool 2.2. What is not obvious in them:
//! - OpenOCD and st-flash fill the hole in an Intel HEX file, as a `bin` file has it filled;
//!   probe-rs does so with a UF2 file, with zeros, so it is not proposed here.
//! - dfu-util's `:leave` starts whatever lies at the address of the download; weights are no
//!   program, so the board is reset by hand.

use core::fmt;
use std::path::Path;

use super::{Format, Image};
use crate::shell::{path_argument, quoted};

/// How a tool writes an image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ToolCommand {
    /// The tool.
    pub tool: &'static str,
    /// What it does with the file.
    pub usage: ToolUse,
}

/// What a tool does with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ToolUse {
    /// It takes the file with this command line, for a Unix shell. Words in capital letters are
    /// the user's to fill in.
    Line(String),
    /// It does not take this format, only these.
    Needs(&'static [Format]),
}

impl fmt::Display for ToolCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.usage {
            ToolUse::Line(line) => write!(f, "{}: {line}", self.tool),
            ToolUse::Needs(formats) => {
                write!(f, "{}: takes no such file; choose --format ", self.tool)?;
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

/// How each tool writes `image`, which is stored as `file` in `format`.
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

/// `path` as one word of a Tcl script.
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
    fn a_name_stays_one_word_of_tcl() {
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
