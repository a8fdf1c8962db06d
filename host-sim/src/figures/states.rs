//! True state and all estimates over time, a panel a component.
//!
//! Up to four components are stacked, with the transient enlarged beside each; more stand in a
//! grid of two or three columns.

use super::Figure;
use super::axis::{Axis, round_up};
use super::canvas::{Anchor, Canvas, Rect, Stroke, TextAt, WIDTH};
use super::palette::{self, LINES};
use super::panel::{
    BOTTOM_MARGIN, Entry, LEGEND_ROW, LEGEND_TOP, Labels, Panel, RIGHT_MARGIN, Sample, TICK_SIZE,
    TIME_LABEL, draw_legend, draw_title, legend_rows,
};
use super::series::{self, BANDS, MEDIAN};
use crate::engine::traces::Traces;

/// Dashed, and drawn over the estimates, which are seen through its gaps.
const TRUTH: Stroke = Stroke::solid("#000000", 1.0).dashed(4.0, 2.5);

/// Up to this many components are stacked.
const STACKED: usize = 4;

/// About how many rows an axis takes the extent of the estimates from.
const AXIS_SAMPLES: usize = 2000;

/// Left end of the panels. \[user unit\]
const LEFT: f64 = 40.0;

/// What [`states`] draws.
#[derive(Clone, Copy, Debug)]
pub struct StateFigure<'a> {
    /// Stands above the figure.
    pub title: &'a str,
    /// The run.
    pub traces: &'a Traces,
}

/// Draws `x_0(t)` and every agent's `x_hat_i(t)`.
#[must_use]
pub fn states(figure: &StateFigure<'_>) -> Figure {
    let traces = figure.traces;
    let mut canvas = Canvas::new();
    draw_title(&mut canvas, figure.title, LEFT);
    let entries = legend(traces);
    let rows = legend_rows(&entries, WIDTH - LEFT - RIGHT_MARGIN);
    draw_legend(&mut canvas, &rows, LEFT, LEGEND_TOP);
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0;
    let bottom = if traces.dimension() <= STACKED {
        draw_stack(&mut canvas, traces, top)
    } else {
        draw_grid(&mut canvas, traces, top)
    };
    Figure { svg: canvas.finish(bottom + BOTTOM_MARGIN) }
}

fn legend(traces: &Traces) -> Vec<Entry> {
    let entry = |text: &str, sample| Entry { text: text.to_owned(), sample };
    if traces.agents() > LINES {
        return vec![
            entry("true state", Sample::Line(TRUTH)),
            entry(&format!("{} estimates:", traces.agents()), Sample::None),
            entry("median", Sample::Line(MEDIAN)),
            entry("5–95 %", Sample::Patch(palette::TOGETHER, BANDS[0] + BANDS[1])),
            entry("min–max", Sample::Patch(palette::TOGETHER, BANDS[0])),
        ];
    }
    let agents = (0..traces.agents())
        .map(|agent| entry(&format!("agent {}", agent + 1), Sample::Line(estimate_line(agent))));
    let first = [entry("true state", Sample::Line(TRUTH)), entry("estimates:", Sample::None)];
    first.into_iter().chain(agents).collect()
}

const fn estimate_line(agent: usize) -> Stroke {
    Stroke::solid(palette::agent(agent), 1.1)
}

/// Draws the components above each other; returns where the lowest panel ends.
fn draw_stack(canvas: &mut Canvas, traces: &Traces, top: f64) -> f64 {
    let (start, end) = ends(traces);
    let transient = transient(traces);
    let (gap, between, height) = (8.0, 28.0, 88.0);
    let whole = WIDTH - LEFT - RIGHT_MARGIN;
    let right = if transient.is_some() { 0.3 * whole } else { 0.0 };
    let wide = if transient.is_some() { whole - right - between } else { whole };
    let panels = traces.dimension() * (1 + usize::from(transient.is_some()));
    for component in 0..traces.dimension() {
        let top = top + component as f64 * (height + gap);
        let last = component + 1 == traces.dimension();
        let labels = Labels { x_ticks: last, y_ticks: true, minor_grid: true };
        let one = Component { traces, index: component, panels, labels };
        let area = Rect { left: LEFT, top, width: wide, height };
        let panel = one.panel(area, (start, end), TICK_SIZE);
        one.draw(canvas, &panel);
        panel.label_y(canvas, &one.name(), 12.0);
        if let Some(until) = transient {
            let area = Rect { left: LEFT + wide + between, top, width: right, height };
            one.draw(canvas, &one.panel(area, (start, until), TICK_SIZE));
        }
    }
    top + traces.dimension() as f64 * (height + gap) - gap
}

/// Draws the components in a grid; returns where the lowest panel ends.
fn draw_grid(canvas: &mut Canvas, traces: &Traces, top: f64) -> f64 {
    let columns = if traces.dimension() <= 8 { 2 } else { 3 };
    let rows = traces.dimension().div_ceil(columns);
    // The names of the components stand above their panels.
    let (between, name_height) = (30.0, 19.0);
    let width = (WIDTH - LEFT - RIGHT_MARGIN - between * (columns - 1) as f64) / columns as f64;
    let height = if columns == 2 { 82.0 } else { 74.0 };
    for component in 0..traces.dimension() {
        let (row, column) = (component / columns, component % columns);
        let area = Rect {
            left: LEFT + column as f64 * (width + between),
            top: top + 10.0 + row as f64 * (height + name_height),
            width,
            height,
        };
        // The lowest panel of a column carries the time axis.
        let lowest = component + columns >= traces.dimension();
        let labels = Labels { x_ticks: lowest, y_ticks: true, minor_grid: false };
        let one = Component { traces, index: component, panels: traces.dimension(), labels };
        let panel = one.panel(area, ends(traces), TICK_SIZE - 1.0);
        one.draw(canvas, &panel);
        let at = TextAt::new(area.left, area.top - 4.0, TICK_SIZE, Anchor::Start);
        canvas.text(&one.name(), at);
    }
    top + 10.0 + rows as f64 * (height + name_height) - name_height
}

/// A component of the state, and what its panels share.
struct Component<'a> {
    traces: &'a Traces,
    /// From 0.
    index: usize,
    /// How many panels the figure has.
    panels: usize,
    labels: Labels,
}

impl Component<'_> {
    fn name(&self) -> String {
        format!("x{}", subscript(self.index + 1))
    }

    /// A panel of a stretch of time \[s\].
    fn panel(&self, area: Rect, (from, to): (f64, f64), tick_size: f64) -> Panel {
        let x = Axis::horizontal(from, to, area.width, tick_size);
        Panel { tick_size, ..Panel::new(area, x, value_axis(self.traces, self.index, (from, to))) }
    }

    /// Draws a panel with its axes, the estimates, and over them the true state.
    fn draw(&self, canvas: &mut Canvas, panel: &Panel) {
        panel.draw_grid(canvas, self.labels);
        let (traces, time) = (self.traces, self.traces.time());
        let many = traces.agents() > LINES;
        let lines = if many { 5 } else { 1 + traces.agents() };
        let columns = series::column_count(panel.area.width, self.panels * lines);
        let columns = series::columns(time, &panel.x, columns);
        let truth = series::line(panel, time, &columns, |row| traces.truth(row)[self.index]);
        let estimate = |row, agent| f64::from(traces.estimate(row, agent)[self.index]);
        if many {
            let spreads = series::spreads(time, &columns, traces.agents(), estimate);
            series::draw_spreads(canvas, panel, &spreads);
        } else {
            for agent in 0..traces.agents() {
                let line = series::line(panel, time, &columns, |row| estimate(row, agent));
                canvas.line(line, estimate_line(agent));
            }
        }
        canvas.line(truth, TRUTH);
        panel.draw_frame(canvas, self.labels);
        if self.labels.x_ticks {
            panel.label_x(canvas, TIME_LABEL);
        }
    }
}

fn ends(traces: &Traces) -> (f64, f64) {
    (traces.time().first().copied().unwrap_or(0.0), traces.time().last().copied().unwrap_or(1.0))
}

/// An axis for what the true state does in a stretch of time \[s\], the estimates at its start,
/// and what the estimates exceed that by, up to half of it again.
fn value_axis(traces: &Traces, component: usize, (from, to): (f64, f64)) -> Axis {
    let time = traces.time();
    let rows = time.partition_point(|&t| t < from)..time.partition_point(|&t| t <= to);
    let truth = rows.clone().map(|row| traces.truth(row)[component]);
    let estimates = |row: usize| {
        let estimate = move |agent| f64::from(traces.estimate(row, agent)[component]);
        (0..traces.agents()).map(estimate)
    };
    let Some((low, high)) = extent(truth.chain(rows.clone().take(1).flat_map(estimates))) else {
        return Axis::exact(0.0, 1.0, 3.0);
    };
    let room = 0.5 * (high - low);
    let sampled = rows.len().div_ceil(AXIS_SAMPLES).max(1);
    let (least, greatest) =
        extent(rows.step_by(sampled).flat_map(estimates)).unwrap_or((low, high));
    let (low, high) = (least.clamp(low - room, low), greatest.clamp(high, high + room));
    let margin = 0.06 * (high - low).max(1e-9);
    Axis::exact(low - margin, high + margin, 3.0)
}

/// Smallest and largest of those values that are finite.
fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let finite = values.filter(|value| value.is_finite()).map(|value| (value, value));
    finite.reduce(|(low, high), (value, _)| (low.min(value), high.max(value)))
}

/// Until when the estimates settle, with as much again to show it; `None` if they start settled.
fn transient(traces: &Traces) -> Option<f64> {
    let (start, end) = ends(traces);
    let error = |row: usize| {
        let errors = (0..traces.agents()).map(|agent| traces.error(row, agent));
        errors.filter(|error| error.is_finite()).fold(0.0, f64::max)
    };
    let initial = (traces.rows() > 0).then(|| error(0))?;
    let settled = (0..traces.rows()).find(|&row| error(row) < 0.05 * initial)?;
    let length = round_up(2.0 * (traces.time()[settled] - start));
    (length > 0.0 && length < 0.25 * (end - start)).then_some(start + length)
}

fn subscript(number: usize) -> String {
    let digits = number.to_string();
    digits.chars().filter_map(|digit| char::from_u32('₀' as u32 + digit.to_digit(10)?)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn components_are_numbered_with_subscripts() {
        assert_eq!(subscript(12), "₁₂");
    }
}
