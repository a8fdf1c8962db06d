//! Scenarios built into the program.

/// The paper's simulation, with every key explained.
pub const PAPER: &str = include_str!("../../scenarios/paper.toml");

/// Name and text of every built-in scenario.
pub const BUILT_IN: [(&str, &str); 6] = [
    ("paper", PAPER),
    ("deployment", include_str!("../../scenarios/deployment.toml")),
    ("lorenz", include_str!("../../scenarios/lorenz.toml")),
    ("pendulum", include_str!("../../scenarios/pendulum.toml")),
    ("duffing", include_str!("../../scenarios/duffing.toml")),
    ("expressions", include_str!("../../scenarios/expressions.toml")),
];

/// Returns the text of the built-in scenario with this name.
#[must_use]
pub fn built_in(name: &str) -> Option<&'static str> {
    BUILT_IN.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}
