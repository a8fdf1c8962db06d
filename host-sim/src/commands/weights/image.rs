//! `weights image` and `flash`: packages into flash memory.

use std::path::{Path, PathBuf};

use agent_core::store::Slot;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::renamed;
use crate::commands::{CommandError, Format, print_json, print_text};
use crate::files::output::write_whole;
use crate::flash::{FlashTarget, ProbeRs};
use crate::image::{self, Image, ImageError, ImageFormat, Part, ToolUse, Uf2Family, commands_for};
use crate::interruption::{self, Again};
use crate::memory_map::MemoryMap;
use crate::packages::PackageBytes;
use crate::packages::check::check;
use crate::signing::read_public_key;
use crate::terminal;

/// Where in which memory.
#[derive(Debug, Args)]
struct Place {
    /// The slot to fill: a or b
    #[arg(long, value_parser = slot)]
    slot: Slot,
    /// The board's memory map
    #[arg(long)]
    memory: PathBuf,
    /// The node's public key: the package must be signed with its private half
    #[arg(long)]
    key: Option<PathBuf>,
}

/// Arguments of `weights image`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// The package
    package: PathBuf,
    #[command(flatten)]
    place: Place,
    /// Format of the image; with `json` besides, the result is printed as JSON [default: what
    /// --out ends in, else hex]
    #[arg(long, value_enum, value_delimiter = ',')]
    format: Vec<OutputFormat>,
    /// Family of the chip, for uf2: rp2040, rp2350-arm-s, rp2350-riscv, nrf52840, stm32f4 or a number
    #[arg(long)]
    family: Option<Uf2Family>,
    /// The chip, as probe-rs calls it: the memory map is held against its flash, if that is known
    #[arg(long)]
    chip: Option<String>,
    /// The file to write [default: the package's name with .slot-a.bin or so]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Format of the image, or of what is printed about it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum OutputFormat {
    /// Bytes from the slot's address to the end of the weights; blanks what lies between
    Bin,
    /// Intel HEX
    Hex,
    /// Blocks for a USB bootloader
    Uf2,
    /// What is printed: text
    Text,
    /// What is printed: one JSON object
    Json,
}

/// Arguments of `flash`.
#[derive(Debug, Args)]
pub(in crate::commands) struct FlashArguments {
    /// The package
    package: PathBuf,
    #[command(flatten)]
    place: Place,
    /// The chip, as probe-rs calls it (`probe-rs chip list`)
    #[arg(long)]
    chip: Option<String>,
    /// The debug probe, as `probe-rs list` names it; needed if there are several
    #[arg(long)]
    probe: Option<String>,
    /// The program probe-rs [default: the one on PATH]
    #[arg(long)]
    probe_rs: Option<PathBuf>,
    /// How the result is printed on standard output
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

fn slot(name: &str) -> Result<Slot, String> {
    match name {
        "a" | "A" => Ok(Slot::A),
        "b" | "B" => Ok(Slot::B),
        _ => Err("there are the slots a and b".to_owned()),
    }
}

/// The image of a package that a node would accept.
fn image(path: &Path, place: &Place) -> Result<Image, CommandError> {
    let region = MemoryMap::read(&place.memory)?.weights()?;
    let key = place.key.as_deref().map(read_public_key).transpose()?;
    let package = PackageBytes::load(path)?;
    let requirements = super::verify::requirements(key.as_ref(), None);
    check(&package, &requirements).map_err(|refusal| CommandError::refused(path, &refusal))?;
    Ok(Image::of_package(&region, place.slot, &package)?)
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        image: String,
        bytes: usize,
        slot: String,
        segments: Vec<Segment>,
        commands: Vec<Command>,
        /// What a tool may do besides.
        notes: Vec<String>,
    }
    #[derive(Serialize)]
    struct Segment {
        name: &'static str,
        address: u32,
        bytes: usize,
    }
    #[derive(Serialize)]
    struct Command {
        tool: &'static str,
        command: Option<String>,
        /// Where there is no command: the formats that the tool takes.
        needs: Vec<String>,
    }
    let (format, printed) = formats(arguments)?;
    let image_format = format.with_family(arguments.family)?;
    let image = image(&arguments.package, &arguments.place)?;
    let contradiction = match image_format {
        ImageFormat::Uf2(family) => contradiction(&image, family)?,
        _ => None,
    };
    if let Some(part) = arguments.chip.as_deref().and_then(Part::of_chip) {
        image.check_part(&part, false)?;
    }
    let bytes = image.encode(image_format)?;
    let ending = match image.slot() {
        Slot::A => format!(".slot-a.{format}"),
        Slot::B => format!(".slot-b.{format}"),
    };
    let out = arguments.out.clone().unwrap_or_else(|| renamed(&arguments.package, &ending));
    write_whole(&out, image_format.file_kind(), |file| file.write_all(&bytes))?;
    let commands = commands_for(&image, &out, format);
    let mut notes = notes(&image, format);
    notes.splice(0..0, contradiction);
    if printed == Format::Json {
        return print_json(&Report {
            image: out.display().to_string(),
            bytes: bytes.len(),
            slot: image.slot().to_string(),
            segments: image
                .segments()
                .iter()
                .map(|s| Segment { name: s.name, address: s.address, bytes: s.bytes.len() })
                .collect(),
            commands: commands
                .iter()
                .map(|command| Command {
                    tool: command.tool,
                    command: match &command.usage {
                        ToolUse::Line(line) => Some(line.clone()),
                        ToolUse::Needs(_) => None,
                    },
                    needs: match &command.usage {
                        ToolUse::Line(_) => Vec::new(),
                        ToolUse::Needs(formats) => {
                            formats.iter().map(ToString::to_string).collect()
                        }
                    },
                })
                .collect(),
            notes,
        });
    }
    let mut text =
        format!("Written to {}: {} bytes, {}\n", out.display(), bytes.len(), image.slot());
    for segment in image.segments() {
        text += &format!(
            "  {:#010x}  {} bytes  {}\n",
            segment.address,
            segment.bytes.len(),
            segment.name
        );
    }
    for note in &notes {
        text += &format!("  {note}\n");
    }
    text += "To write it into the chip, one of\n";
    for command in &commands {
        text += &format!("  {command}\n");
    }
    print_text(&text)
}

/// What a boot loader of this family makes of the image if it has no flash there.
fn contradiction(image: &Image, family: Uf2Family) -> Result<Option<String>, CommandError> {
    let Some(part) = Part::of_family(family) else { return Ok(None) };
    match image.check_part(&part, true) {
        Ok(()) => Ok(None),
        Err(error @ ImageError::NotFlash { .. }) => {
            Ok(Some(format!("WARNING: {error}. Its boot loader would not write this file.")))
        }
        Err(error) => Err(error.into()),
    }
}

/// What a tool may erase besides the image.
fn notes(image: &Image, format: image::Format) -> Vec<String> {
    let mut notes = Vec::new();
    if image.gap_holds_other_slot() {
        match format {
            image::Format::Bin => notes.push(
                "A bin file has no holes: this one blanks the other slot; hex and uf2 have a hole \
                 there."
                    .to_owned(),
            ),
            image::Format::Hex => notes.push(
                "OpenOCD and st-flash fill the hole of a hex file: with them, the other slot is \
                 blanked."
                    .to_owned(),
            ),
            image::Format::Uf2 => {}
        }
    }
    notes.push(format!(
        "OpenOCD, st-flash, dfu-util, picotool and boot loaders erase whole sectors of the chip. \
         Where those are larger than the {} bytes of _weights_erase_size, what else lies in them is \
         lost; probe-rs puts it back. --chip holds the map against the chip.",
        image.region().erase_size
    ));
    notes
}

/// The image's format and how the result is printed.
fn formats(arguments: &Arguments) -> Result<(image::Format, Format), CommandError> {
    let (mut image, mut printed) = (None, None);
    for format in &arguments.format {
        let twice = match format {
            OutputFormat::Bin => image.replace(image::Format::Bin).is_some(),
            OutputFormat::Hex => image.replace(image::Format::Hex).is_some(),
            OutputFormat::Uf2 => image.replace(image::Format::Uf2).is_some(),
            OutputFormat::Text => printed.replace(Format::Text).is_some(),
            OutputFormat::Json => printed.replace(Format::Json).is_some(),
        };
        if twice {
            let problem = "--format: give one of bin, hex and uf2, and text or json besides";
            return Err(CommandError::usage(problem.to_owned()));
        }
    }
    let of_name = arguments.out.as_deref().map(|out| (out, image::Format::of_file(out)));
    let format =
        match (image, of_name) {
            (Some(asked), Some((out, Some(named)))) if asked != named => {
                return Err(CommandError::usage(format!(
                "{}: ends as a {named} file does, and --format says {asked}; give one of both, or \
                 another name",
                out.display()
            )).about(out));
            }
            (Some(asked), _) => asked,
            (None, Some((_, Some(named)))) => named,
            (None, Some((out, None))) => {
                return Err(CommandError::usage(format!(
                "{}: its ending does not say what file to write; give --format bin, hex or uf2, or \
                 a name with .bin, .hex or .uf2",
                out.display()
            )).about(out));
            }
            (None, None) => image::Format::Hex,
        };
    Ok((format, printed.unwrap_or_default()))
}

pub(in crate::commands) fn flash(arguments: &FlashArguments) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        package: String,
        slot: String,
        bytes: usize,
        verified: bool,
    }
    interruption::listen(Again::Exit);
    let image = image(&arguments.package, &arguments.place)?;
    if let Some(part) = arguments.chip.as_deref().and_then(Part::of_chip) {
        image.check_part(&part, false)?;
    }
    let program = ProbeRs::find(arguments.probe_rs.as_deref())?;
    let target = FlashTarget { chip: arguments.chip.clone(), probe: arguments.probe.clone() };
    program.flash(&target, &image, &mut |step| {
        if arguments.format == Format::Text {
            terminal::note(step);
        }
    })?;
    let report = Report {
        package: arguments.package.display().to_string(),
        slot: image.slot().to_string(),
        bytes: image.segments().iter().map(|segment| segment.bytes.len()).sum(),
        verified: true,
    };
    match arguments.format {
        Format::Json => print_json(&report),
        Format::Text => print_text(&format!(
            "Flashed {} into {}: {} bytes, read back and found equal\n",
            report.package, report.slot, report.bytes
        )),
    }
}
