//! Inspects machine code for what must *not* be in it.
//!
//! Targets compute equal bits only if every operation rounds as IEEE 754 specifies and no other
//! implementation of a function is used. Two things would break that:
//!
//! - a fused multiply-add, which rounds once instead of twice. On Arm these are `vfma`, `vfms`,
//!   `vfnma`, `vfnms`. `vmla`, `vmls` and their negations are not fused: they round the product,
//!   then the sum (Armv7-M Architecture Reference Manual, A7.7).
//! - a function of the platform's math library, which rounds differently on every platform. This
//!   includes `fmin` and `fmax`, because it is unspecified which zero they return.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use crate::{
    compiler, packages,
    step::{Failure, on_path},
};

/// The Debian package with a disassembler and a linker for Arm.
pub(crate) const BINUTILS: &str = "binutils-arm-none-eabi";

/// Part of the name of every panicking function in Rust's library, in both mangling schemes.
const PANICKING: &str = "4core9panicking";

const FUSED: [&str; 4] = ["vfma", "vfms", "vfnma", "vfnms"];

/// Functions of the C library's `math.h`, without the suffix of their `float` variants. `sqrt` is
/// not among them, because IEEE 754 specifies it to the last bit.
const PLATFORM_MATHEMATICS: &str = "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign \
    cos cosh erf erfc exp exp10 exp2 expm1 fabs fdim floor fma fmax fmin fmod frexp hypot ilogb \
    j0 j1 jn ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf nearbyint \
    nextafter pow remainder remquo rint round roundeven scalbn sin sincos sinh tan tanh tgamma \
    trunc y0 y1 yn";

/// The result of an inspection.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Findings {
    /// Number of instructions.
    pub(crate) instructions: usize,
    /// Forbidden instructions and symbols, each with its function.
    pub(crate) forbidden: Vec<String>,
    /// Symbols of the library's panics. Only in a linked program do they show that a panic is
    /// reachable.
    pub(crate) panics: Vec<String>,
}

/// A program that disassembles Arm code: GNU's or LLVM's `objdump`.
#[derive(Debug)]
pub(crate) struct Disassembler(PathBuf);

impl Disassembler {
    /// Finds a disassembler, or installs one where that is allowed.
    ///
    /// # Errors
    /// There is no disassembler.
    pub(crate) fn find(debian: bool) -> Result<Self, Failure> {
        const GNU: &str = "arm-none-eabi-objdump";
        if on_path(GNU) {
            return Ok(Self(GNU.into()));
        }
        if let Some(llvm) = compiler::toolchain_programs().map(|bin| bin.join("llvm-objdump"))
            && llvm.exists()
        {
            return Ok(Self(llvm));
        }
        if packages::allowed(debian) {
            packages::install(&[BINUTILS])?;
            return Ok(Self(GNU.into()));
        }
        Err(Failure::new(
            "no disassembler for Arm found",
            format!("rustup component add llvm-tools   (or install {BINUTILS})"),
        ))
    }

    /// Inspects an object, a library or a program.
    ///
    /// # Errors
    /// The disassembler failed.
    pub(crate) fn read(&self, file: &Path) -> Result<Findings, Failure> {
        Ok(findings(&self.listing(file)?))
    }

    /// Returns the disassembler's output for an object, a library or a program: symbols and code.
    ///
    /// # Errors
    /// The disassembler failed.
    pub(crate) fn listing(&self, file: &Path) -> Result<String, Failure> {
        let failed = |reason: String| {
            Failure::new(
                format!("{} {}: {reason}", self.0.display(), file.display()),
                "delete the target folder and try again",
            )
        };
        let output = Command::new(&self.0)
            .args(["-d", "-t", "--no-show-raw-insn"])
            .arg(file)
            .output()
            .map_err(|error| failed(error.to_string()))?;
        if !output.status.success() {
            return Err(failed(String::from_utf8_lossy(&output.stderr).into_owned()));
        }
        Ok(String::from_utf8_lossy(&output.stdout).into_owned())
    }
}

fn findings(listing: &str) -> Findings {
    let mut found = Findings::default();
    let mut function = "?";
    for line in listing.lines() {
        let symbol = line.split_whitespace().next_back();
        if let Some(symbol) = symbol.filter(|name| name.contains(PANICKING)) {
            // Names in the symbol table; labels in the code end differently.
            if !symbol.ends_with([':', '>']) {
                found.panics.push(symbol.to_owned());
            }
        }
        if let Some(symbol) = undefined_symbol(line) {
            if is_platform_mathematics(symbol) {
                found.forbidden.push(format!("undefined symbol {symbol}"));
            }
        } else if let Some(label) = line.strip_suffix(">:") {
            function = label.split_once('<').map_or(label, |(_, name)| name);
        } else if let Some(mnemonic) = mnemonic(line) {
            found.instructions += 1;
            if FUSED.iter().any(|fused| mnemonic.starts_with(fused)) {
                found.forbidden.push(format!("{mnemonic} in {function}"));
            }
        }
    }
    found
}

/// Parses a line of the symbol table, such as `00000000         *UND*  00000000 .hidden name`.
fn undefined_symbol(line: &str) -> Option<&str> {
    line.contains("*UND*").then(|| line.split_whitespace().next_back())?
}

/// Parses `   1c:   vmul.f32   s0, s1, s2`; `None` for data among the code (`.word`).
fn mnemonic(line: &str) -> Option<&str> {
    let (address, rest) = line.trim_start().split_once(':')?;
    let is_address = !address.is_empty() && address.bytes().all(|byte| byte.is_ascii_hexdigit());
    rest.split_whitespace().next().filter(|word| is_address && !word.starts_with(['.', '<']))
}

fn is_platform_mathematics(symbol: &str) -> bool {
    let mut names = PLATFORM_MATHEMATICS.split_whitespace();
    names.any(|name| symbol == name || symbol.strip_suffix('f') == Some(name))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What GNU's and LLVM's `objdump` print, shortened.
    const GNU: &str = "
lib.rmeta:     file format elf32-littlearm
00000000         *UND*\t00000000 .hidden tanhf
00000000         *UND*\t00000000 __aeabi_memcpy4
00000000 l     F .text.f\t0000000c f
00000010 l     F .text\t00000004 _ZN4core9panicking9panic_fmt17h0123456789abcdefE
00000000 <f>:
   0:\tvmla.f32\ts0, s1, s2
   4:\tvfmaeq.f32\ts0, s1, s2
   8:\tbl\t10 <_ZN4core9panicking9panic_fmt17h0123456789abcdefE>
   c:\t.word\t0x3f800000
";
    const LLVM: &str = "
00000000         *UND*\t00000000 fmaf
00000000 <g>:
       0:      \tvfnms.f32\ts0, s1, s2
       4:      \tbx\tlr
";

    #[test]
    fn fused_instructions_and_platform_functions_are_found() {
        let expected =
            |list: &[&str]| list.iter().map(|&entry| entry.to_owned()).collect::<Vec<_>>();
        assert_eq!(
            findings(GNU),
            Findings {
                instructions: 3,
                forbidden: expected(&["undefined symbol tanhf", "vfmaeq.f32 in f"]),
                panics: expected(&["_ZN4core9panicking9panic_fmt17h0123456789abcdefE"]),
            }
        );
        assert_eq!(
            findings(LLVM),
            Findings {
                instructions: 2,
                forbidden: expected(&["undefined symbol fmaf", "vfnms.f32 in g"]),
                panics: Vec::new(),
            }
        );
    }

    #[test]
    fn only_whole_names_count() {
        for name in ["fma", "fmaf", "expf", "exp", "fmaxf"] {
            assert!(is_platform_mathematics(name), "{name}");
        }
        for name in ["sqrtf", "_ZN4libm5tanhf17hE", "__aeabi_fmul", "f", "format"] {
            assert!(!is_platform_mathematics(name), "{name}");
        }
    }
}
