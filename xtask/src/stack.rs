//! Determines a program's worst-case stack from the frames and calls in its machine code.
//!
//! A frame is the sum of everything a function subtracts from the stack pointer on any path, so it
//! is never less than what the function uses. The compiler's own figures (`-Zemit-stack-sizes`)
//! agree for every function of the firmware; they are not used because they require unstable
//! options, and because this reads the program that is actually shipped.

use std::collections::{BTreeMap, BTreeSet};

/// Frames and calls of all functions.
#[derive(Debug, Default)]
pub(crate) struct CallGraph {
    functions: BTreeMap<String, Function>,
    /// Names of functions by start address.
    starts: BTreeMap<u64, String>,
}

#[derive(Debug, Default)]
struct Function {
    /// \[byte\]
    frame: u32,
    callees: BTreeSet<String>,
    /// Whether it makes an indirect call.
    indirect: bool,
    /// Whether it moves the stack pointer by an amount in a register.
    dynamic: bool,
}

/// The deepest call path.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Deepest {
    /// \[byte\]
    pub(crate) depth: u32,
    /// The functions on the path with their frames, outermost first.
    pub(crate) path: Vec<(String, u32)>,
    /// Functions with calls that cannot be followed.
    pub(crate) indirect: BTreeSet<String>,
}

/// Why the stack is unbounded.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Unbounded {
    /// A function calls itself through these functions.
    Recursion(Vec<String>),
    /// The frame of this function has no fixed size.
    Dynamic(String),
    /// There is no such function.
    Missing(String),
}

impl CallGraph {
    /// Parses a disassembler's listing of Thumb code.
    pub(crate) fn read(listing: &str) -> Self {
        let mut graph = Self::default();
        let constants = constants(listing);
        for line in listing.lines() {
            if let Some((address, found)) = label(line) {
                graph.starts.insert(address, found.to_owned());
            }
        }
        let mut loaded = BTreeMap::new();
        let mut name = None;
        for line in listing.lines() {
            if let Some((_, found)) = label(line) {
                graph.functions.entry(found.to_owned()).or_default();
                name = Some(found.to_owned());
                loaded.clear();
            } else if let Some(name) = &name
                && let Some((mnemonic, operands)) = instruction(line)
                && let Some(function) = graph.functions.get_mut(name)
            {
                if mnemonic.starts_with("ldr")
                    && operands.contains("[pc")
                    && let Some(register) = operands.split(',').next()
                    && let Some(constant) = loaded_from(line).and_then(|at| constants.get(&at))
                {
                    loaded.insert(register.to_owned(), *constant);
                }
                function.notice(name, mnemonic, operands, &loaded, &graph.starts);
            }
        }
        graph
    }

    /// Returns the function that starts at an address, ignoring the Thumb bit.
    pub(crate) fn at(&self, address: u64) -> Option<&str> {
        self.starts.get(&(address & !1)).map(String::as_str)
    }

    /// Returns the deepest call path from `entry`.
    ///
    /// # Errors
    /// The stack is unbounded.
    pub(crate) fn deepest(&self, entry: &str) -> Result<Deepest, Unbounded> {
        let mut known = BTreeMap::new();
        let mut indirect = BTreeSet::new();
        let depth = self.depth(entry, &mut Vec::new(), &mut known, &mut indirect)?;
        let mut path = Vec::new();
        let mut name = entry;
        while let Some(function) = self.functions.get(name) {
            path.push((name.to_owned(), function.frame));
            let callees = function.callees.iter().filter_map(|callee| known.get_key_value(callee));
            match callees.max_by_key(|(_, depth)| **depth) {
                Some((callee, _)) => name = callee,
                None => break,
            }
        }
        Ok(Deepest { depth, path, indirect })
    }

    fn depth(
        &self,
        name: &str,
        way: &mut Vec<String>,
        known: &mut BTreeMap<String, u32>,
        indirect: &mut BTreeSet<String>,
    ) -> Result<u32, Unbounded> {
        if let Some(depth) = known.get(name) {
            return Ok(*depth);
        }
        let function =
            self.functions.get(name).ok_or_else(|| Unbounded::Missing(name.to_owned()))?;
        if function.dynamic {
            return Err(Unbounded::Dynamic(name.to_owned()));
        }
        way.push(name.to_owned());
        if function.indirect {
            indirect.insert(name.to_owned());
        }
        let mut below = 0;
        for callee in &function.callees {
            if way.contains(callee) {
                return Err(Unbounded::Recursion(way.clone()));
            }
            below = below.max(self.depth(callee, way, known, indirect)?);
        }
        way.pop();
        let depth = function.frame + below;
        known.insert(name.to_owned(), depth);
        Ok(depth)
    }
}

impl Function {
    fn notice(
        &mut self,
        own: &str,
        mnemonic: &str,
        operands: &str,
        loaded: &BTreeMap<String, u32>,
        starts: &BTreeMap<u64, String>,
    ) {
        let base = mnemonic.split('.').next().unwrap_or(mnemonic);
        match base {
            "push" | "vpush" => self.frame += register_bytes(operands),
            "stmdb" | "vstmdb" if operands.starts_with("sp!") => {
                self.frame += register_bytes(operands);
            }
            "sub" | "subw" if operands.starts_with("sp") => match constant(operands) {
                Some(bytes) => self.frame += bytes,
                None => self.dynamic = true,
            },
            // Cortex-M0: a frame too large for an instruction comes from a constant.
            "add" if operands.starts_with("sp, r") => {
                let register = operands.trim_start_matches("sp, ");
                match loaded.get(register).map(|&constant| constant.cast_signed()) {
                    Some(bytes) if bytes < 0 => self.frame += bytes.unsigned_abs(),
                    Some(_) => {}
                    None => self.dynamic = true,
                }
            }
            "str" | "strd" if operands.ends_with("]!") && operands.contains("[sp, #-") => {
                self.frame += constant(operands).unwrap_or(8);
            }
            "blx" | "bx" if operands.starts_with('r') || operands.starts_with("ip") => {
                self.indirect = true;
            }
            _ if base.starts_with('b') && !base.starts_with("bf") && !base.starts_with("bic") => {
                // A jump to another function is a call after the frame has been freed; counting
                // both is safe.
                if let Some(target) = target(operands, starts).filter(|target| *target != own) {
                    self.callees.insert(target.to_owned());
                }
            }
            _ => {}
        }
    }
}

/// Returns address and name in `00000400 <main>:`.
fn label(line: &str) -> Option<(u64, &str)> {
    let (address, name) = line.strip_suffix(">:")?.split_once('<')?;
    Some((u64::from_str_radix(address.trim(), 16).ok()?, name))
}

/// Returns the function at whose start a jump to `2000 <name>` ends. The name may be that of a
/// constant with the same value, such as a length in `memory.x`, so the address decides.
fn target<'s>(operands: &str, starts: &'s BTreeMap<u64, String>) -> Option<&'s str> {
    let (before, _) = operands.rsplit_once('<')?;
    let digits = before.trim_end().rsplit([' ', '\t']).next()?;
    let address = u64::from_str_radix(digits.trim_start_matches("0x"), 16).ok()?;
    starts.get(&address).map(String::as_str)
}

/// Returns the constants in the code, `606: .word 0x12345678`, by address.
fn constants(listing: &str) -> BTreeMap<u64, u32> {
    let constant = |line: &str| {
        let (address, rest) = line.trim_start().split_once(':')?;
        let (_, digits) = rest.trim().strip_prefix(".word")?.trim().split_once("0x")?;
        let digits = digits.get(..8)?;
        Some((u64::from_str_radix(address, 16).ok()?, u32::from_str_radix(digits, 16).ok()?))
    };
    listing.lines().filter_map(constant).collect()
}

/// Parses the address in the comment of `ldr r6, [pc, #8] @ (610 <f+0x10>)`.
fn loaded_from(line: &str) -> Option<u64> {
    let (_, comment) = line.rsplit_once('(').or_else(|| line.rsplit_once("@ 0x"))?;
    let digits = comment.split([' ', ')']).next()?;
    u64::from_str_radix(digits.trim_start_matches("0x"), 16).ok()
}

/// Splits `   1c:   vmul.f32   s0, s1, s2` into mnemonic and operands.
fn instruction(line: &str) -> Option<(&str, &str)> {
    let (address, rest) = line.trim_start().split_once(':')?;
    if address.is_empty() || !address.bytes().all(|byte| byte.is_ascii_hexdigit()) {
        return None;
    }
    let rest = rest.trim();
    let (mnemonic, operands) = rest.split_once(char::is_whitespace).unwrap_or((rest, ""));
    let operands = operands.split([';', '@']).next().unwrap_or(operands);
    (!mnemonic.starts_with(['.', '<'])).then_some((mnemonic, operands.trim()))
}

/// Returns the size of `{r4, r5, r6, lr}` or `{d8-d15}`. \[byte\]
fn register_bytes(operands: &str) -> u32 {
    let list = operands.split_once('{').map_or("", |(_, list)| list).trim_end_matches('}');
    let registers = list.split(',').map(str::trim).filter(|register| !register.is_empty());
    registers
        .map(|register| {
            let size = if register.starts_with('d') { 8 } else { 4 };
            let number = |name: &str| name.get(1..).and_then(|digits| digits.parse::<u32>().ok());
            let count = match register.split_once('-') {
                Some((first, last)) => {
                    number(last).zip(number(first)).map_or(16, |(last, first)| last - first + 1)
                }
                None => 1,
            };
            size * count
        })
        .sum()
}

/// Returns the last `#n` of the operands, without its sign.
fn constant(operands: &str) -> Option<u32> {
    let (_, number) = operands.rsplit_once('#')?;
    let number = number.trim_start_matches('-').trim_end_matches(['!', ']']).trim();
    match number.strip_prefix("0x") {
        Some(digits) => u32::from_str_radix(digits, 16).ok(),
        None => number.parse().ok(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LISTING: &str = "
00000400 <main>:
     400:\tpush\t{r4, r5, r7, lr}
     402:\tvpush\t{d8-d9}
     404:\tsub.w\tsp, sp, #0x100
     408:\tbl\t500 <left>
     40c:\tbl\t600 <right>\t@ imm = #0x1f0
     410:\tbeq.n\t408 <main+0x8>
00000500 <left>:
     500:\tstr.w\tlr, [sp, #-4]!
     504:\tblx\tr3
     506:\tb.w\t600 <right>
00000600 <right>:
     600:\tsub\tsp, #8
     602:\tbfi\tr0, r1, #0, #8
     604:\tbx\tlr
     606:\t.word\t0x12345678
";

    #[test]
    fn the_deepest_path_adds_up() {
        let deepest = CallGraph::read(LISTING).deepest("main").unwrap();
        assert_eq!(deepest.depth, (16 + 16 + 256) + 4 + 8);
        let names: Vec<&str> = deepest.path.iter().map(|(name, _)| name.as_str()).collect();
        assert_eq!(names, ["main", "left", "right"]);
        assert!(deepest.indirect.iter().eq(["left"]));
    }

    #[test]
    fn a_constant_with_the_value_of_an_address_is_not_a_function() {
        let inside = LISTING.replace("408 <main+0x8>", "408 <_weights_slot_length>");
        let start = LISTING.replace("600 <right>\t@", "600 <_weights_slot_length>\t@");
        for listing in [inside, start] {
            let found = CallGraph::read(&listing).deepest("main");
            assert_eq!(found, CallGraph::read(LISTING).deepest("main"));
        }
    }

    #[test]
    fn a_large_frame_on_a_small_core_is_a_constant() {
        let listing = "
10000400 <large>:
10000400:\tpush\t{r4, lr}
10000402:\tldr\tr6, [pc, #8]\t@ (1000040c <large+0xc>)
10000404:\tadd\tsp, r6
10000406:\tldr\tr6, [pc, #8]\t@ (10000410 <large+0x10>)
10000408:\tadd\tsp, r6
1000040a:\tpop\t{r4, pc}
1000040c:\t.word\t0xfffffd00
10000410:\t.word\t0x00000300
";
        let graph = CallGraph::read(listing);
        assert_eq!(graph.deepest("large").unwrap().depth, 8 + 0x300);
        assert_eq!(graph.at(0x1000_0401), Some("large"));
        assert_eq!(graph.at(0x1000_0403), None);
        let unknown = CallGraph::read(&listing.replace("@ (1000040c", "@ (10000444"));
        assert_eq!(unknown.deepest("large"), Err(Unbounded::Dynamic("large".to_owned())));
    }

    #[test]
    fn an_unbounded_stack_is_reported() {
        let loops = LISTING
            .replace("bl\t500 <left>", "bl\t600 <right>")
            .replace("602:\tbfi\tr0, r1, #0, #8", "602:\tbl\t500 <left>");
        let expected = ["left", "right"].map(str::to_owned).to_vec();
        assert_eq!(CallGraph::read(&loops).deepest("left"), Err(Unbounded::Recursion(expected)));
        let dynamic = LISTING.replace("sub\tsp, #8", "sub.w\tsp, sp, r1");
        let expected = Err(Unbounded::Dynamic("right".to_owned()));
        assert_eq!(CallGraph::read(&dynamic).deepest("main"), expected);
        let expected = Err(Unbounded::Missing("nothing".to_owned()));
        assert_eq!(CallGraph::read(LISTING).deepest("nothing"), expected);
    }
}
