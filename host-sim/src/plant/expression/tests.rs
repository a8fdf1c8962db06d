use super::*;
use proptest::prelude::*;

/// The value at t = 0.5, x = 3, y = -2, with mu = 0.25.
fn value(text: &str) -> Result<f64, ExpressionError> {
    let states = ["x".to_owned(), "y".to_owned()];
    let program = parser::parse(text, &states, &[("mu".to_owned(), 0.25)])?;
    Ok(program.evaluate(0.5, &[3.0, -2.0]))
}

fn message(text: &str) -> String {
    value(text).unwrap_err().to_string()
}

#[test]
fn binds_as_on_paper() {
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
fn functions_are_those_of_libm() {
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
fn what_is_constant_is_computed_once() {
    let states = ["x".to_owned()];
    let folded = parser::parse("2*sin(pi/6)^2 - mu + x", &states, &[("mu".to_owned(), 0.25)]);
    let sine = libm::sin(core::f64::consts::PI / 6.0);
    let constant = 2.0 * (sine * sine) - 0.25;
    assert_eq!(folded, parser::parse(&format!("{constant:e} + x"), &states, &[]));
}

#[test]
fn says_what_is_wrong_and_where() {
    let cases = [
        ("", "expected a number, a name or `(` at column 1, found the end"),
        ("x +", "expected a number, a name or `(` at column 4, found the end"),
        ("x 2", "expected an operator or the end at column 3, found `2`"),
        ("2x", "expected an operator or the end at column 2, found `x`"),
        ("(x", "expected `)` or an operator at column 3, found the end"),
        ("x)", "expected an operator or the end at column 2, found `)`"),
        ("sin x", "expected `(` after a function at column 5, found `x`"),
        ("sin(x, y)", "`sin` at column 1 takes 1 argument(s), found 2"),
        ("x + max(x)", "`max` at column 5 takes 2 argument(s), found 1"),
        ("0.5*w", "unknown name `w` at column 5"),
        ("x ** 2", "expected a number, a name or `(` at column 4, found `*`"),
        ("µ*x", "expected a number, a name or `(` at column 1, found `µ`"),
        ("1e999", "`1e999` at column 1 is not a finite number"),
        (".", "`.` at column 1 is not a finite number"),
        ("1.5.2", "expected an operator or the end at column 4, found `.`"),
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
fn an_unknown_name_comes_with_the_known_ones() {
    let Err(ExpressionError::UnknownName { known, .. }) = value("w") else {
        panic!("`w` is unknown")
    };
    assert_eq!(known[..6], ["x", "y", "mu", "t", "pi", "e"]);
}

#[test]
fn names_that_mean_something_else_are_refused() {
    assert_eq!(name_problem("x_1"), None);
    assert_eq!(name_problem("t"), Some("is the time"));
    assert_eq!(name_problem("e"), Some("is a constant"));
    assert_eq!(name_problem("sin"), Some("is a function"));
    for name in ["", "1x", "x-y", "ä", "x y"] {
        assert_eq!(name_problem(name), Some("is not a name"), "{name}");
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

/// The fault of one expression at t = 0.5, x = 3, y = -2.
fn fault(text: &str) -> Option<String> {
    let states = ["x".to_owned(), "y".to_owned()];
    let system = ExpressionSystem::parse(&["0", text], &states, &[]).unwrap();
    let mut values = [0.0; 2];
    system.evaluate(0.5, &[3.0, -2.0], &mut values);
    let fault = system.fault(0.5, &[3.0, -2.0]);
    // What has a fault shows it in its value, however the value could hide it.
    assert_eq!(values[1].is_finite(), fault.is_none(), "{text}: {}", values[1]);
    fault.map(|fault| fault.to_string())
}

#[test]
fn what_is_not_defined_is_never_swallowed() {
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
        (&too_large[..], "too large a number"),
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
fn a_fault_names_the_values_of_its_states_only() {
    let found = fault("sqrt(y) + t").unwrap();
    assert!(found.contains("at t = 0.5 with y = -2.0; change the expression"), "{found}");
    assert!(fault("sqrt(x*y)").unwrap().contains("with x = 3.0, y = -2.0;"));
    for text in ["x/y", "exp(-1e9*x)", "max(x, y)", "x^-2", "1/(1 + exp(x))", "ln(x)^0.5"] {
        assert_eq!(fault(text), None);
    }
    // Where the state itself is not finite, the expression is not to blame.
    let system = ExpressionSystem::parse(&["ln(x)"], &["x".to_owned()], &[]).unwrap();
    assert_eq!(system.fault(0.0, &[f64::INFINITY]), None);
}

proptest! {
    #[test]
    fn reads_or_refuses_but_never_panics(text in "[-+*/^(),.0-9a-z_ ]{0,60}|.{0,20}") {
        if let Ok(value) = value(&text) {
            // What was read has the same value when it stands in parentheses.
            prop_assert_eq!(self::value(&format!("({text})")).map(f64::to_bits), Ok(value.to_bits()));
        }
    }

    #[test]
    fn sums_of_products_are_those_of_rust(a in -1e3..1e3f64, b in -1e3..1e3f64, c in -1e3..1e3f64) {
        let text = format!("({a:e}) - ({b:e})*x/({c:e}) + y^3");
        prop_assert_eq!(value(&text), Ok(a - b * 3.0 / c + -8.0));
    }
}
