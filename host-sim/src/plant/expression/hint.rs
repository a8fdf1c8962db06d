//! Suggestions for expressions that cannot be parsed: spellings from other languages, and typos. If
//! unsure, it suggests nothing.

use super::parser::ExpressionError;
use super::{FUNCTIONS, RESERVED};
use crate::spelling::nearest;

/// Equivalents of functions in MATLAB, Python, C or Julia; names in lower case.
const FUNCTIONS_ELSEWHERE: [(&[&str], &str); 43] = [
    (&["sine"], "write sin"),
    (&["cosine"], "write cos"),
    (&["tangent"], "write tan"),
    (&["log10", "lg"], "write ln(x)/ln(10)"),
    (&["log2", "ld"], "write ln(x)/ln(2)"),
    (&["log1p"], "write ln(1 + x)"),
    (&["expm1"], "write exp(x) - 1"),
    (&["exp2"], "write 2^x"),
    (&["exp10"], "write 10^x"),
    (&["pow", "power"], "write x^y"),
    (&["sqr", "square"], "write x^2"),
    (&["cbrt"], "write sign(x)*abs(x)^(1/3)"),
    (&["nthroot"], "write sign(x)*abs(x)^(1/n)"),
    (&["root", "squareroot"], "write sqrt(x)"),
    (&["hypot"], "write sqrt(x^2 + y^2)"),
    (&["fabs", "absolute", "magnitude"], "write abs(x)"),
    (&["fmin", "minimum"], "write min(x, y)"),
    (&["fmax", "maximum"], "write max(x, y)"),
    (&["sgn", "signum"], "write sign(x)"),
    (&["arcsin"], "write asin(x)"),
    (&["arccos"], "write acos(x)"),
    (&["arctan", "arctg", "atg"], "write atan(x)"),
    (&["arctan2"], "write atan2(y, x)"),
    (&["asinh", "arcsinh", "arsinh"], "write ln(x + sqrt(x^2 + 1))"),
    (&["acosh", "arccosh", "arcosh"], "write ln(x + sqrt(x^2 - 1))"),
    (&["atanh", "arctanh", "artanh"], "write 0.5*ln((1 + x)/(1 - x))"),
    (&["sind"], "write sin(x*pi/180)"),
    (&["cosd"], "write cos(x*pi/180)"),
    (&["tand"], "write tan(x*pi/180)"),
    (&["asind"], "write asin(x)*180/pi"),
    (&["acosd"], "write acos(x)*180/pi"),
    (&["atand"], "write atan(x)*180/pi"),
    (&["deg2rad", "radians"], "write x*pi/180"),
    (&["rad2deg", "degrees"], "write x*180/pi"),
    (&["sec"], "write 1/cos(x)"),
    (&["csc", "cosec"], "write 1/sin(x)"),
    (&["cot", "ctg", "cotan"], "write 1/tan(x)"),
    (&["tg"], "write tan(x)"),
    (&["sech"], "write 1/cosh(x)"),
    (&["csch"], "write 1/sinh(x)"),
    (&["coth"], "write 1/tanh(x)"),
    (&["heaviside", "step", "unitstep", "theta"], "write (1 + sign(x))/2"),
    (&["clip", "clamp", "sat", "saturate", "saturation"], "write min(max(x, low), high)"),
];

/// Features that expressions do not have.
const NOT_HERE: [(&[&str], &str); 5] = [
    (
        &["rand", "randn", "random", "randi", "rnd", "noise", "normal", "gauss", "wgn"],
        "expressions are deterministic, so that a scenario always gives the same bits; write a sum of \
         sines with incommensurate frequencies",
    ),
    (
        &[
            "mod",
            "fmod",
            "rem",
            "remainder",
            "floor",
            "ceil",
            "ceiling",
            "round",
            "rint",
            "fix",
            "trunc",
            "int",
            "frac",
        ],
        "expressions have no rounding and no remainder; write periodic signals with sin and cos",
    ),
    (
        &["if", "ifelse", "where", "cond", "piecewise", "switch", "select", "iif", "merge"],
        "expressions have no conditions; use min, max or a factor (1 + sign(x))/2",
    ),
    (
        &["diff", "der", "deriv", "derivative", "integral", "int_", "cumsum", "laplacian"],
        "expressions cannot differentiate or integrate; add a state instead",
    ),
    (
        &[
            "delay", "delayed", "lag", "sum", "prod", "mean", "dot", "erf", "gamma", "sinc",
            "conj", "real", "imag",
        ],
        "function not supported; write it in terms of the supported ones",
    ),
];

/// Constants and variables.
const NAMES_ELSEWHERE: [(&[&str], &str); 5] = [
    (&["m_pi", "\u{3c0}"], "write pi"),
    (&["time"], "write t for time"),
    (&["euler", "m_e"], "write e, or exp(x) for its powers"),
    (&["inf", "infinity", "nan", "eps"], "write a finite number"),
    (&["tau"], "write 2*pi for the circle constant, or define tau as a parameter"),
];

/// Module prefixes of functions in other languages.
const LIBRARIES: [&str; 9] = ["np", "numpy", "math", "cmath", "std", "torch", "jnp", "sympy", "sp"];

/// Returns a suggestion for `error` in `text`, if there is one.
#[must_use]
pub fn hint(error: &ExpressionError, text: &str) -> Option<String> {
    match error {
        ExpressionError::UnknownName { name, column, known } => unknown(name, *column, known, text),
        ExpressionError::Unexpected { column, .. } => unexpected(*column, text),
        ExpressionError::ArgumentCount { name, found, .. } => Some(match (name.as_str(), found) {
            ("atan", 2) => "write atan2(y, x) for the angle of a point".to_owned(),
            ("log" | "ln", 2) => "write ln(x)/ln(base)".to_owned(),
            ("min" | "max", 3..) => format!("write {name}(x, {name}(y, z))"),
            _ => return None,
        }),
        _ => None,
    }
}

fn unknown(name: &str, column: usize, known: &[String], text: &str) -> Option<String> {
    let rest: String = text.chars().skip(column - 1 + name.chars().count()).collect();
    let rest = rest.trim_start();
    let is_call = rest.starts_with('(');
    let lower = name.to_lowercase();
    if LIBRARIES.contains(&lower.as_str()) && (rest.starts_with('.') || rest.starts_with("::")) {
        return Some(format!("write the function without {name}"));
    }
    // In front of a parenthesis it must be a function, elsewhere it cannot be one.
    let is_function = |known: &str| FUNCTIONS.contains(&known);
    let fitting = || known.iter().map(String::as_str).filter(|known| is_function(known) == is_call);
    if let Some(same) = fitting().find(|known| known.eq_ignore_ascii_case(name)) {
        return Some(match same {
            "t" => "write t for time".to_owned(),
            "e" => "write e for the base of the natural logarithm".to_owned(),
            same => format!("write {same}"),
        });
    }
    let listed = |table: &[(&[&str], &str)]| {
        let entry = table.iter().find(|(names, _)| names.contains(&lower.as_str()));
        entry.map(|(_, hint)| (*hint).to_owned())
    };
    let foreign = if is_call {
        // C's functions for other types: `sinf`, `fabsl`.
        let suffixed = lower.strip_suffix(['f', 'l']).filter(|stem| is_function(stem));
        suffixed
            .map(|stem| format!("write {stem}"))
            .or_else(|| listed(&FUNCTIONS_ELSEWHERE))
            .or_else(|| listed(&NOT_HERE))
    } else {
        listed(&NAMES_ELSEWHERE)
    };
    if foreign.is_some() {
        return foreign;
    }
    let index = |c: char| c.is_ascii_digit() || c.is_whitespace();
    let indexed = rest.strip_prefix(['(', '[']).map(|rest| rest.trim_start_matches(index));
    if indexed.is_some_and(|rest| rest.starts_with([')', ']'])) {
        let states = known.iter().map(String::as_str);
        let names: Vec<_> = states.filter(|k| !is_function(k) && !RESERVED.contains(k)).collect();
        return Some(format!("refer to components by name: {}", names.join(", ")));
    }
    if !is_call && is_function(&lower) {
        return Some(format!("write {lower}(x), with an argument"));
    }
    // In some languages `xy` is a product of two names, but not here.
    let halves = name.char_indices().skip(1).map(|(at, _)| name.split_at(at));
    let is_name =
        |part: &str| part != "e" && known.iter().any(|known| known == part && !is_function(known));
    if let Some((first, second)) =
        halves.into_iter().find(|(a, b)| !is_call && is_name(a) && is_name(b))
    {
        return Some(format!("write {first}*{second} for the product"));
    }
    slip(name, fitting()).map(|meant| format!("write {meant}"))
}

/// Returns the one candidate that is a typo away: one letter added, missing, replaced or swapped,
/// two in a long word. Names of one letter never match.
fn slip<'k>(name: &str, candidates: impl Iterator<Item = &'k str>) -> Option<&'k str> {
    let length = name.chars().count();
    if length < 2 {
        return None;
    }
    let allowed = if length < 6 { 1 } else { 2 };
    let candidates = candidates.filter(|candidate| candidate.chars().count() > 1);
    nearest(candidates, |candidate| strsim::osa_distance(name, candidate), allowed)
}

fn unexpected(column: usize, text: &str) -> Option<String> {
    let characters: Vec<char> = text.chars().collect();
    let at = column - 1;
    let here = characters.get(at).copied();
    let before = characters[..at.min(characters.len())].iter().rev().find(|c| !c.is_whitespace());
    let word = |from: usize| -> String {
        let rest = characters[from..].iter();
        rest.take_while(|c| c.is_ascii_alphanumeric() || **c == '_').collect()
    };
    let next = characters.get(at + 1).copied();
    let is_digit = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
    let name = name_before(&characters[..at.min(characters.len())]);
    let function = name.as_deref().filter(|name| FUNCTIONS.contains(name));
    let begins = before.is_none_or(|c| "+-*/^(,".contains(*c));
    const PRODUCT: &str = "write * for a product";
    const CONDITIONS: &str =
        "expressions have no conditions; use min, max or a factor (1 + sign(x))/2";
    let fixed = match (before, here?) {
        (Some('*'), '*') | (Some('^'), '^') => "write ^ for a power",
        (_, '.') if next == Some('^') => "write ^ for a power; there are no element-wise operators",
        (_, '.') if matches!(next, Some('*' | '/')) => {
            "write * and /; there are no element-wise operators"
        }
        (_, '^') if function.is_some() => "write the power after the parenthesis, as in sin(x)^2",
        (_, '[') => "write each state component by name, such as x1 for x[1]",
        (_, '\u{d7}' | '\u{b7}' | '\u{22c5}') => PRODUCT,
        (_, '\u{f7}') => "write / for a quotient",
        (_, '\u{2212}' | '\u{2013}') => "write - for a difference",
        (_, '\u{b2}') => "write ^2",
        (_, '\u{b3}') => "write ^3",
        (_, '\u{3c0}') => "write pi",
        (_, '\u{221a}') => "write sqrt(x)",
        (_, '|') if begins => "write abs(x) for an absolute value",
        (_, '%') => "expressions have no remainder and no comments",
        (_, '<' | '>' | '?' | '&' | '|') => CONDITIONS,
        (_, '=' | '!') if next == Some('=') || matches!(before, Some('<' | '>')) => CONDITIONS,
        (_, '=') => "write the right-hand side only",
        (Some(_), '\'') => "write out the derivative, or add a state for it",
        (Some(c), ',') if c.is_ascii_digit() && is_digit(next) => {
            "use decimal points, not decimal commas"
        }
        (Some(_), '(') => match &name {
            Some(name) if name.parse::<f64>().is_err() => {
                return Some(format!("write {name}*( for a product; {name} is not a function"));
            }
            _ => PRODUCT,
        },
        (Some(')'), c) if c.is_ascii_alphanumeric() || c == '_' => PRODUCT,
        (Some(_), c) if c.is_ascii_alphabetic() || c == '_' => {
            let (name, next) = (name.as_deref()?, word(at));
            return Some(match function {
                Some(function) => format!("write {function}({next})"),
                None if name.parse::<f64>().is_ok() => format!("write {name}*{next} for a product"),
                None => {
                    format!("write an operator between {name} and {next}, such as {name}*{next}")
                }
            });
        }
        _ => return None,
    };
    Some(fixed.to_owned())
}

/// Returns the name or number at the end of `characters`, ignoring trailing blanks.
fn name_before(characters: &[char]) -> Option<String> {
    let end = characters.iter().rposition(|c| !c.is_whitespace())? + 1;
    let is_part = |c: &char| c.is_ascii_alphanumeric() || matches!(c, '_' | '.');
    let start = characters[..end].iter().rposition(|c| !is_part(c)).map_or(0, |at| at + 1);
    (start < end).then(|| characters[start..end].iter().collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plant::expression::ExpressionSystem;

    /// Returns the hint for an expression in states x, x2, y and a parameter mu.
    fn hint_for(text: &str) -> Option<String> {
        let states = ["x", "x2", "y"].map(str::to_owned);
        let parameters = [("mu".to_owned(), 0.5)];
        let error = ExpressionSystem::parse(&[text], &states, &parameters).expect_err(text).error;
        hint(&error, text)
    }

    #[test]
    fn hints_at_syntax_of_other_languages() {
        for (text, expected) in [
            ("log10(x)", "write ln(x)/ln(10)"),
            ("2*log2 (x)", "write ln(x)/ln(2)"),
            ("Sin(x)", "write sin"),
            ("ABS(x)", "write abs"),
            ("PI*x", "write pi"),
            ("M_PI*x", "write pi"),
            ("X + 1", "write x"),
            ("T", "write t for time"),
            ("sin(time)", "write t for time"),
            ("pow(x, 2)", "write x^y"),
            ("x ** 2", "write ^ for a power"),
            ("x**-2", "write ^ for a power"),
            ("x.^2", "write ^ for a power; there are no element-wise operators"),
            ("x.*y", "write * and /; there are no element-wise operators"),
            ("x./y", "write * and /; there are no element-wise operators"),
            ("fabs(x)", "write abs(x)"),
            ("sinf(x)", "write sin"),
            ("expf(x)", "write exp"),
            ("np.sin(x)", "write the function without np"),
            ("Math.PI*x", "write the function without Math"),
            ("std::sin(x)", "write the function without std"),
            ("arctan(x)", "write atan(x)"),
            ("sind(x)", "write sin(x*pi/180)"),
            ("hypot(x, y)", "write sqrt(x^2 + y^2)"),
            ("sgn(x)", "write sign(x)"),
            ("Heaviside(x)", "write (1 + sign(x))/2"),
            ("atan(y, x)", "write atan2(y, x) for the angle of a point"),
            ("log(x, 2)", "write ln(x)/ln(base)"),
            ("max(x, y, 1)", "write max(x, max(y, z))"),
            ("2x", "write 2*x for a product"),
            ("2 x", "write 2*x for a product"),
            ("2(x + 1)", "write * for a product"),
            ("(x)(y)", "write * for a product"),
            ("(x)y", "write * for a product"),
            ("x(y + 1)", "write x*( for a product; x is not a function"),
            ("mu y", "write an operator between mu and y, such as mu*y"),
            ("sin x", "write sin(x)"),
            ("sin^2(x)", "write the power after the parenthesis, as in sin(x)^2"),
            ("x[1]", "write each state component by name, such as x1 for x[1]"),
            ("z(1)", "refer to components by name: x, x2, y, mu"),
            ("z[1]", "refer to components by name: x, x2, y, mu"),
            ("|x|", "write abs(x) for an absolute value"),
            ("2*|x|", "write abs(x) for an absolute value"),
            ("0,5*x", "use decimal points, not decimal commas"),
            ("x\u{b2}", "write ^2"),
            ("2\u{b7}x", "write * for a product"),
            ("\u{3c0}*x", "write pi"),
            ("x \u{2212} 1", "write - for a difference"),
            ("x = y", "write the right-hand side only"),
            ("tannh(x)", "write tanh"),
            ("sqtr(x)", "write sqrt"),
            ("nu*x", "write mu"),
            ("muy", "write mu*y for the product"),
        ] {
            assert_eq!(hint_for(text).as_deref(), Some(expected), "{text}");
        }
    }

    #[test]
    fn names_unsupported_features() {
        for (text, part) in [
            ("rand()", "deterministic"),
            ("randn(1)*x", "deterministic"),
            ("mod(x, 2)", "no remainder"),
            ("x % 2", "no remainder"),
            ("floor(x)", "no rounding"),
            ("x > 0 ? x : 0", "no conditions"),
            ("if(x, 1, 2)", "no conditions"),
            ("(x > 0)*y", "no conditions"),
            ("(x == 0)*y", "no conditions"),
            ("x && y", "no conditions"),
            ("diff(x)", "cannot differentiate"),
            ("x'", "the derivative"),
        ] {
            let hint = hint_for(text).unwrap_or_default();
            assert!(hint.contains(part) && !hint.contains("write tan"), "{text}: {hint}");
        }
    }

    #[test]
    fn gives_no_hint_if_unsure() {
        for text in [
            "w",
            "0.5*w",
            "z + x",
            "foo(x)",
            "tin(x)",
            "q*x",
            "temperature",
            "x @ y",
            "x +",
            "f(x)",
        ] {
            assert_eq!(hint_for(text), None, "{text}");
        }
    }
}
