use super::*;
use proptest::prelude::*;

/// Evaluates the text at t = 0.5, x = 3, y = -2, with mu = 0.25.
fn value(text: &str) -> Result<f64, ExpressionError> {
    let states = ["x".to_owned(), "y".to_owned()];
    let program = parser::parse(text, &states, &[("mu".to_owned(), 0.25)])?;
    Ok(program.evaluate(0.5, &[3.0, -2.0]))
}

fn message(text: &str) -> String {
    value(text).unwrap_err().to_string()
}

#[test]
fn operators_bind_as_on_paper() {
    let cases = [
        ("x^3", 27.0),
        ("2*x^3", 54.0),
        ("-x^2", -9.0),
        ("(-x)^2", 9.0),
        ("2-x^2", -7.0),
        ("x^-2", 1.0 / 9.0),
        ("2^3^2", 512.0),
        ("-2^-2", -0.25),
        ("x - y - 1", 4.0),
        ("x - y + 1", 6.0),
        ("8/4*2", 4.0),
        ("8/(4*2)", 1.0),
        ("2*-x", -6.0),
        ("--x", 3.0),
        ("+x", 3.0),
        ("x*y^2", 12.0),
        ("x+y*2", -1.0),
        ("mu*(x - x^3/3 - y)", -1.0),
        ("t", 0.5),
        (" 1e-3*1000 ", 1.0),
        (".5+1.", 1.5),
        ("2E2", 200.0),
        ("x^0", 1.0),
        ("4^0.5", 2.0),
        ("max(min(x, 1), max(2, y)) * 2", 4.0),
        ("-min(1, 2)", -1.0),
        ("sqrt(x^2 + 16)", 5.0),
        ("abs(y) + sign(y) + sign(0)", 1.0),
    ];
    for (text, expected) in cases {
        assert_eq!(value(text), Ok(expected), "{text}");
    }
}

#[test]
fn functions_match_libm() {
    let cases: [(&str, f64); 18] = [
        ("sin(x)", libm::sin(3.0)),
        ("cos(x)", libm::cos(3.0)),
        ("tan(x)", libm::tan(3.0)),
        ("asin(t)", libm::asin(0.5)),
        ("acos(t)", libm::acos(0.5)),
        ("atan(x)", libm::atan(3.0)),
        ("atan2(x, y)", libm::atan2(3.0, -2.0)),
        ("exp(x)", libm::exp(3.0)),
        ("ln(x)", libm::log(3.0)),
        ("log(x)", libm::log(3.0)),
        ("sinh(x)", libm::sinh(3.0)),
        ("cosh(x)", libm::cosh(3.0)),
        ("tanh(x)", libm::tanh(3.0)),
        ("sqrt(x)", libm::sqrt(3.0)),
        ("x^t", libm::pow(3.0, 0.5)),
        ("x^(t*0.3)", libm::pow(3.0, 0.15)),
        ("sin(pi*t)", 1.0),
        ("ln(e)", 1.0),
    ];
    for (text, expected) in cases {
        assert_eq!(value(text).map(f64::to_bits), Ok(expected.to_bits()), "{text}");
    }
    for name in FUNCTIONS {
        assert!(function::Function::named(name).is_some(), "{name}");
    }
}

#[test]
fn constant_subexpressions_are_folded() {
    let states = ["x".to_owned()];
    let folded = parser::parse("2*sin(pi/6)^2 - mu + x", &states, &[("mu".to_owned(), 0.25)]);
    let sine = libm::sin(core::f64::consts::PI / 6.0);
    let constant = 2.0 * (sine * sine) - 0.25;
    assert_eq!(folded, parser::parse(&format!("{constant:e} + x"), &states, &[]));
}

#[test]
fn errors_name_the_problem_and_the_column() {
    let cases = [
        ("", "expected a number, a name or `(` at column 1, found the end of the expression"),
        ("x +", "expected a number, a name or `(` at column 4, found the end of the expression"),
        ("x 2", "expected an operator or the end of the expression at column 3, found `2`"),
        ("2x", "expected an operator or the end of the expression at column 2, found `x`"),
        ("(x", "expected `)` or an operator at column 3, found the end of the expression"),
        ("x)", "expected an operator or the end of the expression at column 2, found `)`"),
        ("sin x", "expected `(` after a function at column 5, found `x`"),
        ("sin(x, y)", "`sin` at column 1 takes 1 argument(s), found 2"),
        ("x + max(x)", "`max` at column 5 takes 2 argument(s), found 1"),
        ("0.5*w", "unknown name `w` at column 5"),
        ("x ** 2", "expected a number, a name or `(` at column 4, found `*`"),
        ("µ*x", "expected a number, a name or `(` at column 1, found `µ`"),
        ("1e999", "`1e999` at column 1 is not a finite number"),
        (".", "`.` at column 1 is not a finite number"),
        ("1.5.2", "expected an operator or the end of the expression at column 4, found `.`"),
    ];
    for (text, expected) in cases {
        assert_eq!(message(text), expected, "{text}");
    }
    assert_eq!(message(&"(".repeat(100_000)), "nested too deeply");
    assert_eq!(message(&"-".repeat(100_000)), "nested too deeply");
    let right_heavy = format!("{}x{}", "(x + ".repeat(40), ")".repeat(40));
    assert_eq!(message(&right_heavy), "nested too deeply");
}

#[test]
fn unknown_name_lists_known_names() {
    let Err(ExpressionError::UnknownName { known, .. }) = value("w") else {
        panic!("`w` is unknown")
    };
    assert_eq!(known[..6], ["x", "y", "mu", "t", "pi", "e"]);
}

#[test]
fn rejects_reserved_and_invalid_names() {
    assert_eq!(name_problem("x_1"), None);
    assert_eq!(name_problem("t"), Some("is reserved for time"));
    assert_eq!(name_problem("e"), Some("is a constant"));
    assert_eq!(name_problem("sin"), Some("is a function"));
    for name in ["", "1x", "x-y", "ä", "x y"] {
        assert_eq!(name_problem(name), Some("is not a valid name"), "{name}");
    }
}

#[test]
fn integer_powers_are_products() {
    let x = 1.1f64;
    assert_eq!(integer_power(x, 3), x * x * x);
    assert_eq!(integer_power(x, -2), 1.0 / (x * x));
    assert_eq!(integer_power(x, 4), (x * x) * (x * x));
    assert_eq!(integer_power(0.0, 0), 1.0);
    assert_eq!(integer_power(2.0, i32::MIN), 0.0);
}

/// Returns the fault of an expression at t = 0.5, x = 3, y = -2.
fn fault(text: &str) -> Option<String> {
    let states = ["x".to_owned(), "y".to_owned()];
    let system = ExpressionSystem::parse(&["0", text], &states, &[]).unwrap();
    let mut values = [0.0; 2];
    system.evaluate(0.5, &[3.0, -2.0], &mut values);
    let fault = system.fault(0.5, &[3.0, -2.0]);
    // A faulty expression has a non-finite value, even where `max` or `atan` would hide it.
    assert_eq!(values[1].is_finite(), fault.is_none(), "{text}: {}", values[1]);
    fault.map(|fault| fault.to_string())
}

#[test]
fn undefined_results_are_never_hidden() {
    let not_a_number = [
        ("sqrt(x-10)", "sqrt(-7.0)"),
        ("max(sqrt(x-10), 0)", "sqrt(-7.0)"),
        ("min(1, ln(y))", "ln(-2.0)"),
        ("sqrt(x-10)^0", "sqrt(-7.0)"),
        ("1^sqrt(y)", "sqrt(-2.0)"),
        ("asin(x)", "asin(3.0)"),
        ("max(0, acos(y))", "acos(-2.0)"),
        ("(-8)^(1/3)", "(-8.0) ^ (0.3333333333333333)"),
        ("max(0/(x-3), 1)", "(0.0) / (0.0)"),
    ];
    let infinite = [
        ("1/0", "(1.0) / (0.0)"),
        ("1/(x-3)", "(1.0) / (0.0)"),
        ("1/(1/(x-3))", "(1.0) / (0.0)"),
        ("atan(1/(y+2))", "(1.0) / (0.0)"),
        ("exp(-1/(x-3))", "(-1.0) / (0.0)"),
        ("tanh(ln(x-3))", "ln(0.0)"),
        ("exp(ln(0))", "ln(0.0)"),
        ("sign((x-3)^-1)", "(0.0)^(-1)"),
        ("min(0^y, 1)", "(0.0) ^ (-2.0)"),
        ("(1/0)^0", "(1.0) / (0.0)"),
    ];
    let too_large = [
        ("exp(300*x)", "exp(900.0)"),
        ("1/(1 + exp(300*x))", "exp(900.0)"),
        ("tanh(1e200*x*1e200)", "(3e200) * (1e200)"),
        ("1/sinh(300*x)", "sinh(900.0)"),
        ("atan(x^1000)", "(3.0)^(1000)"),
    ];
    for (cases, words) in [
        (&not_a_number[..], "not a number"),
        (&infinite[..], "infinite"),
        (&too_large[..], "too large"),
    ] {
        for (text, operation) in cases {
            let message = fault(text).unwrap_or_else(|| panic!("{text}: no fault"));
            let expected =
                format!("expression 2 for y, `{text}`: {operation} is {words}, at t = 0.5");
            assert!(message.starts_with(&expected), "{message}\n{expected}");
        }
    }
}

#[test]
fn fault_lists_only_the_states_used() {
    let found = fault("sqrt(y) + t").unwrap();
    assert!(found.contains("at t = 0.5 with y = -2.0; change the expression"), "{found}");
    assert!(fault("sqrt(x*y)").unwrap().contains("with x = 3.0, y = -2.0;"));
    for text in ["x/y", "exp(-1e9*x)", "max(x, y)", "x^-2", "1/(1 + exp(x))", "ln(x)^0.5"] {
        assert_eq!(fault(text), None);
    }
    // If the state itself is not finite, the expression is not at fault.
    let system = ExpressionSystem::parse(&["ln(x)"], &["x".to_owned()], &[]).unwrap();
    assert_eq!(system.fault(0.0, &[f64::INFINITY]), None);
}

proptest! {
    #[test]
    fn parser_never_panics(text in "[-+*/^(),.0-9a-z_ ]{0,60}|.{0,20}") {
        if let Ok(value) = value(&text) {
            // Parentheses around an expression do not change its value.
            prop_assert_eq!(self::value(&format!("({text})")).map(f64::to_bits), Ok(value.to_bits()));
        }
    }

    #[test]
    fn arithmetic_matches_rust(a in -1e3..1e3f64, b in -1e3..1e3f64, c in -1e3..1e3f64) {
        let text = format!("({a:e}) - ({b:e})*x/({c:e}) + y^3");
        prop_assert_eq!(value(&text), Ok(a - b * 3.0 / c + -8.0));
    }
}
