//! Scenarios that come with the program.

/// The paper's simulation, with every key explained.
pub const PAPER: &str = include_str!("../../scenarios/paper.toml");

/// Name and text of every scenario that comes with the program.
pub const BUILT_IN: [(&str, &str); 5] = [
    ("paper", PAPER),
    ("lorenz", include_str!("../../scenarios/lorenz.toml")),
    ("pendulum", include_str!("../../scenarios/pendulum.toml")),
    ("duffing", include_str!("../../scenarios/duffing.toml")),
    ("expressions", include_str!("../../scenarios/expressions.toml")),
];

/// The text of the scenario of that name.
#[must_use]
pub fn built_in(name: &str) -> Option<&'static str> {
    BUILT_IN.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}
