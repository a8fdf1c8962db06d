//! The functions that expressions may call, all from the `libm` crate or exact.

/// Names of the functions, in alphabetical order.
pub const FUNCTIONS: [&str; 18] = [
    "abs", "acos", "asin", "atan", "atan2", "cos", "cosh", "exp", "ln", "log", "max", "min",
    "sign", "sin", "sinh", "sqrt", "tan", "tanh",
];

/// A function of one argument.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Unary {
    Abs,
    Acos,
    Asin,
    Atan,
    Cos,
    Cosh,
    Exp,
    Ln,
    Sign,
    Sin,
    Sinh,
    Sqrt,
    Tan,
    Tanh,
}

/// A function of two arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Binary {
    Atan2,
    Max,
    Min,
}

/// A function by the number of its arguments.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Function {
    Unary(Unary),
    Binary(Binary),
}

impl Function {
    /// The function of that name; `log` is the natural logarithm, as `ln` is.
    pub(super) fn named(name: &str) -> Option<Self> {
        Some(match name {
            "abs" => Self::Unary(Unary::Abs),
            "acos" => Self::Unary(Unary::Acos),
            "asin" => Self::Unary(Unary::Asin),
            "atan" => Self::Unary(Unary::Atan),
            "atan2" => Self::Binary(Binary::Atan2),
            "cos" => Self::Unary(Unary::Cos),
            "cosh" => Self::Unary(Unary::Cosh),
            "exp" => Self::Unary(Unary::Exp),
            "ln" | "log" => Self::Unary(Unary::Ln),
            "max" => Self::Binary(Binary::Max),
            "min" => Self::Binary(Binary::Min),
            "sign" => Self::Unary(Unary::Sign),
            "sin" => Self::Unary(Unary::Sin),
            "sinh" => Self::Unary(Unary::Sinh),
            "sqrt" => Self::Unary(Unary::Sqrt),
            "tan" => Self::Unary(Unary::Tan),
            "tanh" => Self::Unary(Unary::Tanh),
            _ => return None,
        })
    }

    /// How many arguments it takes.
    pub(super) fn arguments(self) -> usize {
        match self {
            Self::Unary(_) => 1,
            Self::Binary(_) => 2,
        }
    }
}

impl Unary {
    #[inline]
    pub(super) fn apply(self, x: f64) -> f64 {
        match self {
            Self::Abs => libm::fabs(x),
            Self::Acos => libm::acos(x),
            Self::Asin => libm::asin(x),
            Self::Atan => libm::atan(x),
            Self::Cos => libm::cos(x),
            Self::Cosh => libm::cosh(x),
            Self::Exp => libm::exp(x),
            Self::Ln => libm::log(x),
            Self::Sign => sign(x),
            Self::Sin => libm::sin(x),
            Self::Sinh => libm::sinh(x),
            Self::Sqrt => libm::sqrt(x),
            Self::Tan => libm::tan(x),
            Self::Tanh => libm::tanh(x),
        }
    }
}

impl Binary {
    #[inline]
    pub(super) fn apply(self, x: f64, y: f64) -> f64 {
        match self {
            Self::Atan2 => libm::atan2(x, y),
            Self::Max => libm::fmax(x, y),
            Self::Min => libm::fmin(x, y),
        }
    }
}

/// -1, 0 or 1; not a number stays so.
fn sign(x: f64) -> f64 {
    if x > 0.0 {
        1.0
    } else if x < 0.0 {
        -1.0
    } else if x == 0.0 {
        0.0
    } else {
        x
    }
}
