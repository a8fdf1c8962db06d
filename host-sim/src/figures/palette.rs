//! Colours that people with any kind of colour vision can tell apart.
//!
//! Source: M. Okabe and K. Ito, "Color Universal Design" (2008). Its yellow is too faint for
//! thin lines on white and is left out; a grey stands in for it and for black, which is kept for
//! the true state.

/// Colours of agents 1 to 8.
const AGENTS: [&str; 8] =
    ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#d55e00", "#56b4e9", "#7a5195", "#707070"];

/// Up to this many agents are drawn as lines of their own.
pub(super) const LINES: usize = AGENTS.len();

/// Colour of many agents drawn as one.
pub(super) const TOGETHER: &str = AGENTS[0];

/// Colour of what is marked as important.
pub(super) const SIGNAL: &str = "#c1121f";

/// Colour of an agent, counted from 0.
pub(super) const fn agent(index: usize) -> &'static str {
    AGENTS[index % AGENTS.len()]
}
