//! Compiled expressions: programs for a stack machine.

use super::function::{Binary, Unary};

/// Limit for intermediate results held at once.
pub const STACK_DEPTH_MAX: usize = 32;

/// One instruction. Operands are popped from the stack, the result is pushed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Operation {
    Constant(f64),
    Time,
    State(u8),
    Negate,
    Add,
    Subtract,
    Multiply,
    Divide,
    Power,
    IntegerPower(i32),
    Unary(Unary),
    Binary(Binary),
}

/// Operations in order of execution; exactly one result remains.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Program {
    operations: Vec<Operation>,
    /// Whether an operation may turn a non-finite operand into a finite result, as `1/x` and `max`
    /// do. If so, every intermediate result is checked, otherwise only the last.
    absorbs: bool,
}

/// The first operation of a program with a non-finite result.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Failure {
    /// The operation with its operands, such as `sqrt(-8.0)`.
    pub(super) operation: String,
    /// The result: infinite or NaN.
    pub(super) result: f64,
    /// Whether the result overflowed, rather than being undefined.
    pub(super) overflow: bool,
}

impl Program {
    /// Appends an operation. If all its operands are constants, appends its result instead, unless
    /// that is not finite.
    pub(super) fn push(&mut self, operation: Operation) {
        use Operation::{Add, Constant, Divide, IntegerPower, Multiply, Negate, Power, Subtract};
        let folded = match (operation, self.operations.as_slice()) {
            (Operation::Binary(function), [.., Constant(x), Constant(y)]) => {
                Some((2, function.apply(*x, *y)))
            }
            (Add, [.., Constant(x), Constant(y)]) => Some((2, x + y)),
            (Subtract, [.., Constant(x), Constant(y)]) => Some((2, x - y)),
            (Multiply, [.., Constant(x), Constant(y)]) => Some((2, x * y)),
            (Divide, [.., Constant(x), Constant(y)]) => Some((2, x / y)),
            (Power, [.., Constant(x), Constant(y)]) => Some((2, power(*x, *y))),
            (Negate, [.., Constant(x)]) => Some((1, -x)),
            (Operation::Unary(function), [.., Constant(x)]) => Some((1, function.apply(*x))),
            _ => None,
        };
        if let Some((operands, value)) = folded.filter(|(_, value)| value.is_finite()) {
            self.operations.truncate(self.operations.len() - operands);
            self.operations.push(Constant(value));
            return;
        }
        if let (Power, Some(&Constant(exponent))) = (operation, self.operations.last())
            && let Some(exponent) = whole(exponent)
        {
            self.operations.pop();
            self.absorbs |= exponent <= 0;
            self.operations.push(IntegerPower(exponent));
            return;
        }
        let constant_before = matches!(self.operations.last(), Some(Constant(_)));
        self.absorbs |= match operation {
            Divide => !constant_before,
            Power | Operation::Binary(_) => true,
            Operation::Unary(function) => function.absorbs(),
            _ => false,
        };
        self.operations.push(operation);
    }

    /// Returns the indices of the states it reads, ascending.
    pub(super) fn states(&self) -> Vec<usize> {
        let indices = self.operations.iter().filter_map(|operation| match operation {
            Operation::State(index) => Some(usize::from(*index)),
            _ => None,
        });
        let mut states: Vec<usize> = indices.collect();
        states.sort_unstable();
        states.dedup();
        states
    }

    /// Whether the program fits into the machine's stack.
    pub(super) fn fits(&self) -> bool {
        let mut depth = 0;
        self.operations.iter().all(|operation| {
            match operation {
                Operation::Constant(_) | Operation::Time | Operation::State(_) => depth += 1,
                Operation::Negate | Operation::IntegerPower(_) | Operation::Unary(_) => {}
                _ => depth -= 1,
            }
            depth <= STACK_DEPTH_MAX
        })
    }

    /// Returns the value at `time` and state `x`; not finite if any intermediate result was not.
    #[inline]
    pub(super) fn evaluate(&self, time: f64, x: &[f64]) -> f64 {
        if !self.absorbs {
            return self.carry_out(time, x, |_, _, _, _| {});
        }
        let mut finite = true;
        let value = self.carry_out(time, x, |_, _, _, result| finite &= result.is_finite());
        if finite { value } else { f64::NAN }
    }

    /// Returns the first operation with a non-finite result; `None` if all results are finite.
    pub(super) fn failure(&self, time: f64, x: &[f64]) -> Option<Failure> {
        let mut found = None;
        self.carry_out(time, x, |operation, left, right, result| {
            if found.is_none() && !result.is_finite() {
                found = Some(Failure {
                    operation: operation.written(left, right),
                    result,
                    overflow: operation.overflows(left, right, result),
                });
            }
        });
        found
    }

    /// Executes the program. `after` is called for each operation except constants, time and
    /// states, with its operands (a single operand is passed as the second) and its result.
    #[inline(always)]
    fn carry_out(
        &self,
        time: f64,
        x: &[f64],
        mut after: impl FnMut(&Operation, f64, f64, f64),
    ) -> f64 {
        // The top of the stack is kept apart, so most operations touch one array element.
        let mut below = [0.0; STACK_DEPTH_MAX + 1];
        let mut depth = 0;
        let mut top = 0.0;
        for operation in &self.operations {
            let (mut left, right) = (0.0, top);
            match *operation {
                Operation::Constant(_) | Operation::Time | Operation::State(_) => {
                    below[depth] = top;
                    depth += 1;
                    top = match *operation {
                        Operation::Constant(value) => value,
                        Operation::State(index) => x[usize::from(index)],
                        _ => time,
                    };
                    continue;
                }
                Operation::Negate => top = -top,
                Operation::IntegerPower(exponent) => top = integer_power(top, exponent),
                Operation::Unary(function) => top = function.apply(top),
                _ => {
                    depth -= 1;
                    left = below[depth];
                    top = match *operation {
                        Operation::Add => left + top,
                        Operation::Subtract => left - top,
                        Operation::Multiply => left * top,
                        Operation::Divide => left / top,
                        Operation::Binary(function) => function.apply(left, top),
                        _ => power(left, top),
                    };
                }
            }
            after(operation, left, right, top);
        }
        top
    }
}

impl Operation {
    /// Formats the operation with its operands.
    fn written(&self, left: f64, right: f64) -> String {
        let infix = |sign: &str| format!("({left:?}) {sign} ({right:?})");
        match self {
            Self::Add => infix("+"),
            Self::Subtract => infix("-"),
            Self::Multiply => infix("*"),
            Self::Divide => infix("/"),
            Self::Power => infix("^"),
            Self::IntegerPower(exponent) => format!("({right:?})^({exponent})"),
            Self::Unary(function) => format!("{}({right:?})", function.name()),
            Self::Binary(function) => format!("{}({left:?}, {right:?})", function.name()),
            Self::Negate => format!("-({right:?})"),
            Self::Constant(value) => format!("{value:?}"),
            Self::Time | Self::State(_) => format!("{right:?}"),
        }
    }

    /// Whether an infinite result is an overflow rather than a pole.
    fn overflows(&self, left: f64, right: f64, result: f64) -> bool {
        if !result.is_infinite() {
            return false;
        }
        match self {
            Self::Divide => right != 0.0,
            Self::Power => left != 0.0,
            Self::IntegerPower(_) => right != 0.0,
            Self::Unary(function) => function.overflows(),
            _ => true,
        }
    }
}

/// Returns `x` as an integer if it is one and fits into an `i32`.
fn whole(x: f64) -> Option<i32> {
    let integer = x as i32;
    (f64::from(integer) == x).then_some(integer)
}

/// Returns `base^exponent`; a product if the exponent is an integer.
#[inline]
fn power(base: f64, exponent: f64) -> f64 {
    match whole(exponent) {
        Some(exponent) => integer_power(base, exponent),
        None => libm::pow(base, exponent),
    }
}

/// Computes `base^exponent` by repeated squaring, lowest bit of the exponent first: `x^3 = x (x
/// x)`, `x^-2 = 1/(x x)`, `x^0 = 1`.
#[inline]
#[must_use]
pub fn integer_power(base: f64, exponent: i32) -> f64 {
    let mut remaining = exponent.unsigned_abs();
    let (mut result, mut square) = (1.0, base);
    while remaining > 0 {
        if remaining & 1 == 1 {
            result *= square;
        }
        remaining >>= 1;
        if remaining > 0 {
            square *= square;
        }
    }
    if exponent < 0 { 1.0 / result } else { result }
}
