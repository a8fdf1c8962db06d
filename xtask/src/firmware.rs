//! The node's firmware, one binary a board.

use std::path::PathBuf;

use crate::{
    compiler::{Compiler, cross_folder},
    step::{Failure, cargo, run, workspace},
};

/// A board that the template has a file for.
#[derive(Debug)]
pub(crate) struct Board {
    /// Name of the file, of the feature, and of the binary.
    pub(crate) name: &'static str,
    pub(crate) target: &'static str,
    /// What runs a program on it, for cargo: the program's path comes behind.
    pub(crate) runner: &'static str,
    /// Where host-sim finds its service port, for a project's README.
    pub(crate) port: &'static str,
}

impl Board {
    /// Its memory map: the one at the top belongs to the board without one of its own.
    pub(crate) fn memory_map(&self) -> PathBuf {
        let own = workspace().join(format!("firmware-template/boards/{}.x", self.name));
        if own.exists() { own } else { workspace().join("memory.x") }
    }
}

/// The board that this machine can emulate.
pub(crate) const EMULATED: &str = "qemu-mps2-an386";

/// Every board of the template.
pub(crate) const BOARDS: [Board; 3] = [
    Board {
        name: EMULATED,
        target: "thumbv7em-none-eabihf",
        runner: "qemu-system-arm -machine mps2-an386 -display none -monitor none \
                 -serial unix:node.sock,server,nowait \
                 -semihosting-config enable=on,target=native,arg=node,arg=uart -kernel",
        port: "unix:node.sock",
    },
    Board {
        name: "stm32f405",
        target: "thumbv7em-none-eabihf",
        runner: "probe-rs run --chip STM32F405RGTx",
        port: "serial:/dev/ttyACM0",
    },
    Board {
        name: "nrf52840",
        target: "thumbv7em-none-eabihf",
        runner: "probe-rs run --chip nRF52840_xxAA",
        port: "serial:/dev/ttyACM0",
    },
];

/// What `cargo xtask firmware` is asked for.
#[derive(Debug)]
pub(crate) struct Options {
    boards: Vec<&'static Board>,
    /// 64 hexadecimal digits; packages then have to be signed.
    public_key: Option<String>,
}

impl Options {
    /// Reads the arguments after the task; `None` if they are none.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let mut options = Self { boards: Vec::new(), public_key: None };
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            let value = *arguments.next()?;
            match argument {
                "--board" if value == "all" => options.boards.extend(&BOARDS),
                "--board" => {
                    options.boards.push(BOARDS.iter().find(|board| board.name == value)?);
                }
                "--public-key" => options.public_key = Some(value.to_owned()),
                _ => return None,
            }
        }
        (!options.boards.is_empty()).then_some(options)
    }
}

/// Builds the firmware of the boards that were asked for, and prints where it is.
///
/// # Errors
/// There is no compiler, or the build fails.
pub(crate) fn firmware(options: &Options, debian: bool) -> Result<(), Failure> {
    let public_key = options.public_key.as_deref();
    let programs = options.boards.iter().map(|board| build(board, public_key, debian));
    for program in programs.collect::<Result<Vec<_>, _>>()? {
        println!("firmware: {}", program.display());
    }
    Ok(())
}

/// Builds the firmware of one board and returns the program.
///
/// # Errors
/// As [`firmware`].
pub(crate) fn build(
    board: &Board,
    public_key: Option<&str>,
    debian: bool,
) -> Result<PathBuf, Failure> {
    let compiler = Compiler::find(&[board.target], debian)?;
    let mut command = cargo("build");
    let features = match public_key {
        Some(_) => format!("{},signature", board.name),
        None => board.name.to_owned(),
    };
    command.args(["--quiet", "--profile", "firmware", "--package", "firmware-template"]);
    command.args(["--target", board.target, "--bin", board.name, "--features", &features]);
    if let Some(key) = public_key {
        command.env("NODE_PUBLIC_KEY", key);
    }
    run(
        &format!("firmware for {}", board.name),
        compiler.apply(&mut command),
        "the error above names the line; a symbol the_firmware_has_a_path_that_panics that is not \
         defined means what it says",
    )?;
    Ok(cross_folder().join(board.target).join("firmware").join(board.name))
}
