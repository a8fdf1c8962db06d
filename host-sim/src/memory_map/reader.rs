//! Reads the statements of a memory map and evaluates them in their order.

use super::error::Fault;
use super::tokens::{Token, tokens};
use super::{ADDRESSES, MemoryMap, Region, Symbol};

/// Parentheses within parentheses; more are a mistake, and each costs stack.
const DEEPEST: usize = 64;

/// Reads `text`; the map does not know yet from which file it is.
pub(super) fn read(text: &str) -> Result<MemoryMap, Fault> {
    let mut reader = Reader {
        tokens: tokens(text)?,
        next: 0,
        depth: 0,
        map: MemoryMap { file: String::new(), regions: Vec::new(), symbols: Vec::new() },
    };
    while *reader.peek() != Token::End {
        reader.statement()?;
    }
    Ok(reader.map)
}

struct Reader {
    tokens: Vec<(Token, usize)>,
    next: usize,
    depth: usize,
    map: MemoryMap,
}

impl Reader {
    fn peek(&self) -> &Token {
        &self.tokens[self.next].0
    }

    fn line(&self) -> usize {
        self.tokens[self.next].1
    }

    fn take_if(&mut self, sign: &str) -> bool {
        let there = matches!(self.peek(), Token::Sign(found) if *found == sign);
        if there {
            self.next += 1;
        }
        there
    }

    fn expect(&mut self, sign: &str, place: &str) -> Result<(), Fault> {
        if self.take_if(sign) { Ok(()) } else { Err(self.unexpected(&format!("`{sign}` {place}"))) }
    }

    fn unexpected(&self, expected: &str) -> Fault {
        Fault::new(self.line(), format!("found {}", self.peek()), format!("expected {expected}"))
    }

    fn word(&mut self, expected: &str) -> Result<String, Fault> {
        let Token::Word(word) = self.peek() else { return Err(self.unexpected(expected)) };
        let word = word.clone();
        self.next += 1;
        Ok(word)
    }

    fn statement(&mut self) -> Result<(), Fault> {
        const STATEMENTS: &str =
            "MEMORY { ... }, ASSERT(condition, \"message\"); or symbol = value;";
        if self.take_if(";") {
            return Ok(());
        }
        let line = self.line();
        let word = self.word(STATEMENTS)?;
        match (word.as_str(), self.peek()) {
            ("MEMORY", _) => self.memory(),
            ("ASSERT", _) => self.assertion(line).map_err(|fault| fault.about("ASSERT")),
            (".", _) => Err(Fault::new(
                line,
                "found `.`, the place where the linker stands",
                "expected a symbol with a name; a memory map places nothing",
            )),
            (name, Token::Sign("=")) => {
                self.next += 1;
                self.assignment(name, line).map_err(|fault| fault.about(name))
            }
            (_, found) => Err(Fault::new(
                line,
                format!("found `{word}` and then {found}"),
                format!("expected {STATEMENTS}"),
            )),
        }
    }

    fn assignment(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        if let Some(first) = self.map.symbols.iter().find(|symbol| symbol.name == name) {
            return Err(Fault::new(
                line,
                format!("already has a value, from line {}", first.line),
                "give every symbol one value",
            ));
        }
        let value = self.value()?;
        self.expect(";", "behind the value")?;
        self.map.symbols.push(Symbol { name: name.to_owned(), value, line });
        Ok(())
    }

    fn assertion(&mut self, line: usize) -> Result<(), Fault> {
        self.expect("(", "behind ASSERT")?;
        let holds = self.value()? != 0;
        self.expect(",", "behind the condition")?;
        let Token::Text(message) = self.peek() else {
            return Err(self.unexpected("the message, in quotes"));
        };
        let message = message.clone();
        self.next += 1;
        self.expect(")", "behind the message")?;
        self.take_if(";");
        if holds {
            return Ok(());
        }
        Err(Fault::new(
            line,
            format!("does not hold: {message}"),
            "change the regions or symbols that the condition names",
        ))
    }

    fn memory(&mut self) -> Result<(), Fault> {
        self.expect("{", "behind MEMORY")?;
        while !self.take_if("}") {
            let line = self.line();
            let name = self.word("the name of a region or `}`")?;
            self.region(&name, line).map_err(|fault| fault.about(&name))?;
        }
        Ok(())
    }

    /// `NAME (attributes)? : ORIGIN = value, LENGTH = value`.
    fn region(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        if let Some(first) = self.map.regions.iter().find(|region| region.name == name) {
            return Err(Fault::new(
                line,
                format!("there already is a region of this name, on line {}", first.line),
                "give every region a name of its own",
            ));
        }
        if self.take_if("(") {
            // Which sections may go there is the linker's business.
            while !self.take_if(")") {
                if !self.take_if("!") {
                    self.word("attributes such as rx, and `)`")?;
                }
            }
        }
        self.expect(":", "behind the name of a region")?;
        let origin = self.named_value(&["ORIGIN", "org", "o"])?;
        self.take_if(",");
        let length = self.named_value(&["LENGTH", "len", "l"])?;
        let Some(origin) = u32::try_from(origin).ok() else {
            return Err(Fault::new(
                line,
                format!("ORIGIN is {origin:#x}, which is no 32-bit address"),
                "choose one below 0x100000000",
            ));
        };
        if length > ADDRESSES - u64::from(origin) {
            return Err(Fault::new(
                line,
                format!("{length:#x} bytes from {origin:#x} on end behind the last 32-bit address"),
                "choose a smaller LENGTH",
            ));
        }
        self.map.regions.push(Region { name: name.to_owned(), origin, length, line });
        Ok(())
    }

    /// `ORIGIN = value` under one of its spellings.
    fn named_value(&mut self, spellings: &[&str; 3]) -> Result<u64, Fault> {
        let [long, middle, short] = spellings;
        match self.peek() {
            Token::Word(word) if spellings.contains(&word.as_str()) => self.next += 1,
            _ => return Err(self.unexpected(&format!("{long} = value (or {middle}, or {short})"))),
        }
        self.expect("=", &format!("behind {long}"))?;
        self.value()
    }

    /// `equality`, the loosest binding.
    fn value(&mut self) -> Result<u64, Fault> {
        self.depth += 1;
        if self.depth > DEEPEST {
            return Err(Fault::new(
                self.line(),
                format!("more than {DEEPEST} parentheses within each other"),
                "give parts of the expression names of their own",
            ));
        }
        let value = self.chain(&["==", "!="], |reader| {
            reader.chain(&["<=", ">=", "<", ">"], |reader| {
                reader.chain(&["+", "-"], |reader| reader.chain(&["*", "/", "%"], Self::operand))
            })
        });
        self.depth -= 1;
        value
    }

    /// Operands of one strength, joined from the left.
    fn chain(
        &mut self,
        signs: &[&'static str],
        operand: impl Fn(&mut Self) -> Result<u64, Fault>,
    ) -> Result<u64, Fault> {
        let mut value = operand(self)?;
        loop {
            let line = self.line();
            let sign = match self.peek() {
                Token::Sign(sign) if signs.contains(sign) => *sign,
                _ => return Ok(value),
            };
            self.next += 1;
            let right = operand(self)?;
            value = apply(sign, value, right).ok_or_else(|| {
                let (problem, mend) = match sign {
                    "/" | "%" => ("divides by 0", "divide by something else"),
                    "-" => ("is negative", "subtract less: addresses and sizes count from 0"),
                    _ => ("needs more than 64 bits", "use smaller numbers"),
                };
                Fault::new(line, format!("{value:#x} {sign} {right:#x} {problem}"), mend)
            })?;
        }
    }

    /// A number, an earlier symbol, `ORIGIN(X)`, `LENGTH(X)` or something in parentheses.
    fn operand(&mut self) -> Result<u64, Fault> {
        let line = self.line();
        match self.peek() {
            Token::Number(number) => {
                let number = *number;
                self.next += 1;
                Ok(number)
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
                match (word.as_str(), self.take_if("(")) {
                    ("ORIGIN" | "LENGTH", true) => self.of_region(&word),
                    (function, true) => Err(Fault::new(
                        line,
                        format!("found the function `{function}`"),
                        "expected ORIGIN(region) or LENGTH(region)",
                    )),
                    (name, false) => {
                        let symbol = self.map.symbols.iter().find(|symbol| symbol.name == name);
                        symbol.map(|symbol| symbol.value).ok_or_else(|| {
                            Fault::new(
                                line,
                                format!("the symbol `{name}` has no value up to here"),
                                "give it one further up",
                            )
                        })
                    }
                }
            }
            _ => Err(self.unexpected("a number, a symbol, ORIGIN(region), LENGTH(region) or `(`")),
        }
    }

    /// What stands behind `ORIGIN(`.
    fn of_region(&mut self, what: &str) -> Result<u64, Fault> {
        let line = self.line();
        let name = self.word("the name of a region")?;
        self.expect(")", "behind the name of a region")?;
        let Some(region) = self.map.regions.iter().find(|region| region.name == name) else {
            return Err(Fault::new(
                line,
                format!("there is no region `{name}` up to here"),
                "describe it further up, in MEMORY",
            ));
        };
        Ok(if what == "ORIGIN" { region.origin.into() } else { region.length })
    }
}

/// Comparisons give 0 or 1; `None` if the result is no number from 0 to 2^64 - 1.
fn apply(sign: &str, left: u64, right: u64) -> Option<u64> {
    match sign {
        "+" => left.checked_add(right),
        "-" => left.checked_sub(right),
        "*" => left.checked_mul(right),
        "/" => left.checked_div(right),
        "%" => left.checked_rem(right),
        "<" => Some((left < right).into()),
        "<=" => Some((left <= right).into()),
        ">" => Some((left > right).into()),
        ">=" => Some((left >= right).into()),
        "==" => Some((left == right).into()),
        "!=" => Some((left != right).into()),
        _ => None,
    }
}
