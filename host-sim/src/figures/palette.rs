//! A palette for all types of colour vision.
//!
//! Source: M. Okabe and K. Ito, "Color Universal Design" (2008). Its yellow is too faint for thin
//! lines on white; a grey replaces it and black, which is reserved for the true state.

/// Colours of agents 1 to 8.
const AGENTS: [&str; 8] =
    ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#7a5195", "#707070"];

/// Up to this many agents are drawn as separate lines.
pub(super) const LINES: usize = AGENTS.len();

/// Colour of the statistics of many agents.
pub(super) const TOGETHER: &str = AGENTS[0];

/// Highlight colour.
pub(super) const SIGNAL: &str = "#c1121f";

/// Returns the colour of an agent, counted from 0.
pub(super) const fn agent(index: usize) -> &'static str {
    AGENTS[index % AGENTS.len()]
}
