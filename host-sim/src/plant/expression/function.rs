//! The functions available in expressions. Each is exact or comes from the `libm` crate.

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

impl Unary {
    /// All of them, in the order of [`FUNCTIONS`].
    const ALL: [Self; 14] = [
        Self::Abs,
        Self::Acos,
        Self::Asin,
        Self::Atan,
        Self::Cos,
        Self::Cosh,
        Self::Exp,
        Self::Ln,
        Self::Sign,
        Self::Sin,
        Self::Sinh,
        Self::Sqrt,
        Self::Tan,
        Self::Tanh,
    ];

    /// Returns the name used in expressions.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Abs => "abs",
            Self::Acos => "acos",
            Self::Asin => "asin",
            Self::Atan => "atan",
            Self::Cos => "cos",
            Self::Cosh => "cosh",
            Self::Exp => "exp",
            Self::Ln => "ln",
            Self::Sign => "sign",
            Self::Sin => "sin",
            Self::Sinh => "sinh",
            Self::Sqrt => "sqrt",
            Self::Tan => "tan",
            Self::Tanh => "tanh",
        }
    }

    /// Whether it can map an infinite argument to a finite result.
    pub(super) fn absorbs(self) -> bool {
        matches!(self, Self::Atan | Self::Exp | Self::Sign | Self::Tanh)
    }

    /// Whether a finite argument can overflow; for the others, an infinite result is a pole.
    pub(super) fn overflows(self) -> bool {
        matches!(self, Self::Cosh | Self::Exp | Self::Sinh)
    }
}

impl Binary {
    const ALL: [Self; 3] = [Self::Atan2, Self::Max, Self::Min];

    /// Returns the name used in expressions.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Atan2 => "atan2",
            Self::Max => "max",
            Self::Min => "min",
        }
    }
}

impl Function {
    /// Returns the function with this name; `log` is the natural logarithm, like `ln`.
    pub(super) fn named(name: &str) -> Option<Self> {
        let name = if name == "log" { "ln" } else { name };
        let unary = Unary::ALL.into_iter().find(|function| function.name() == name);
        let binary = Binary::ALL.into_iter().find(|function| function.name() == name);
        unary.map(Self::Unary).or(binary.map(Self::Binary))
    }

    /// Returns the number of arguments.
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

/// Returns -1, 0 or 1; NaN stays NaN.
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
