//! User-defined expressions, such as `0.5*sin(3*t) - mu*x^3`.
//!
//! Grammar, loosest binding first:
//!
//! ```text
//! sum     = product { ("+" | "-") product }            from the left
//! product = signed  { ("*" | "/") signed }             from the left
//! signed  = [ "+" | "-" ] signed  |  power
//! power   = operand [ "^" signed ]                     from the right: 2^3^2 = 2^9
//! operand = number | name | function "(" sum { "," sum } ")" | "(" sum ")"
//! ```
//!
//! so `-x^2` is `-(x^2)`, as on paper. Numbers are written like `2`, `.5` or `1e-3`. A name is the
//! time `t`, a state, a known input, a parameter, `pi` or `e`; the functions are listed in [`FUNCTIONS`].
//!
//! An expression is compiled once into a program for a stack machine; parameters become constants,
//! and constant subexpressions are folded. An evaluation costs about 1 ns per operation plus the
//! functions called. It does not allocate: names are resolved and the stack depth is checked when
//! the text is parsed.
//!
//! No intermediate result may be infinite or NaN, even if the final value is finite: `max(sqrt(x -
//! 10), 0)` and `1/(1 + exp(1000*x))` are undefined wherever a part of them is undefined or
//! overflows. There the value is not finite, and [`ExpressionSystem::fault`] returns the operation
//! responsible.
//!
//! Invariant: the same bits on every machine. Functions come from the `libm` crate; a power with an
//! integer exponent is a product in a fixed order.

mod function;
mod hint;
mod parser;
mod program;

pub use function::FUNCTIONS;
pub use hint::hint;
pub use parser::ExpressionError;
pub use program::{STACK_DEPTH_MAX, integer_power};

use super::DIMENSION_MAX;
use crate::number::seconds;
use program::Program;

/// Names that a state or a parameter cannot have, in addition to the functions: time and constants.
const RESERVED: [&str; 3] = ["t", "pi", "e"];

/// One expression per component of a vector.
#[derive(Clone, Debug, PartialEq)]
pub struct ExpressionSystem {
    names: Vec<String>,
    /// Known inputs, functions of time that follow the states as variables.
    inputs: Option<Box<Self>>,
    texts: Vec<String>,
    programs: Vec<Program>,
}

/// An expression without a finite value: which one, where, and why.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error(
    "expression {} for {component}, `{text}`: {operation} is {}, at t = {}{}; {}",
    .index + 1,
    result_in_words(*.result, *.overflow),
    seconds(*.time),
    values_in_words(.values),
    fault_hint(*.overflow)
)]
pub struct ExpressionFault {
    /// Index of the expression, from 0.
    pub index: usize,
    /// The component of the state whose rate it gives.
    pub component: String,
    /// The expression.
    pub text: String,
    /// The first operation with a non-finite result, with its operands.
    pub operation: String,
    /// The result.
    pub result: f64,
    /// Whether the result overflowed, rather than being undefined.
    pub overflow: bool,
    /// Time of the evaluation. \[s\]
    pub time: f64,
    /// The states used in the expression, with their values.
    pub values: Vec<(String, f64)>,
}

fn result_in_words(result: f64, overflow: bool) -> &'static str {
    match (result.is_nan(), overflow) {
        (true, _) => "not a number",
        (false, true) => "too large",
        (false, false) => "infinite",
    }
}

fn values_in_words(values: &[(String, f64)]) -> String {
    let mut words = String::new();
    for (name, value) in values {
        let before = if words.is_empty() { " with " } else { ", " };
        words += &format!("{before}{name} = {value:?}");
    }
    words
}

fn fault_hint(overflow: bool) -> &'static str {
    if overflow {
        "rewrite it so that no part overflows, or keep its variables smaller"
    } else {
        "change the expression, or keep its variables within its domain"
    }
}

/// Identifies the faulty expression of a system.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("expression {}: {error}", .index + 1)]
pub struct SystemError {
    /// Index of the expression, from 0.
    pub index: usize,
    /// What is wrong.
    pub error: ExpressionError,
}

impl ExpressionSystem {
    /// Parses one expression per state. `parameters` are names and values.
    ///
    /// # Errors
    /// Returns the first expression that cannot be parsed or that uses an unknown name.
    ///
    /// # Panics
    /// If there are more states than a program can address (256).
    pub fn parse<S: AsRef<str>>(
        expressions: &[S],
        states: &[String],
        parameters: &[(String, f64)],
    ) -> Result<Self, SystemError> {
        let programs = programs(expressions, states, parameters)?;
        let texts = texts(expressions);
        Ok(Self { names: states.to_vec(), inputs: None, texts, programs })
    }

    /// Parses functions of time alone, with the names of their values.
    ///
    /// # Errors
    /// Same as [`Self::parse`].
    pub fn of_time<S: AsRef<str>>(
        expressions: &[S],
        names: &[String],
        parameters: &[(String, f64)],
    ) -> Result<Self, SystemError> {
        let programs = programs(expressions, &[], parameters)?;
        Ok(Self { names: names.to_vec(), inputs: None, texts: texts(expressions), programs })
    }

    /// Parses one expression per state, which may also use the values of `inputs`, functions of time.
    ///
    /// # Errors
    /// Same as [`Self::parse`].
    ///
    /// # Panics
    /// If there are more states and inputs than [`DIMENSION_MAX`].
    pub fn with_inputs<S: AsRef<str>>(
        expressions: &[S],
        states: &[String],
        inputs: Self,
        parameters: &[(String, f64)],
    ) -> Result<Self, SystemError> {
        let variables = [states, &inputs.names].concat();
        assert!(variables.len() <= DIMENSION_MAX, "at most {DIMENSION_MAX} states and inputs");
        let programs = programs(expressions, &variables, parameters)?;
        let inputs = (inputs.dimension() > 0).then(|| Box::new(inputs));
        Ok(Self { names: states.to_vec(), inputs, texts: texts(expressions), programs })
    }

    /// Returns the number of expressions.
    #[must_use]
    pub fn dimension(&self) -> usize {
        self.programs.len()
    }

    /// Returns the names of the states.
    #[must_use]
    pub fn state_names(&self) -> &[String] {
        &self.names
    }

    /// Returns the known inputs, if there are any.
    #[must_use]
    pub fn inputs(&self) -> Option<&Self> {
        self.inputs.as_deref()
    }

    /// Returns the names of the known inputs that no expression uses.
    #[must_use]
    pub fn unused_inputs(&self) -> Vec<&str> {
        let used: Vec<usize> = self.programs.iter().flat_map(Program::states).collect();
        let names = self.inputs.iter().flat_map(|inputs| &inputs.names).enumerate();
        let unused = names.filter(|(index, _)| !used.contains(&(self.names.len() + index)));
        unused.map(|(_, name)| name.as_str()).collect()
    }

    /// Returns the first expression without a finite value at `time` \[s\] and state `x`, shape
    /// `[n]`; `None` if all values are finite, or `x` itself is not.
    #[must_use]
    pub fn fault(&self, time: f64, x: &[f64]) -> Option<ExpressionFault> {
        if !x.iter().all(|x| x.is_finite()) {
            return None;
        }
        let variables = self.variables(time, x);
        let x = variables.as_ref().map_or(x, |variables| &variables[..]);
        let failures = self.programs.iter().map(|program| program.failure(time, x));
        let (index, failure) =
            failures.enumerate().find_map(|(index, failure)| Some((index, failure?)))?;
        let used = self.programs[index].states();
        let name = |variable: usize| {
            let inputs = self.inputs.iter().flat_map(|inputs| &inputs.names);
            self.names.iter().chain(inputs).nth(variable).cloned().unwrap_or_default()
        };
        Some(ExpressionFault {
            index,
            component: self.names.get(index).cloned().unwrap_or_default(),
            text: self.texts[index].clone(),
            operation: failure.operation,
            result: failure.result,
            overflow: failure.overflow,
            time,
            values: used.into_iter().map(|variable| (name(variable), x[variable])).collect(),
        })
    }

    /// Evaluates all expressions at `time` \[s\] and state `x` into `result`, shape `[dimension]`.
    /// Undefined expressions give a non-finite value.
    ///
    /// # Panics
    /// If `x` has fewer components than there are states.
    #[inline]
    pub fn evaluate(&self, time: f64, x: &[f64], result: &mut [f64]) {
        let variables = self.variables(time, x);
        let x = variables.as_ref().map_or(x, |variables| &variables[..]);
        for (result, program) in result.iter_mut().zip(&self.programs) {
            *result = program.evaluate(time, x);
        }
    }
}

impl ExpressionSystem {
    /// Returns the state followed by the known inputs, if there are any. All are NaN if an input is not
    /// finite, so that its fault is found even where nothing depends on it.
    #[inline]
    fn variables(&self, time: f64, x: &[f64]) -> Option<[f64; DIMENSION_MAX]> {
        let inputs = self.inputs.as_deref()?;
        let mut variables = [0.0; DIMENSION_MAX];
        let (states, rest) = variables.split_at_mut(self.names.len());
        states.copy_from_slice(&x[..states.len()]);
        let values = &mut rest[..inputs.dimension()];
        inputs.evaluate(time, &[], values);
        if !values.iter().all(|value| value.is_finite()) {
            variables.fill(f64::NAN);
        }
        Some(variables)
    }
}

/// Compiles expressions of these variables.
fn programs<S: AsRef<str>>(
    expressions: &[S],
    variables: &[String],
    parameters: &[(String, f64)],
) -> Result<Vec<Program>, SystemError> {
    assert!(variables.len() <= 256, "variables are addressed by one byte");
    let read = |(index, text): (usize, &S)| {
        parser::parse(text.as_ref(), variables, parameters)
            .map_err(|error| SystemError { index, error })
    };
    expressions.iter().enumerate().map(read).collect()
}

fn texts<S: AsRef<str>>(expressions: &[S]) -> Vec<String> {
    expressions.iter().map(|text| text.as_ref().to_owned()).collect()
}

/// Returns why `name` is not a valid name for a state or a parameter, worded to follow the name.
#[must_use]
pub fn name_problem(name: &str) -> Option<&'static str> {
    let mut letters = name.chars();
    let starts_well = letters.next().is_some_and(|c| c.is_ascii_alphabetic() || c == '_');
    if !starts_well || !letters.all(|c| c.is_ascii_alphanumeric() || c == '_') {
        return Some("is not a valid name");
    }
    match name {
        "t" => Some("is reserved for time"),
        _ if RESERVED.contains(&name) => Some("is a constant"),
        _ if FUNCTIONS.contains(&name) => Some("is a function"),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
