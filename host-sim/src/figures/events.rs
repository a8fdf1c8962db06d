//! Instants of broadcasts (Figure 3 of the paper).
//!
//! Up to sixty agents whose broadcasts can be told apart get a row of ticks each, one tick a
//! broadcast. Otherwise a map is drawn, a cell an agent (or a group of them) and a short time:
//! the darker, the more broadcasts; under it the mean rate of all agents.

use std::ops::RangeInclusive;

use super::Figure;
use super::axis::Axis;
use super::canvas::{Anchor, Canvas, PathData, Rect, Stroke, TextAt, WIDTH};
use super::event_map::draw_map;
use super::palette::{self, LINES};
use super::panel::{BOTTOM_MARGIN, Labels, Panel, RIGHT_MARGIN, TICK_SIZE, TIME_LABEL, draw_title};

/// Up to this many agents have a row each.
const ROWS: usize = 60;

/// Up to this many broadcasts of an agent are drawn as ticks: about one every user unit.
const TICKS: usize = 380;

/// Left end of the panels. \[user unit\]
pub(super) const LEFT: f64 = 50.0;

/// What [`events`] draws.
#[derive(Clone, Copy, Debug)]
pub struct EventFigure<'a> {
    /// Stands above the figure; how many broadcasts are shown is added under it.
    pub title: &'a str,
    /// Of each agent, the steps at whose beginning it broadcast, in ascending order.
    pub events: &'a [&'a [u64]],
    /// Length of a step. \[s\]
    pub step_size: f64,
    /// First instant that is shown. \[s\]
    pub from: f64,
    /// Last instant that is shown. \[s\]
    pub to: f64,
}

impl EventFigure<'_> {
    pub(super) fn time(&self, tick: u64) -> f64 {
        tick as f64 * self.step_size
    }

    /// The first and the last step of the window.
    pub(super) fn window(&self) -> RangeInclusive<u64> {
        let tick = |time: f64| (time / self.step_size).round() as u64;
        tick(self.from)..=tick(self.to)
    }

    /// The broadcasts of an agent that the window holds.
    pub(super) fn shown(&self, agent: usize) -> &[u64] {
        let (events, window) = (self.events[agent], self.window());
        let first = events.partition_point(|tick| tick < window.start());
        let last = events.partition_point(|tick| tick <= window.end());
        &events[first..last.max(first)]
    }
}

/// Draws when agents broadcast.
#[must_use]
pub fn events(figure: &EventFigure<'_>) -> Figure {
    let mut canvas = Canvas::new();
    let counts: Vec<usize> =
        (0..figure.events.len()).map(|agent| figure.shown(agent).len()).collect();
    draw_title(&mut canvas, figure.title, LEFT);
    let room = WIDTH - LEFT - RIGHT_MARGIN;
    let at = TextAt::new(LEFT, 31.0, TICK_SIZE, Anchor::Start).within(room);
    canvas.text(&summary(&counts, figure.to - figure.from), at);
    let legible = counts.len() <= ROWS && counts.iter().all(|&count| count <= TICKS);
    let bottom =
        if legible { draw_ticks(&mut canvas, figure) } else { draw_map(&mut canvas, figure) };
    Figure { svg: canvas.finish(bottom + BOTTOM_MARGIN) }
}

/// How many broadcasts the figure shows, in a sentence.
fn summary(counts: &[usize], seconds: f64) -> String {
    let total: usize = counts.iter().sum();
    let seconds = format!("{seconds:.3}");
    let seconds = seconds.trim_end_matches('0').trim_end_matches('.');
    if counts.len() <= 4 {
        let each = counts.iter().enumerate();
        let each: Vec<_> =
            each.map(|(agent, count)| format!("{count} of agent {}", agent + 1)).collect();
        return format!("{total} broadcasts in {seconds} s: {}", each.join(", "));
    }
    let least = counts.iter().min().copied().unwrap_or(0);
    let most = counts.iter().max().copied().unwrap_or(0);
    let agents = counts.len();
    format!("{total} broadcasts of {agents} agents in {seconds} s, {least} to {most} each")
}

/// Draws a row of ticks for each agent; returns where the panel ends.
fn draw_ticks(canvas: &mut Canvas, figure: &EventFigure<'_>) -> f64 {
    let agents = figure.events.len();
    let panel = agent_panel(figure, 38.0);
    let row_height = panel.area.height / agents.max(1) as f64;
    let width = if row_height > 10.0 { 0.9 } else { 0.6 };
    canvas.fill(panel.area, "#ffffff");
    for agent in 0..agents {
        let middle = panel.area.top + (agent as f64 + 0.5) * row_height;
        let color = if agents <= LINES { palette::agent(agent) } else { palette::TOGETHER };
        let mut ticks = PathData::default();
        for &tick in figure.shown(agent) {
            let x = panel.at_x(figure.time(tick));
            ticks.move_to(x, middle - 0.36 * row_height);
            ticks.line_to(x, middle + 0.36 * row_height);
        }
        canvas.line(ticks, Stroke::solid(color, width));
    }
    label_agents(canvas, &panel, agents);
    panel.draw_frame(canvas, Labels { x_ticks: true, y_ticks: false, minor_grid: false });
    panel.label_x(canvas, TIME_LABEL);
    panel.area.bottom()
}

/// A panel with the first agent at the top.
pub(super) fn agent_panel(figure: &EventFigure<'_>, top: f64) -> Panel {
    let agents = figure.events.len().max(1) as f64;
    let width = WIDTH - LEFT - RIGHT_MARGIN;
    let height = (42.0 * agents).min((2.0 * agents).clamp(150.0, 260.0));
    let x = Axis::horizontal(figure.from, figure.to, width, TICK_SIZE);
    Panel::new(Rect { left: LEFT, top, width, height }, x, Axis::exact(0.0, agents, 1.0))
}

/// Writes the names of a few agents, or numbers of some of many, beside their rows.
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
