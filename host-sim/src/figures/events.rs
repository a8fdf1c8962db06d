//! Broadcast instants (Figure 3 of the paper).
//!
//! Up to sixty agents with few enough broadcasts get a row of ticks each, one tick per broadcast.
//! Otherwise a density map is drawn, see [`event_map`](super::event_map).

use super::Figure;
use super::canvas::{Anchor, Canvas, PathData, Stroke, TextAt, WIDTH};
use super::event_figure::{EventFigure, LEFT, agent_panel, label_agents};
use super::event_map::draw_map;
use super::palette::{self, LINES};
use super::panel::{BOTTOM_MARGIN, Labels, RIGHT_MARGIN, TICK_SIZE, TIME_LABEL, draw_title};

/// Up to this many agents get a row each.
const ROWS: usize = 60;

/// Up to this many broadcasts of an agent are drawn as ticks: about one per user unit.
const TICKS: usize = 380;

/// Draws the broadcasts of all agents.
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

/// Returns one sentence with the number of broadcasts shown.
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

/// Draws a row of ticks per agent; returns the bottom of the panel.
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
