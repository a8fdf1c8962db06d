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
    let word = shell_word(&path);
    let reset = "probe-rs reset --chip CHIP";
    let probe_rs = match format {
        Bin => Ok(format!(
            "probe-rs download --chip CHIP --binary-format bin --base-address {base} --verify \
             {word} && {reset}"
        )),
        Hex => Ok(format!(
            "probe-rs download --chip CHIP --binary-format hex --verify {word} && {reset}"
        )),
        Uf2 => Err([Hex, Bin].as_slice()),
    };
    // In Tcl's braces a name may hold blanks.
    let program = |address: &str| {
        let script = format!("program {{{path}}} verify reset exit{address}");
        Ok(format!("openocd -f BOARD.cfg -c {}", shell_word(&script)))
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

/// The file's name in a form that no tool takes for an option.
fn path_argument(file: &Path) -> String {
    let name = file.display().to_string();
    if name.starts_with('-') { format!("./{name}") } else { name }
}

/// `text` as one word of a Unix shell.
fn shell_word(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "_-./+:=@%,".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        text.to_owned()
    } else {
        format!("'{}'", text.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_for_the_shell() {
        for (text, word) in [
            ("a/b-1.hex", "a/b-1.hex"),
            ("two words", "'two words'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
        ] {
            assert_eq!(shell_word(text), word);
        }
        assert_eq!(path_argument(Path::new("-rf.hex")), "./-rf.hex");
    }
}
