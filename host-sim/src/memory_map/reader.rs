//! Parses the statements of a memory map and evaluates them in order.
//!
//! Anything that places nothing in the weights region is left to the linker and skipped. A symbol
//! without a value here is an error only where the value is needed.

use super::error::Fault;
use super::operators::apply;
use super::tokens::{Token, tokens};
use super::weights::REGION as WEIGHTS;
use super::{ADDRESSES, MemoryMap, Region, Symbol};

const STATEMENTS: &str = "MEMORY { ... }, ASSERT(condition, \"message\"); or symbol = value;";

/// Parses `text`. The file name of the map is not set. Also returns, for each symbol without a
/// value, the reason.
pub(super) fn read(text: &str) -> Result<(MemoryMap, Vec<Fault>), Fault> {
    let tokens = tokens(text)?;
    let mut reader = Reader {
        tokens: &tokens,
        next: 0,
        depth: 0,
        map: MemoryMap {
            file: String::new(),
            regions: Vec::new(),
            symbols: Vec::new(),
            unresolved: Vec::new(),
            included: Vec::new(),
        },
        aliases: Vec::new(),
        unresolved: Vec::new(),
    };
    while *reader.peek() != Token::End {
        reader.statement()?;
    }
    Ok((reader.map, reader.unresolved))
}

/// State of the parser.
pub(super) struct Reader<'t> {
    tokens: &'t [(Token, usize)],
    pub(super) next: usize,
    pub(super) depth: usize,
    pub(super) map: MemoryMap,
    /// Aliases of regions.
    pub(super) aliases: Vec<(String, String)>,
    /// Assignments that cannot be evaluated here, by the name of their symbol.
    pub(super) unresolved: Vec<Fault>,
}

impl Reader<'_> {
    pub(super) fn peek(&self) -> &Token {
        &self.tokens[self.next].0
    }

    pub(super) fn line(&self) -> usize {
        self.tokens[self.next].1
    }

    pub(super) fn take_if(&mut self, sign: &str) -> bool {
        let there = matches!(self.peek(), Token::Sign(found) if *found == sign);
        if there {
            self.next += 1;
        }
        there
    }

    pub(super) fn expect(&mut self, sign: &str, place: &str) -> Result<(), Fault> {
        if self.take_if(sign) { Ok(()) } else { Err(self.unexpected(&format!("`{sign}` {place}"))) }
    }

    pub(super) fn unexpected(&self, expected: &str) -> Fault {
        let expected = format!("expected {expected}");
        match self.peek() {
            Token::BadNumber(word, problem, hint) => {
                Fault::new(self.line(), format!("`{word}` {problem}"), *hint)
            }
            found => Fault::new(self.line(), format!("found {found}"), expected),
        }
    }

    pub(super) fn word(&mut self, expected: &str) -> Result<String, Fault> {
        // A name may be quoted.
        let (Token::Word(word) | Token::Text(word)) = self.peek() else {
            return Err(self.unexpected(expected));
        };
        let word = word.clone();
        self.next += 1;
        Ok(word)
    }

    fn statement(&mut self) -> Result<(), Fault> {
        if self.take_if(";") {
            return Ok(());
        }
        let line = self.line();
        let word = self.word(STATEMENTS)?;
        match (word.as_str(), self.peek()) {
            ("MEMORY", _) => self.memory(),
            ("ASSERT", _) => self.assertion(line).map_err(|fault| fault.about("ASSERT")),
            ("REGION_ALIAS", _) => self.alias().map_err(|fault| fault.about("REGION_ALIAS")),
            ("PROVIDE" | "PROVIDE_HIDDEN" | "HIDDEN", Token::Sign("(")) => {
                self.provided(&word).map_err(|fault| fault.about(&word))
            }
            ("INCLUDE", _) => self.include(),
            ("INSERT", _) => {
                self.word("AFTER or BEFORE")?;
                self.word("the name of a section")?;
                Ok(())
            }
            (".", _) => self.skip_statement(),
            (_, Token::Sign("(" | "{")) => self.skip_block().map_err(|fault| fault.about(&word)),
            (name, Token::Sign("=")) => {
                self.next += 1;
                self.assignment(name, line).map_err(|fault| fault.about(name))
            }
            (name, Token::Sign("+=" | "-=" | "*=" | "/=" | "<<=" | ">>=" | "&=" | "|=" | "^=")) => {
                self.change(name, line).map_err(|fault| fault.about(name))
            }
            (_, found) => Err(Fault::new(
                line,
                format!("found `{word}` followed by {found}"),
                format!("expected {STATEMENTS}"),
            )),
        }
    }

    /// Parses `symbol = value;`, which may use values that only the linker knows.
    fn assignment(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        if let Some(first) = self.map.symbols.iter().find(|symbol| symbol.name == name) {
            return Err(Fault::new(
                line,
                format!("is already defined on line {}", first.line),
                "define each symbol once",
            ));
        }
        let start = self.next;
        let value = self.value().and_then(|value| {
            self.expect(";", "after the value")?;
            Ok(value)
        });
        match value {
            Ok(value) => {
                self.map.symbols.push(Symbol { name: name.to_owned(), value, line });
                Ok(())
            }
            Err(fault) => self.pass_over(fault, name, start),
        }
    }

    /// Parses `symbol += value;` and similar assignments.
    fn change(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        let Token::Sign(sign) = self.peek() else { return Err(self.unexpected(STATEMENTS)) };
        let operator = &sign[..sign.len() - 1];
        self.next += 1;
        let start = self.next;
        let value = self.value().and_then(|right| {
            self.expect(";", "after the value")?;
            let symbol = self.map.symbols.iter_mut().find(|symbol| symbol.name == name);
            let symbol = symbol.ok_or_else(|| {
                let problem = format!("symbol `{name}` is not defined before this line");
                Fault::new(line, problem, "define it further up")
            })?;
            symbol.value = apply(operator, symbol.value, right).ok_or_else(|| {
                let problem = format!("{:#x} {operator} {right:#x} is out of range", symbol.value);
                Fault::new(line, problem, "use other values")
            })?;
            Ok(())
        });
        match value {
            Ok(()) => Ok(()),
            Err(fault) => {
                self.map.symbols.retain(|symbol| symbol.name != name);
                self.pass_over(fault, name, start)
            }
        }
    }

    /// Continues after the assignment at `start`, which cannot be evaluated here.
    fn pass_over(&mut self, fault: Fault, name: &str, start: usize) -> Result<(), Fault> {
        (self.next, self.depth) = (start, 0);
        if self.skip_statement().is_err() {
            return Err(fault);
        }
        self.unresolved.push(Fault { name: Some(name.to_owned()), ..fault });
        Ok(())
    }

    /// Parses `PROVIDE(symbol = value);`: the value is used if there is no other definition.
    fn provided(&mut self, how: &str) -> Result<(), Fault> {
        self.expect("(", "after it")?;
        let line = self.line();
        let start = self.next;
        let name = self.word("the name of a symbol")?;
        self.expect("=", "after the name")?;
        let value = self.value().and_then(|value| {
            self.expect(")", "after the value")?;
            Ok(value)
        });
        match value {
            Ok(value) => {
                let known = self.map.symbols.iter().any(|symbol| symbol.name == name);
                if known && how == "HIDDEN" {
                    let problem = format!("`{name}` is already defined");
                    return Err(Fault::new(line, problem, "define each symbol once"));
                }
                if !known {
                    self.map.symbols.push(Symbol { name, value, line });
                }
            }
            Err(fault) => {
                // Back to the token after the opening parenthesis.
                (self.next, self.depth) = (start - 1, 0);
                self.skip_block().map_err(|_| fault.clone())?;
                self.unresolved.push(Fault { name: Some(name), ..fault });
            }
        }
        self.take_if(";");
        Ok(())
    }

    /// `REGION_ALIAS("NAME", REGION);`
    fn alias(&mut self) -> Result<(), Fault> {
        self.expect("(", "after REGION_ALIAS")?;
        let alias = self.word("the new name")?;
        self.expect(",", "after the new name")?;
        let region = self.word("the name of a region")?;
        self.expect(")", "after the name of a region")?;
        self.take_if(";");
        let of_alias = self.aliases.iter().find(|(known, _)| *known == region);
        let region = of_alias.map_or(region, |(_, real)| real.clone());
        self.aliases.push((alias, region));
        Ok(())
    }

    /// Parses `INCLUDE file`. The file is not read, but errors about missing symbols mention it.
    fn include(&mut self) -> Result<(), Fault> {
        let line = self.line();
        let mut file = String::new();
        // The file name extends to the end of the line.
        while self.line() == line && !matches!(self.peek(), Token::End | Token::Sign(";" | "}")) {
            match self.peek() {
                Token::Word(text) | Token::Text(text) | Token::BadNumber(text, ..) => file += text,
                Token::Number(number) => file += &number.to_string(),
                Token::Sign(sign) => file += sign,
                Token::Other(character) => file.push(*character),
                Token::End => {}
            }
            self.next += 1;
        }
        self.take_if(";");
        if file.is_empty() {
            return Err(self.unexpected("a file name after INCLUDE"));
        }
        self.map.included.push(file);
        Ok(())
    }

    fn assertion(&mut self, line: usize) -> Result<(), Fault> {
        let start = self.next;
        self.expect("(", "after ASSERT")?;
        let holds = match self.value() {
            Ok(value) => value != 0,
            // Such as sizes of sections, which the linker checks.
            Err(fault) => {
                (self.next, self.depth) = (start, 0);
                return self.skip_block().map_err(|_| fault);
            }
        };
        self.expect(",", "after the condition")?;
        let Token::Text(message) = self.peek() else {
            return Err(self.unexpected("the message, in quotes"));
        };
        let message = message.clone();
        self.next += 1;
        self.expect(")", "after the message")?;
        self.take_if(";");
        if holds {
            return Ok(());
        }
        Err(Fault::new(
            line,
            format!("assertion failed: {message}"),
            "change the regions or symbols in the condition",
        ))
    }

    /// Skips to the next `;` of this statement.
    fn skip_statement(&mut self) -> Result<(), Fault> {
        loop {
            match self.peek() {
                Token::Sign(";") => {
                    self.next += 1;
                    return Ok(());
                }
                Token::Sign("(") => self.skip_block()?,
                Token::Sign("{" | "}" | ")") | Token::End => {
                    return Err(self.unexpected("`;` after the value"));
                }
                _ => self.next += 1,
            }
        }
    }

    /// Skips `( ... )` or `{ ... }`, which must not place anything in the weights region.
    fn skip_block(&mut self) -> Result<(), Fault> {
        let start = self.line();
        let mut open = Vec::new();
        loop {
            match self.peek() {
                Token::Sign(sign @ ("(" | "{")) => open.push(if *sign == "(" { ")" } else { "}" }),
                Token::Sign(sign @ (")" | "}")) if open.pop() != Some(*sign) => {
                    return Err(self.unexpected("the matching closing parenthesis or brace"));
                }
                Token::Sign(">") => self.refuse_weights()?,
                Token::End => {
                    let problem = "has an unclosed parenthesis or brace";
                    return Err(Fault::new(start, problem, "close it"));
                }
                _ => {}
            }
            self.next += 1;
            if open.is_empty() {
                return Ok(());
            }
        }
    }

    /// Rejects `> WEIGHTS` after a section.
    fn refuse_weights(&self) -> Result<(), Fault> {
        let (Token::Word(name) | Token::Text(name)) = &self.tokens[self.next + 1].0 else {
            return Ok(());
        };
        let is_alias = |(alias, region): &(String, String)| alias == name && region == WEIGHTS;
        if name != WEIGHTS && !self.aliases.iter().any(is_alias) {
            return Ok(());
        }
        Err(Fault::new(
            self.line(),
            format!("places a section in {WEIGHTS}, where an update of the weights would erase it"),
            "place it in another region",
        ))
    }

    fn memory(&mut self) -> Result<(), Fault> {
        self.expect("{", "after MEMORY")?;
        while !self.take_if("}") {
            let line = self.line();
            let name = self.word("the name of a region or `}`")?;
            if name == "INCLUDE" {
                self.include()?;
                continue;
            }
            self.region(&name, line).map_err(|fault| fault.about(&name))?;
        }
        Ok(())
    }

    /// Parses `NAME (attributes)? : ORIGIN = value, LENGTH = value`.
    fn region(&mut self, name: &str, line: usize) -> Result<(), Fault> {
        if let Some(first) = self.map.regions.iter().find(|region| region.name == name) {
            return Err(Fault::new(
                line,
                format!("region is already defined on line {}", first.line),
                "use a different name for each region",
            ));
        }
        if self.take_if("(") {
            // The attributes matter to the linker only.
            while !self.take_if(")") {
                if !self.take_if("!") {
                    self.word("attributes such as rx, and `)`")?;
                }
            }
        }
        self.expect(":", "after the name of a region")?;
        let origin = self.named_value(&["ORIGIN", "org", "o"])?;
        self.take_if(",");
        let length = self.named_value(&["LENGTH", "len", "l"])?;
        let Some(origin) = u32::try_from(origin).ok() else {
            return Err(Fault::new(
                line,
                format!("ORIGIN is {origin:#x}, which is not a 32-bit address"),
                "use an address below 0x100000000",
            ));
        };
        if length > ADDRESSES - u64::from(origin) {
            return Err(Fault::new(
                line,
                format!("{length:#x} bytes from {origin:#x} exceed the 32-bit address space"),
                "use a smaller LENGTH",
            ));
        }
        self.map.regions.push(Region { name: name.to_owned(), origin, length, line });
        Ok(())
    }

    /// Parses `ORIGIN = value` in one of its spellings.
    fn named_value(&mut self, spellings: &[&str; 3]) -> Result<u64, Fault> {
        let [long, middle, short] = spellings;
        match self.peek() {
            Token::Word(word) if spellings.contains(&word.as_str()) => self.next += 1,
            _ => return Err(self.unexpected(&format!("{long} = value (or {middle}, or {short})"))),
        }
        self.expect("=", &format!("after {long}"))?;
        self.value()
    }
}
