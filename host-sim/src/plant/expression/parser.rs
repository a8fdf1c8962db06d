//! Recursive-descent parser: one function per rule of the grammar.

use super::FUNCTIONS;
use super::function::Function;
use super::program::{Operation, Program};

/// Maximum nesting of rules, which bounds the parser's recursion.
const NESTING_MAX: usize = 64;

/// Why an expression cannot be parsed. Columns count characters from 1.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ExpressionError {
    /// Unexpected input.
    #[error("expected {expected} at column {column}, found {found}")]
    Unexpected {
        /// Column.
        column: usize,
        /// What is allowed there.
        expected: &'static str,
        /// What was found.
        found: String,
    },
    /// A name that is not a state, parameter, constant or function.
    #[error("unknown name `{name}` at column {column}")]
    UnknownName {
        /// The name.
        name: String,
        /// Column.
        column: usize,
        /// All known names.
        known: Vec<String>,
    },
    /// A function with too few or too many arguments.
    #[error("`{name}` at column {column} takes {expected} argument(s), found {found}")]
    ArgumentCount {
        /// The function.
        name: String,
        /// Column.
        column: usize,
        /// The number of arguments it takes.
        expected: usize,
        /// The number of arguments given.
        found: usize,
    },
    /// A number that is malformed or does not fit into an f64.
    #[error("`{text}` at column {column} is not a finite number")]
    Number {
        /// The number's text.
        text: String,
        /// Column.
        column: usize,
    },
    /// Too many nested parentheses or operations.
    #[error("nested too deeply")]
    TooDeep,
}

/// Compiles `text`.
pub(super) fn parse(
    text: &str,
    states: &[String],
    parameters: &[(String, f64)],
) -> Result<Program, ExpressionError> {
    let mut parser =
        Parser { text, position: 0, nesting: 0, states, parameters, program: Program::default() };
    parser.sum()?;
    if parser.peek().is_some() {
        return Err(parser.unexpected("an operator or the end of the expression"));
    }
    if parser.program.fits() { Ok(parser.program) } else { Err(ExpressionError::TooDeep) }
}

struct Parser<'a> {
    text: &'a str,
    /// Byte offset of the unread text.
    position: usize,
    nesting: usize,
    states: &'a [String],
    parameters: &'a [(String, f64)],
    program: Program,
}

impl<'a> Parser<'a> {
    fn sum(&mut self) -> Result<(), ExpressionError> {
        self.product()?;
        loop {
            let operation = match self.peek() {
                Some('+') => Operation::Add,
                Some('-') => Operation::Subtract,
                _ => return Ok(()),
            };
            self.skip();
            self.product()?;
            self.program.push(operation);
        }
    }

    fn product(&mut self) -> Result<(), ExpressionError> {
        self.signed()?;
        loop {
            let operation = match self.peek() {
                Some('*') => Operation::Multiply,
                Some('/') => Operation::Divide,
                _ => return Ok(()),
            };
            self.skip();
            self.signed()?;
            self.program.push(operation);
        }
    }

    /// Every recursive rule passes through here, so the nesting is checked here.
    fn signed(&mut self) -> Result<(), ExpressionError> {
        self.nesting += 1;
        if self.nesting > NESTING_MAX {
            return Err(ExpressionError::TooDeep);
        }
        match self.peek() {
            Some('-') => {
                self.skip();
                self.signed()?;
                self.program.push(Operation::Negate);
            }
            Some('+') => {
                self.skip();
                self.signed()?;
            }
            _ => self.power()?,
        }
        self.nesting -= 1;
        Ok(())
    }

    fn power(&mut self) -> Result<(), ExpressionError> {
        self.operand()?;
        if self.peek() == Some('^') {
            self.skip();
            self.signed()?;
            self.program.push(Operation::Power);
        }
        Ok(())
    }

    fn operand(&mut self) -> Result<(), ExpressionError> {
        match self.peek() {
            Some('(') => {
                self.skip();
                self.sum()?;
                self.expect(')', "`)` or an operator")
            }
            Some(c) if c.is_ascii_digit() || c == '.' => self.number(),
            Some(c) if c.is_ascii_alphabetic() || c == '_' => self.name(),
            _ => Err(self.unexpected("a number, a name or `(`")),
        }
    }

    fn number(&mut self) -> Result<(), ExpressionError> {
        let column = self.column();
        let rest = &self.text[self.position..];
        let bytes = rest.as_bytes();
        let digits = |mut at: usize| {
            while bytes.get(at).is_some_and(u8::is_ascii_digit) {
                at += 1;
            }
            at
        };
        let mut end = digits(0);
        if bytes.get(end) == Some(&b'.') {
            end = digits(end + 1);
        }
        if matches!(bytes.get(end), Some(b'e' | b'E')) {
            let sign = usize::from(matches!(bytes.get(end + 1), Some(b'+' | b'-')));
            let exponent_end = digits(end + 1 + sign);
            if exponent_end > end + 1 + sign {
                end = exponent_end;
            }
        }
        let text = &rest[..end];
        let value = text.parse().ok().filter(|value: &f64| value.is_finite());
        let value = value.ok_or_else(|| ExpressionError::Number { text: text.into(), column })?;
        self.position += end;
        self.program.push(Operation::Constant(value));
        Ok(())
    }

    fn name(&mut self) -> Result<(), ExpressionError> {
        let column = self.column();
        let rest = &self.text[self.position..];
        let end = rest.find(|c: char| !(c.is_ascii_alphanumeric() || c == '_'));
        let name = &rest[..end.unwrap_or(rest.len())];
        self.position += name.len();
        if let Some(function) = Function::named(name) {
            return self.call(name, column, function);
        }
        let operation = match name {
            "t" => Operation::Time,
            "pi" => Operation::Constant(core::f64::consts::PI),
            "e" => Operation::Constant(core::f64::consts::E),
            _ => self.variable(name, column)?,
        };
        self.program.push(operation);
        Ok(())
    }

    fn variable(&self, name: &str, column: usize) -> Result<Operation, ExpressionError> {
        let index = self.states.iter().position(|state| state == name);
        if let Some(index) = index.and_then(|index| u8::try_from(index).ok()) {
            return Ok(Operation::State(index));
        }
        match self.parameters.iter().find(|(parameter, _)| parameter == name) {
            Some(&(_, value)) => Ok(Operation::Constant(value)),
            None => Err(ExpressionError::UnknownName {
                name: name.to_owned(),
                column,
                known: self.known_names(),
            }),
        }
    }

    fn call(
        &mut self,
        name: &str,
        column: usize,
        function: Function,
    ) -> Result<(), ExpressionError> {
        self.expect('(', "`(` after a function")?;
        self.sum()?;
        let mut found = 1;
        while self.peek() == Some(',') {
            self.skip();
            self.sum()?;
            found += 1;
        }
        self.expect(')', "`)` or `,` or an operator")?;
        let expected = function.arguments();
        if found != expected {
            let name = name.to_owned();
            return Err(ExpressionError::ArgumentCount { name, column, expected, found });
        }
        self.program.push(match function {
            Function::Unary(function) => Operation::Unary(function),
            Function::Binary(function) => Operation::Binary(function),
        });
        Ok(())
    }

    fn expect(&mut self, wanted: char, expected: &'static str) -> Result<(), ExpressionError> {
        if self.peek() == Some(wanted) {
            self.skip();
            return Ok(());
        }
        Err(self.unexpected(expected))
    }

    /// Returns the next character that is not blank.
    fn peek(&mut self) -> Option<char> {
        let rest = &self.text[self.position..];
        let trimmed = rest.trim_start();
        self.position += rest.len() - trimmed.len();
        trimmed.chars().next()
    }

    /// Consumes the character that [`Self::peek`] returned.
    fn skip(&mut self) {
        let next = self.text[self.position..].chars().next();
        self.position += next.map_or(0, char::len_utf8);
    }

    fn column(&self) -> usize {
        self.text[..self.position].chars().count() + 1
    }

    fn unexpected(&mut self, expected: &'static str) -> ExpressionError {
        let found =
            self.peek().map_or("the end of the expression".to_owned(), |c| format!("`{c}`"));
        ExpressionError::Unexpected { column: self.column(), expected, found }
    }

    fn known_names(&self) -> Vec<String> {
        let states = self.states.iter().cloned();
        let parameters = self.parameters.iter().map(|(name, _)| name.clone());
        let fixed = ["t", "pi", "e"].into_iter().chain(FUNCTIONS).map(str::to_owned);
        states.chain(parameters).chain(fixed).collect()
    }
}
