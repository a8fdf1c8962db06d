//! Expressions of a linker script: unsigned 64-bit numbers, with the operator precedence of C.
//!
//! Overflow, which a linker would wrap around, is an error, because such an address is a mistake.

use super::Region;
use super::error::Fault;
use super::operators::apply;
use super::reader::Reader;
use super::tokens::Token;

/// Maximum nesting of parentheses, which bounds the stack.
const DEEPEST: usize = 64;

/// Binary operators, lowest precedence first, left-associative.
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
    /// Parses an expression, including `condition ? value : value`.
    pub(super) fn value(&mut self) -> Result<u64, Fault> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return Err(Fault::new(
                self.line(),
                format!("more than {DEEPEST} nested parentheses"),
                "move parts of the expression to separate symbols",
            ));
        }
        let condition = self.chain(0)?;
        let value = if self.take_if("?") {
            let yes = self.value()?;
            self.expect(":", "between the two values of a conditional")?;
            let no = self.value()?;
            if condition != 0 { yes } else { no }
        } else {
            condition
        };
        self.depth -= 1;
        Ok(value)
    }

    /// Parses operands at one level of precedence.
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
                    "/" | "%" => ("divides by 0", "use another divisor"),
                    "-" => ("is negative", "addresses and sizes must not be negative"),
                    _ => ("overflows 64 bits", "use smaller numbers"),
                };
                Fault::new(line, format!("{value:#x} {sign} {right:#x} {problem}"), hint)
            })?;
        }
    }

    /// Parses `~`, `!`, `-` and `+` in front of an operand.
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

    /// Parses a number, an earlier symbol, a function or a parenthesised expression.
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
                self.expect(")", "after the expression")?;
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
                format!("symbol `{name}` is not defined before this line"),
                "define it further up",
            ),
        })
    }

    /// Parses the arguments after `name(`.
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
                        Fault::new(line, problem, "use a smaller alignment, but not 0")
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
                    format!("unsupported function `{function}`"),
                    "use ORIGIN(region) or LENGTH(region)",
                ));
            }
        };
        self.expect(")", &format!("after the arguments of {name}"))?;
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
                format!("region `{name}` is not defined before this line"),
                "define it further up, in MEMORY",
            )
        })
    }
}
