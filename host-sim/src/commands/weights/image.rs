//! `weights image` and `flash`: placing packages in flash memory, for a blank board also firmware and
//! keys.

use std::path::{Path, PathBuf};

use agent_core::store::Slot;
use clap::{Args, ValueEnum};
use serde::Serialize;

use super::renamed;
use crate::commands::key::Passphrase;
use crate::commands::{CommandError, ErrorCode, Format, print_json, print_text};
use crate::files::input::read_limited;
use crate::files::output::{write_secret, write_whole};
use crate::flash::{FlashTarget, ProbeRs};
use crate::image::{self, Image, ImageError, ImageFormat, Part, ToolUse, Uf2Family, commands_for};
use crate::interruption::{self, SecondSignal};
use crate::keys::epoch_now;
use crate::memory_map::MemoryMap;
use crate::packages::PackageBytes;
use crate::packages::check::{check, requirements};
use crate::signing::read_public_key;
use crate::terminal;

/// Size limit of firmware with its debug information. \[byte\]
const FIRMWARE_MAX: u64 = 64 << 20;

/// Slot and memory map.
#[derive(Debug, Args)]
struct Place {
    /// Slot to write: a or b
    #[arg(long, value_parser = slot)]
    slot: Slot,
    /// Memory map of the board
    #[arg(long)]
    memory: PathBuf,
    /// Public key of the node, which the package's signature must match
    #[arg(long)]
    key: Option<PathBuf>,
}

/// Arguments of `weights image`.
#[derive(Debug, Args)]
pub(in crate::commands) struct Arguments {
    /// Weight package
    package: PathBuf,
    #[command(flatten)]
    place: Place,
    /// Make the node the package's agent, with the keys of this folder: the image then holds secrets
    #[arg(long, value_name = "FOLDER")]
    keys: Option<PathBuf>,
    /// Add firmware, an ELF file, for a blank board: the image then holds firmware, package and keys
    #[arg(long, value_name = "FIRMWARE", requires = "keys")]
    node: Option<PathBuf>,
    #[command(flatten)]
    passphrase: Passphrase,
    /// Format of the image; add `json` to print the result as JSON [default: that of --out's
    /// extension, else hex]
    #[arg(long, value_enum, value_delimiter = ',')]
    format: Vec<OutputFormat>,
    /// Chip family, for uf2: rp2040, rp2350-arm-s, rp2350-riscv, nrf52840, stm32f4 or a number
    #[arg(long)]
    family: Option<Uf2Family>,
    /// Chip, by its probe-rs name: checks the memory map against its flash, if known
    #[arg(long)]
    chip: Option<String>,
    /// File to write [default: the package's name with e.g. .slot-a.bin, with --keys .node.bin]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Format of the image or of the printed result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum OutputFormat {
    /// Raw bytes from the slot's address to the end of the weights region; overwrites everything in
    /// between
    Bin,
    /// Intel HEX
    Hex,
    /// Blocks for a USB bootloader
    Uf2,
    /// Printed result: text
    Text,
    /// Printed result: one JSON object
    Json,
}

/// Arguments of `flash`.
#[derive(Debug, Args)]
pub(in crate::commands) struct FlashArguments {
    /// Weight package
    package: PathBuf,
    #[command(flatten)]
    place: Place,
    /// Chip, by its probe-rs name (`probe-rs chip list`)
    #[arg(long)]
    chip: Option<String>,
    /// Debug probe, as named by `probe-rs list`; required if there are several
    #[arg(long)]
    probe: Option<String>,
    /// probe-rs program [default: the one on PATH]
    #[arg(long)]
    probe_rs: Option<PathBuf>,
    /// Output format
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

fn slot(name: &str) -> Result<Slot, String> {
    match name {
        "a" | "A" => Ok(Slot::A),
        "b" | "B" => Ok(Slot::B),
        _ => Err("expected a or b".to_owned()),
    }
}

/// Creates the image of a package, after checking that a node would accept it. Returns the package,
/// too.
fn image(path: &Path, place: &Place) -> Result<(Image, PackageBytes), CommandError> {
    let region = MemoryMap::read(&place.memory)?.weights()?;
    let key = place.key.as_deref().map(read_public_key).transpose()?;
    let package = PackageBytes::load(path)?;
    let requirements = requirements(key.as_slice(), None);
    check(&package, &requirements).map_err(|refusal| CommandError::refused(path, &refusal))?;
    Ok((Image::of_package(&region, place.slot, &package)?, package))
}

/// Adds the keys of the folder, and the firmware if there is any. Returns warnings, too.
fn provisioned(
    image: Image,
    package: &PackageBytes,
    folder: &Path,
    arguments: &Arguments,
) -> Result<(Image, Vec<String>), CommandError> {
    let keys = arguments.passphrase.folder(folder)?;
    let agent = package.package().node.agent;
    let operators = keys.operators().for_nodes()?;
    let mut image = image.provision(keys.fleet(), operators.as_deref(), agent, epoch_now())?;
    if let Some(path) = &arguments.node {
        let elf = read_limited(path, FIRMWARE_MAX).map_err(|error| {
            let text = format!("{}: {error}; pass the firmware's ELF file", path.display());
            CommandError::new(ErrorCode::Image, text).about(path)
        })?;
        image = image.with_firmware(&elf)?;
    }
    let mut warnings = vec![format!(
        "WARNING: this file holds the keys of agent {agent} and of the network. Keep it secret, write it \
         to one board only, and then delete it."
    )];
    let valid = keys.operators().valid_keys()?;
    if check(package, &requirements(&valid, None)).is_err() {
        warnings.push(format!(
            "WARNING: the package is not signed with an operator key of {}. Firmware with its public key \
             will not use it.",
            folder.display()
        ));
    }
    Ok((image, warnings))
}

pub(super) fn execute(arguments: &Arguments) -> Result<(), CommandError> {
    #[derive(Serialize)]
    struct Report {
        image: String,
        bytes: usize,
        slot: String,
        segments: Vec<Segment>,
        commands: Vec<Command>,
        /// Side effects of flashing tools.
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
        /// Formats the tool requires, if there is no command.
        needs: Vec<String>,
    }
    let (format, printed) = formats(arguments)?;
    let image_format = format.with_family(arguments.family)?;
    let (mut image, package) = image(&arguments.package, &arguments.place)?;
    let mut warnings = Vec::new();
    if let Some(folder) = &arguments.keys {
        (image, warnings) = provisioned(image, &package, folder, arguments)?;
    }
    let contradiction = match image_format {
        ImageFormat::Uf2(family) => contradiction(&image, family)?,
        _ => None,
    };
    if let Some(part) = arguments.chip.as_deref().and_then(Part::of_chip) {
        image.check_part(&part, false)?;
    }
    let bytes = image.encode(image_format)?;
    let ending = match (&arguments.keys, image.slot()) {
        (Some(_), _) => format!(".node.{format}"),
        (None, Slot::A) => format!(".slot-a.{format}"),
        (None, Slot::B) => format!(".slot-b.{format}"),
    };
    let out = arguments.out.clone().unwrap_or_else(|| renamed(&arguments.package, &ending));
    if arguments.keys.is_some() {
        write_secret(&out, |file| file.write_all(&bytes))?;
    } else {
        write_whole(&out, image_format.file_kind(), |file| file.write_all(&bytes))?;
    }
    let commands = commands_for(&image, &out, format);
    let mut notes = notes(&image, format);
    notes.splice(0..0, warnings.into_iter().chain(contradiction));
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
    text += "To write it to the chip, use one of\n";
    for command in &commands {
        text += &format!("  {command}\n");
    }
    print_text(&text)
}

/// Returns a warning if this chip family has no flash where the image is placed.
fn contradiction(image: &Image, family: Uf2Family) -> Result<Option<String>, CommandError> {
    let Some(part) = Part::of_family(family) else { return Ok(None) };
    match image.check_part(&part, true) {
        Ok(()) => Ok(None),
        Err(error @ ImageError::NotFlash { .. }) => {
            Ok(Some(format!("WARNING: {error}. Its bootloader would not write this file.")))
        }
        Err(error) => Err(error.into()),
    }
}

/// Returns notes on what tools may erase besides the image.
fn notes(image: &Image, format: image::Format) -> Vec<String> {
    let mut notes = Vec::new();
    if image.gap_holds_other_slot() {
        match format {
            image::Format::Bin => notes.push(
                "A bin file cannot have gaps, so this one erases the other slot; hex and uf2 leave it \
                 alone."
                    .to_owned(),
            ),
            image::Format::Hex => notes.push(
                "OpenOCD and st-flash fill the gap in a hex file, which erases the other slot."
                    .to_owned(),
            ),
            image::Format::Uf2 => {}
        }
    }
    notes.push(format!(
        "OpenOCD, st-flash, dfu-util, picotool and bootloaders erase whole sectors of the chip. If \
         these are larger than _weights_erase_size ({} bytes), their other contents are lost; \
         probe-rs restores them. --chip checks the map against the chip.",
        image.region().erase_size
    ));
    notes
}

/// Returns the image's format and the format of the printed result.
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
            let problem = "--format: give one of bin, hex and uf2, and optionally text or json";
            return Err(CommandError::usage(problem.to_owned()));
        }
    }
    let of_name = arguments.out.as_deref().map(|out| (out, image::Format::of_file(out)));
    let format =
        match (image, of_name) {
            (Some(asked), Some((out, Some(named)))) if asked != named => {
                return Err(CommandError::usage(format!(
                "{}: the extension means {named}, but --format is {asked}; give only one of them, \
                 or another name",
                out.display()
            )).about(out));
            }
            (Some(asked), _) => asked,
            (None, Some((_, Some(named)))) => named,
            (None, Some((out, None))) => {
                return Err(CommandError::usage(format!(
                "{}: unknown extension; give --format bin, hex or uf2, or a name ending in .bin, \
                 .hex or .uf2",
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
    interruption::listen(SecondSignal::Exit);
    let (image, _) = image(&arguments.package, &arguments.place)?;
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
            "Flashed {} into {}: {} bytes, verified\n",
            report.package, report.slot, report.bytes
        )),
    }
}
