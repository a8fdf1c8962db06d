//! Input of the broadcast figure, and the panel shared by its rows and its map.

use std::ops::RangeInclusive;

use super::axis::Axis;
use super::canvas::{Anchor, Canvas, Rect, TextAt, WIDTH};
use super::palette::LINES;
use super::panel::{Panel, RIGHT_MARGIN, TICK_SIZE};

/// Left end of the panels. \[user unit\]
pub(super) const LEFT: f64 = 50.0;

/// Input of [`super::events()`].
#[derive(Clone, Copy, Debug)]
pub struct EventFigure<'a> {
    /// Title of the figure; the number of broadcasts shown is added below it.
    pub title: &'a str,
    /// For each agent, the steps at whose start it broadcast, in ascending order.
    pub events: &'a [&'a [u64]],
    /// Length of a step. \[s\]
    pub step_size: f64,
    /// First instant shown. \[s\]
    pub from: f64,
    /// Last instant shown. \[s\]
    pub to: f64,
}

impl EventFigure<'_> {
    pub(super) fn time(&self, tick: u64) -> f64 {
        tick as f64 * self.step_size
    }

    /// Returns the first and the last step of the window.
    pub(super) fn window(&self) -> RangeInclusive<u64> {
        let tick = |time: f64| (time / self.step_size).round() as u64;
        tick(self.from)..=tick(self.to)
    }

    /// Returns an agent's broadcasts in the window.
    pub(super) fn shown(&self, agent: usize) -> &[u64] {
        let (events, window) = (self.events[agent], self.window());
        let first = events.partition_point(|tick| tick < window.start());
        let last = events.partition_point(|tick| tick <= window.end());
        &events[first..last.max(first)]
    }
}

/// Creates a panel with the first agent at the top.
pub(super) fn agent_panel(figure: &EventFigure<'_>, top: f64) -> Panel {
    let agents = figure.events.len().max(1) as f64;
    let width = WIDTH - LEFT - RIGHT_MARGIN;
    let height = (42.0 * agents).min((2.0 * agents).clamp(150.0, 260.0));
    let x = Axis::horizontal(figure.from, figure.to, width, TICK_SIZE);
    Panel::new(Rect { left: LEFT, top, width, height }, x, Axis::exact(0.0, agents, 1.0))
}

/// Labels the rows with the names of a few agents, or with some of the numbers of many.
pub(super) fn label_agents(canvas: &mut Canvas, panel: &Panel, agents: usize) {
    let area = panel.area;
    let mut label = |agent: usize, text: &str| {
        let middle = area.top + (agent as f64 - 0.5) / agents as f64 * area.height;
        let at = TextAt::new(LEFT - 6.0, middle + 0.36 * TICK_SIZE, TICK_SIZE, Anchor::End);
        canvas.text(text, at);
    };
    if agents <= LINES {
        (1..=agents).for_each(|agent| label(agent, &format!("agent {agent}")));
        return;
    }
    let round = Axis::exact(1.0, agents as f64, area.height / (3.0 * TICK_SIZE)).ticks();
    let round =
        round.into_iter().filter(|number| number.fract() == 0.0).map(|number| number as usize);
    let first = if agents < 20 { None } else { Some(1) };
    first.into_iter().chain(round).for_each(|agent| label(agent, &agent.to_string()));
    panel.label_y(canvas, "agent", 14.0);
}
