//! Builds the firmware of the boards.

use std::{
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use object::{Object, ObjectSection};

use crate::{
    boards::{self, Board},
    compiler::{self, Compiler, cross_folder},
    step::{Failure, cargo_in, run},
};

/// Arguments of `cargo xtask firmware`.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Options {
    /// Names of boards; `all` for every board.
    boards: Vec<String>,
    variant: Variant,
}

/// Variant of a board's firmware.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Variant {
    /// 64 hexadecimal digits; packages must then be signed.
    pub(crate) public_key: Option<String>,
    /// The simulator provides plant, clock and link over the service port.
    pub(crate) in_the_loop: bool,
    /// A feature of the board's own.
    pub(crate) feature: Option<String>,
    /// Without the features that are on by default.
    pub(crate) without_keys: bool,
}

impl Variant {
    /// Returns the variants that run without a key.
    pub(crate) fn all(board: &Board) -> Vec<Self> {
        let in_the_loop = Self { in_the_loop: true, ..Self::default() };
        let with = |feature: &String| Self { feature: Some(feature.clone()), ..Self::default() };
        let mut variants: Vec<Self> = board.features.iter().map(with).collect();
        if board.name == boards::EMULATED {
            variants.push(Self { without_keys: true, ..Self::default() });
        } else {
            variants.push(in_the_loop); // The emulated board is always in the loop.
        }
        // Last, so that its program remains.
        variants.push(Self::default());
        variants
    }

    /// Selects this variant for a call of cargo; returns the name of the program.
    fn apply(&self, command: &mut Command, board: &Board) -> String {
        let mut name = board.name.clone();
        let features = [
            self.public_key.as_ref().map(|_| "signature"),
            self.in_the_loop.then_some("in-the-loop"),
            self.feature.as_deref(),
        ];
        for feature in features.into_iter().flatten() {
            command.args(["--features", feature]);
            name = format!("{name}-{feature}");
        }
        if self.without_keys {
            command.arg("--no-default-features");
            name.push_str("-without-keys");
        }
        if let Some(key) = &self.public_key {
            command.env("NODE_PUBLIC_KEY", key);
        }
        name
    }
}

impl Options {
    /// Reads the arguments after the task; `None` if they are invalid.
    pub(crate) fn read(arguments: &[&str]) -> Option<Self> {
        let mut options = Self { boards: Vec::new(), variant: Variant::default() };
        let mut arguments = arguments.iter();
        while let Some(&argument) = arguments.next() {
            match argument {
                "--board" => options.boards.push((*arguments.next()?).to_owned()),
                "--public-key" => {
                    options.variant.public_key = Some((*arguments.next()?).to_owned());
                }
                "--in-the-loop" => options.variant.in_the_loop = true,
                "--feature" => options.variant.feature = Some((*arguments.next()?).to_owned()),
                _ => return None,
            }
        }
        (!options.boards.is_empty()).then_some(options)
    }
}

/// Builds the firmware of the requested boards, and prints its paths.
///
/// # Errors
/// There is no such board or compiler, or the build fails.
pub(crate) fn firmware(options: &Options, debian: bool) -> Result<(), Failure> {
    let mut boards = Vec::new();
    for name in &options.boards {
        match name.as_str() {
            "all" => boards.extend(boards::all()?),
            name => boards.push(boards::find(name)?),
        }
    }
    let compiler = Compiler::find(&boards::targets(&boards), debian)?;
    for board in &boards {
        println!("firmware: {}", build(&compiler, board, &options.variant)?.display());
    }
    Ok(())
}

/// Builds the firmware of the emulated board.
///
/// # Errors
/// Same as for [`firmware`].
pub(crate) fn emulated(debian: bool) -> Result<(Board, PathBuf), Failure> {
    let board = boards::find(boards::EMULATED)?;
    let compiler = Compiler::find(&[&board.target], debian)?;
    let program = build(&compiler, &board, &Variant::default())?;
    Ok((board, program))
}

/// Installs what [`lint`] needs, where that is allowed.
///
/// # Errors
/// It is missing and cannot be installed.
pub(crate) fn install_for_lint(debian: bool) -> Result<(), Failure> {
    compiler::install_for(&boards::targets(&boards::all()?), debian).map(drop)
}

/// Runs clippy on every variant of every board.
///
/// # Errors
/// There is no compiler, or clippy finds something.
pub(crate) fn lint(debian: bool) -> Result<(), Failure> {
    let boards = boards::all()?;
    let compiler = Compiler::find(&boards::targets(&boards), debian)?;
    for board in &boards {
        for variant in Variant::all(board) {
            let mut clippy = cargo_in(&board.folder, "rustc");
            clippy.args(["--quiet", "--release"]);
            let name = variant.apply(&mut clippy, board);
            // Only for its lints: clippy's code is not that of the firmware, and is not linked.
            clippy.args(["--", "-Copt-level=0", "-Cdebuginfo=0", "-Clto=off", "-Clinker=true"]);
            run(
                &format!("clippy on {name}"),
                compiler.apply_clippy(&mut clippy)?,
                "follow clippy's suggestion, or allow the lint with a reason",
            )?;
        }
    }
    Ok(())
}

/// Builds one variant of a board's firmware and returns the program's path.
///
/// # Errors
/// The build fails, or the program is empty.
pub(crate) fn build(
    compiler: &Compiler,
    board: &Board,
    variant: &Variant,
) -> Result<PathBuf, Failure> {
    let mut command = cargo_in(&board.folder, "build");
    command.args(["--quiet", "--release"]);
    let name = variant.apply(&mut command, board);
    let built = build_with(compiler, board, &mut command, &format!("firmware for {name}"))?;
    // Copied, because another variant would overwrite it.
    let program = cross_folder().join("firmware").join(format!("{name}.elf"));
    let failed = |error| {
        Failure::new(format!("{}: {error}", program.display()), "check that the file is writable")
    };
    fs::create_dir_all(cross_folder().join("firmware")).map_err(failed)?;
    fs::copy(&built, &program).map_err(failed)?;
    Ok(program)
}

/// Runs a build of a board's crate and returns the path of the program, which is not empty.
///
/// # Errors
/// Same as for [`build`].
pub(crate) fn build_with(
    compiler: &Compiler,
    board: &Board,
    command: &mut Command,
    name: &str,
) -> Result<PathBuf, Failure> {
    run(
        name,
        compiler.apply(command),
        "see the error above; an undefined symbol the_firmware_has_a_path_that_panics means \
         that some code can panic",
    )?;
    let program = cross_folder().join(&board.target).join("release").join(&board.package);
    check_content(&program)?;
    Ok(program)
}

/// Checks that the program is not empty: linked without its script it has no sections in memory.
fn check_content(program: &Path) -> Result<(), Failure> {
    let failed = |problem: String| {
        Failure::new(
            format!("{}: {problem}", program.display()),
            "check that the board's Cargo.toml has `build = \"../build.rs\"`, which passes the linker \
             its script, and that its main.rs has `#[entry]`",
        )
    };
    let bytes = fs::read(program).map_err(|error| failed(error.to_string()))?;
    if is_empty(&bytes).map_err(failed)? {
        return Err(failed("the program is empty".to_owned()));
    }
    Ok(())
}

/// Whether a program lacks a vector table or code.
fn is_empty(bytes: &[u8]) -> Result<bool, String> {
    let file = object::File::parse(bytes).map_err(|error| error.to_string())?;
    let size = |name: &str| file.section_by_name(name).map_or(0, |section| section.size());
    Ok(size(".vector_table") == 0 || size(".text") == 0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn boards_and_variants_are_read_in_any_order() {
        let boards = vec!["a".to_owned(), "b".to_owned()];
        let variant = Variant {
            public_key: Some("00".to_owned()),
            in_the_loop: true,
            feature: Some("c".to_owned()),
            without_keys: false,
        };
        let arguments = "--public-key 00 --board a --in-the-loop --feature c --board b";
        let arguments: Vec<&str> = arguments.split(' ').collect();
        assert_eq!(Options::read(&arguments), Some(Options { boards, variant }));
        for wrong in [
            &[][..],
            &["--board"],
            &["--in-the-loop"],
            &["--board", "a", "b"],
            &["--board", "a", "--feature"],
        ] {
            assert_eq!(Options::read(wrong), None, "{wrong:?}");
        }
    }

    #[test]
    fn a_program_without_code_is_empty() {
        // A 32-bit ELF header for Arm, without sections.
        let mut header = [0; 52];
        header[..7].copy_from_slice(&[0x7f, b'E', b'L', b'F', 1, 1, 1]);
        (header[16], header[18], header[20], header[40]) = (2, 40, 1, 52);
        assert_eq!(is_empty(&header), Ok(true));
        assert!(is_empty(b"").is_err());
    }
}
