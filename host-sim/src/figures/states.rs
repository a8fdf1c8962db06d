//! True state and all estimates over time, one panel per component.
//!
//! Up to four components are stacked, each next to an enlarged view of its transient; more are
//! arranged in a grid of two or three columns.

use super::Figure;
use super::axis::{Axis, round_up};
use super::canvas::{Anchor, Canvas, Rect, Stroke, TextAt, WIDTH};
use super::palette::{self, LINES};
use super::panel::{
    BOTTOM_MARGIN, Entry, LABEL_BASELINE, LABEL_SPACE, LEGEND_ROW, LEGEND_TOP, Labels, NOTE, Panel,
    RIGHT_MARGIN, Sample, TICK_SIZE, TIME_LABEL, draw_legend, draw_title, legend_rows,
};
use super::series::{self, BANDS, MEDIAN};
use crate::engine::traces::Traces;

/// Dashed and drawn over the estimates, which remain visible through the gaps.
const TRUTH: Stroke = Stroke::solid("#000000", 1.0).dashed(4.0, 2.5);

/// Up to this many components are stacked.
const STACKED: usize = 4;

/// Approximate number of rows sampled for the range of an axis.
const AXIS_SAMPLES: usize = 2000;

/// Input of [`states`].
#[derive(Clone, Copy, Debug)]
pub struct StateFigure<'a> {
    /// Title of the figure.
    pub title: &'a str,
    /// The run.
    pub traces: &'a Traces,
    /// Names of the components, shape `[n]`.
    pub names: &'a [String],
    /// What the true state is called; `None` if it is not known.
    pub truth: Option<&'a str>,
}

/// Draws `x_0(t)` and every agent's `x_hat_i(t)`.
#[must_use]
pub fn states(figure: &StateFigure<'_>) -> Figure {
    let traces = figure.traces;
    let mut canvas = Canvas::new();
    let layout = if traces.dimension() <= STACKED { stack(figure) } else { grid(figure) };
    draw_title(&mut canvas, figure.title, layout.left);
    let entries = legend(traces, figure.truth);
    let rows = legend_rows(&entries, WIDTH - layout.left - RIGHT_MARGIN);
    draw_legend(&mut canvas, &rows, layout.left, LEGEND_TOP);
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0;
    let mut bottom = top;
    for one in &layout.components {
        let area = Rect { top: top + one.area.top, ..one.area };
        let panel = one.panel(area);
        one.draw(&mut canvas, &panel, traces, layout.components.len());
        match one.name {
            Name::Beside(name) => panel.label_y(&mut canvas, name, LABEL_BASELINE),
            Name::Above(name) => {
                let at = TextAt::new(area.left, area.top - 4.0, TICK_SIZE, Anchor::Start);
                // The note of the axis is at the other end.
                let note = super::font::width(&one.y.note(), TICK_SIZE);
                canvas.text(name, at.within(area.width - note - 4.0));
            }
            Name::None => {}
        }
        bottom = bottom.max(area.bottom());
    }
    Figure { svg: canvas.finish(bottom + BOTTOM_MARGIN) }
}

fn legend(traces: &Traces, truth: Option<&str>) -> Vec<Entry> {
    let entry = |text: &str, sample| Entry { text: text.to_owned(), sample };
    let truth = truth.map(|name| entry(name, Sample::Line(TRUTH)));
    if traces.agents() > LINES {
        let estimates = [
            entry(&format!("{} estimates:", traces.agents()), Sample::None),
            entry("median", Sample::Line(MEDIAN)),
            entry("5–95 %", Sample::Patch(palette::TOGETHER, BANDS[0] + BANDS[1])),
            entry("min–max", Sample::Patch(palette::TOGETHER, BANDS[0])),
        ];
        return truth.into_iter().chain(estimates).collect();
    }
    let agents = (0..traces.agents())
        .map(|agent| entry(&format!("agent {}", agent + 1), Sample::Line(estimate_line(agent))));
    truth.into_iter().chain([entry("estimates:", Sample::None)]).chain(agents).collect()
}

const fn estimate_line(agent: usize) -> Stroke {
    Stroke::solid(palette::agent(agent), 1.1)
}

/// Arrangement of the panels, starting at height 0.
struct Layout<'a> {
    /// Left edge of the first column of panels.
    left: f64,
    components: Vec<Component<'a>>,
}

/// Stacks the components, each next to its transient if there is one.
fn stack<'a>(figure: &StateFigure<'a>) -> Layout<'a> {
    let traces = figure.traces;
    let (start, end) = ends(traces);
    let whole = (start, end);
    let transient = transient(traces).map(|until| (start, until));
    let axes = |window| (0..traces.dimension()).map(move |index| value_axis(traces, index, window));
    let (wholes, transients): (Vec<_>, Vec<_>) =
        (axes(whole).collect(), transient.into_iter().flat_map(axes).collect());
    let left = LABEL_SPACE + labels_width(&wholes, TICK_SIZE);
    let room = WIDTH - left - RIGHT_MARGIN;
    // Leave room for the labels of the right column and half of the last label of the left one.
    let between = labels_width(&transients, TICK_SIZE) + 12.0;
    let right = if transient.is_some() { 0.3 * room } else { 0.0 };
    let wide = if transient.is_some() { room - right - between } else { room };
    let noted = wholes.iter().chain(&transients).any(|axis| !axis.note().is_empty());
    let (gap, height) = (if noted { NOTE + 4.0 } else { 8.0 }, 88.0);
    let first = if noted { NOTE } else { 0.0 };
    let columns = [(Some(whole), wholes), (transient, transients)];
    let mut components = Vec::new();
    for (column, (window, axes)) in columns.into_iter().enumerate() {
        let Some(window) = window else { continue };
        for (index, y) in axes.into_iter().enumerate() {
            let x_ticks = index + 1 == traces.dimension();
            let top = first + index as f64 * (height + gap);
            let (left, width) =
                if column == 0 { (left, wide) } else { (left + wide + between, right) };
            let name = figure.names.get(index).filter(|_| column == 0);
            components.push(Component {
                index,
                name: name.map_or(Name::None, |name| Name::Beside(name)),
                window,
                y,
                area: Rect { left, top, width, height },
                tick_size: TICK_SIZE,
                labels: Labels { x_ticks, y_ticks: true, minor_grid: true },
            });
        }
    }
    Layout { left, components }
}

/// Arranges the components in a grid, with their names above.
fn grid<'a>(figure: &StateFigure<'a>) -> Layout<'a> {
    let traces = figure.traces;
    let tick_size = TICK_SIZE - 1.0;
    let columns = if traces.dimension() <= 8 { 2 } else { 3 };
    let name_height = 19.0;
    let axes: Vec<Axis> =
        (0..traces.dimension()).map(|index| value_axis(traces, index, ends(traces))).collect();
    let widest = labels_width(&axes, tick_size);
    let (left, between) = (6.0 + widest, widest + 12.0);
    let width = (WIDTH - left - RIGHT_MARGIN - between * (columns - 1) as f64) / columns as f64;
    let height = if columns == 2 { 82.0 } else { 74.0 };
    let component = |(index, y): (usize, Axis)| {
        let (row, column) = (index / columns, index % columns);
        // Only the lowest panel of a column has a time axis.
        let x_ticks = index + columns >= traces.dimension();
        Component {
            index,
            name: figure.names.get(index).map_or(Name::None, |name| Name::Above(name)),
            window: ends(traces),
            y,
            area: Rect {
                left: left + column as f64 * (width + between),
                top: 10.0 + row as f64 * (height + name_height),
                width,
                height,
            },
            tick_size,
            labels: Labels { x_ticks, y_ticks: true, minor_grid: false },
        }
    };
    Layout { left, components: axes.into_iter().enumerate().map(component).collect() }
}

fn labels_width(axes: &[Axis], tick_size: f64) -> f64 {
    axes.iter().map(|y| Panel::y_labels_width(y, tick_size)).fold(0.0, f64::max)
}

/// Position of a component's name.
#[derive(Clone, Copy, Debug)]
enum Name<'a> {
    Beside(&'a str),
    Above(&'a str),
    None,
}

/// A panel showing a component of the state over a window of time \[s\].
struct Component<'a> {
    /// Index of the component, from 0.
    index: usize,
    name: Name<'a>,
    window: (f64, f64),
    y: Axis,
    area: Rect,
    tick_size: f64,
    labels: Labels,
}

impl Component<'_> {
    fn panel(&self, area: Rect) -> Panel {
        let (from, to) = self.window;
        let x = Axis::horizontal(from, to, area.width, self.tick_size);
        Panel { tick_size: self.tick_size, ..Panel::new(area, x, self.y.clone()) }
    }

    /// Draws a panel, one of `panels`, with its axes, the estimates, and the true state over them.
    fn draw(&self, canvas: &mut Canvas, panel: &Panel, traces: &Traces, panels: usize) {
        panel.draw_grid(canvas, self.labels);
        let time = traces.time();
        let many = traces.agents() > LINES;
        let lines = if many { 5 } else { 1 + traces.agents() };
        let columns = series::column_count(panel.area.width, panels * lines);
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

/// Creates an axis for the true state in a window of time \[s\] and the estimates at its start.
/// Later estimates extend the range by up to half.
fn value_axis(traces: &Traces, component: usize, (from, to): (f64, f64)) -> Axis {
    let time = traces.time();
    let rows = time.partition_point(|&t| t < from)..time.partition_point(|&t| t <= to);
    let truth = rows.clone().map(|row| traces.truth(row)[component]);
    let estimates = |row: usize| {
        let estimate = move |agent| f64::from(traces.estimate(row, agent)[component]);
        (0..traces.agents()).map(estimate)
    };
    let sampled = rows.len().div_ceil(AXIS_SAMPLES).max(1);
    let known = extent(truth);
    let first = extent(rows.clone().take(1).flat_map(estimates));
    // Without the true state all estimates count.
    let all = || extent(rows.clone().step_by(sampled).flat_map(estimates));
    let base = match (known, first) {
        (None, _) => all(),
        (Some(known), None) => Some(known),
        (Some(known), Some(first)) => Some((known.0.min(first.0), known.1.max(first.1))),
    };
    let Some((low, high)) = base else { return Axis::exact(0.0, 1.0, 3.0) };
    let room = 0.5 * (high - low);
    let (least, greatest) =
        extent(rows.step_by(sampled).flat_map(estimates)).unwrap_or((low, high));
    let (low, high) = (least.clamp(low - room, low), greatest.clamp(high, high + room));
    let largest = low.abs().max(high.abs());
    // A constant is centred.
    let length = if high - low > 1e-12 * largest { high - low } else { largest };
    let margin = 0.06 * if length > 0.0 { length } else { 1.0 };
    Axis::exact(low - margin, high + margin, 3.0)
}

/// Returns the smallest and largest finite value.
fn extent(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let finite = values.filter(|value| value.is_finite()).map(|value| (value, value));
    finite.reduce(|(low, high), (value, _)| (low.min(value), high.max(value)))
}

/// Returns the end of the transient, twice the time at which the estimates settle; `None` if they
/// start settled.
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
