//! Values in a linker script: unsigned 64-bit numbers, operators as strong as in C.
//!
//! What wraps around in a linker is an error here: an address that does so is a mistake.

use super::Region;
use super::error::Fault;
use super::operators::apply;
use super::reader::Reader;
use super::tokens::Token;

/// Parentheses within parentheses; more are a mistake, and each costs stack.
const DEEPEST: usize = 64;

/// Binary operators, loosest binding first, each level from the left.
const LEVELS: [&[&str]; 10] = [
    &["||"],
    &["&&"],
    &["|"],
    &["^"],
    &["&"],
    &["==", "!="],
    &["<=", ">=", "<", ">"],
    &["<<", ">>"],
    &["+", "-"],
    &["*", "/", "%"],
];

impl Reader<'_> {
    /// A whole value: `condition ? value : value`, the loosest binding.
    pub(super) fn value(&mut self) -> Result<u64, Fault> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return Err(Fault::new(
                self.line(),
                format!("more than {DEEPEST} parentheses within each other"),
                "give parts of the expression names of their own",
            ));
        }
        let condition = self.chain(0)?;
        let value = if self.take_if("?") {
            let yes = self.value()?;
            self.expect(":", "between the two values of a condition")?;
            let no = self.value()?;
            if condition != 0 { yes } else { no }
        } else {
            condition
        };
        self.depth -= 1;
        Ok(value)
    }

    /// Operands of one strength.
    fn chain(&mut self, level: usize) -> Result<u64, Fault> {
        let Some(signs) = LEVELS.get(level) else { return self.signed() };
        let mut value = self.chain(level + 1)?;
        loop {
            let line = self.line();
            let sign = match self.peek() {
                Token::Sign(sign) if signs.contains(sign) => *sign,
                _ => return Ok(value),
            };
            self.next += 1;
            let right = self.chain(level + 1)?;
            value = apply(sign, value, right).ok_or_else(|| {
                let (problem, hint) = match sign {
                    "/" | "%" => ("divides by 0", "divide by something else"),
                    "-" => ("is negative", "subtract less: addresses and sizes count from 0"),
                    _ => ("needs more than 64 bits", "use smaller numbers"),
                };
                Fault::new(line, format!("{value:#x} {sign} {right:#x} {problem}"), hint)
            })?;
        }
    }

    /// `~`, `!`, `-` and `+` before an operand.
    fn signed(&mut self) -> Result<u64, Fault> {
        let mut signs = Vec::new();
        while let Token::Sign(sign @ ("~" | "!" | "-" | "+")) = self.peek() {
            signs.push(*sign);
            self.next += 1;
        }
        let mut value = self.operand()?;
        for sign in signs.into_iter().rev() {
            value = match sign {
                "~" => !value,
                "!" => u64::from(value == 0),
                "-" => value.wrapping_neg(),
                _ => value,
            };
        }
        Ok(value)
    }

    /// A number, an earlier symbol, a function or something in parentheses.
    fn operand(&mut self) -> Result<u64, Fault> {
        let line = self.line();
        match self.peek() {
            Token::Number(number) => {
                let number = *number;
                self.next += 1;
                Ok(number)
            }
            Token::BadNumber(word, problem, hint) => {
                Err(Fault::new(line, format!("`{word}` {problem}"), *hint))
            }
            Token::Sign("(") => {
                self.next += 1;
                let value = self.value()?;
                self.expect(")", "behind what it encloses")?;
                Ok(value)
            }
            Token::Word(word) => {
                let word = word.clone();
                self.next += 1;
                if self.take_if("(") {
                    self.function(&word, line)
                } else {
                    self.symbol(&word, line)
                }
            }
            _ => Err(self.unexpected("a number, a symbol, ORIGIN(region), LENGTH(region) or `(`")),
        }
    }

    fn symbol(&self, name: &str, line: usize) -> Result<u64, Fault> {
        if let Some(symbol) = self.map.symbols.iter().find(|symbol| symbol.name == name) {
            return Ok(symbol.value);
        }
        Err(match self.unresolved.iter().find(|fault| fault.name.as_deref() == Some(name)) {
            Some(fault) => fault.clone(),
            None => Fault::new(
                line,
                format!("the symbol `{name}` has no value up to here"),
                "give it one further up",
            ),
        })
    }

    /// What stands behind `name(`.
    fn function(&mut self, name: &str, line: usize) -> Result<u64, Fault> {
        let value = match name {
            "ORIGIN" | "LENGTH" => {
                let region = self.region_named()?;
                if name == "ORIGIN" { region.origin.into() } else { region.length }
            }
            "ABSOLUTE" => self.value()?,
            "MAX" | "MIN" | "ALIGN" => {
                let first = self.value()?;
                self.expect(",", "between two values")?;
                let second = self.value()?;
                match name {
                    "MAX" => first.max(second),
                    "MIN" => first.min(second),
                    _ => first.checked_next_multiple_of(second).ok_or_else(|| {
                        let problem = format!("{first:#x} cannot be aligned to {second:#x}");
                        Fault::new(line, problem, "choose a smaller number above 0")
                    })?,
                }
            }
            "DEFINED" => {
                let symbol = self.word("the name of a symbol")?;
                u64::from(self.map.symbols.iter().any(|known| known.name == symbol))
            }
            function => {
                return Err(Fault::new(
                    line,
                    format!("found the function `{function}`"),
                    "expected ORIGIN(region) or LENGTH(region)",
                ));
            }
        };
        self.expect(")", &format!("behind what {name} is applied to"))?;
        Ok(value)
    }

    fn region_named(&mut self) -> Result<Region, Fault> {
        let line = self.line();
        let name = self.word("the name of a region")?;
        let real = self.aliases.iter().find(|(alias, _)| *alias == name);
        let real = real.map_or(name.as_str(), |(_, region)| region);
        let region = self.map.regions.iter().find(|region| region.name == real);
        region.cloned().ok_or_else(|| {
            Fault::new(
                line,
                format!("there is no region `{name}` up to here"),
                "describe it further up, in MEMORY",
            )
        })
    }
}
