//! Norms of the estimation errors over time (Figures 1 and 2 of the paper).
//!
//! `|e_1i(t)|` starts at the norm of the initial error and then chatters at a small fraction of
//! it. The main axes show that steady state on a linear scale and an inset the transient, so
//! that neither hides the other. Over the chattering lines goes their running root mean square,
//! the quantity of the paper's table.

use std::ops::Range;

use super::Figure;
use super::axis::{Axis, round_up};
use super::canvas::{Anchor, Canvas, PathData, Rect, Stroke, TextAt, WIDTH};
use super::clip::ClippedLine;
use super::palette::{self, LINES, SIGNAL};
use super::panel::{
    BOTTOM_MARGIN, Entry, LEGEND_ROW, LEGEND_TOP, Labels, Panel, RIGHT_MARGIN, Sample, TICK_SIZE,
    TIME_LABEL, draw_legend, draw_title, legend_rows,
};
use super::series::{self, BANDS, MEDIAN, Spread};
use crate::engine::traces::Traces;

const AXIS_LABEL: &str = "estimation error ‖e₁ᵢ(t)‖ [state unit]";

/// Width of the window of the running root mean square, as a part of the run.
const RMS_PART: f64 = 0.025;

/// Space above the steady state, for the inset and the labels of markers, as a multiple.
const HEADROOM: f64 = 2.2;

/// An instant that is marked in a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker<'a> {
    /// When. \[s\]
    time: f64,
    label: &'a str,
    stroke: Stroke,
    /// Whether the error may jump here, so that no mean is taken across it.
    jump: bool,
}

impl<'a> Marker<'a> {
    /// Agents begin to collect data, at `time` \[s\]: black, dashed.
    #[must_use]
    pub const fn collection_start(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1).dashed(5.0, 3.0), jump: false }
    }

    /// Agents stop collecting and train, at `time` \[s\]: black, solid.
    #[must_use]
    pub const fn collection_end(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1), jump: false }
    }

    /// Trained networks are switched in, at `time` \[s\]: red, dashed.
    #[must_use]
    pub const fn apply(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid(SIGNAL, 1.3).dashed(5.0, 3.0), jump: true }
    }
}

/// What [`error_norms`] draws.
#[derive(Clone, Copy, Debug)]
pub struct ErrorFigure<'a> {
    /// Stands above the figure.
    pub title: &'a str,
    /// The run.
    pub traces: &'a Traces,
    /// Instants to mark, in ascending order.
    pub markers: &'a [Marker<'a>],
    /// Upper end of the error axis; [`error_axis_limit`] of this run if there is none. Give
    /// figures that are to be compared the same. \[state unit\]
    pub error_limit: Option<f64>,
}

/// An upper end of the error axis that shows the steady state of all these runs well: their
/// largest error in the second half, with headroom, rounded. \[state unit\]
#[must_use]
pub fn error_axis_limit(runs: &[&Traces]) -> f64 {
    let largest = runs.iter().map(|traces| {
        let steady = traces.rows() / 2..traces.rows();
        largest_error(traces, steady).unwrap_or(0.0)
    });
    round_up(HEADROOM * largest.fold(0.0, f64::max))
}

fn largest_error(traces: &Traces, rows: Range<usize>) -> Option<f64> {
    let errors =
        rows.flat_map(|row| (0..traces.agents()).map(move |agent| traces.error(row, agent)));
    errors.filter(|error| error.is_finite()).reduce(f64::max)
}

/// Draws `|e_1i(t)|` of all agents.
#[must_use]
pub fn error_norms(figure: &ErrorFigure<'_>) -> Figure {
    let traces = figure.traces;
    let limit = figure.error_limit.unwrap_or_else(|| error_axis_limit(&[traces]));
    let entries = legend(traces);
    let left = 50.0;
    let width = WIDTH - left - RIGHT_MARGIN;
    let rows = legend_rows(&entries, width);
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0;
    let area = Rect { left, top, width, height: 195.0 };
    let end = traces.time().last().copied().unwrap_or(1.0);
    let start = traces.time().first().copied().unwrap_or(0.0);
    let panel = Panel::new(
        area,
        Axis::horizontal(start, end, width, TICK_SIZE),
        Axis::exact(0.0, limit, 5.0),
    );

    let mut canvas = Canvas::new();
    draw_title(&mut canvas, figure.title, left);
    draw_legend(&mut canvas, &rows, left, LEGEND_TOP);
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: true };
    panel.draw_grid(&mut canvas, labels);
    // The more lines lie over each other, the fainter.
    let opacity = (1.5 / traces.agents().max(1) as f64).clamp(0.25, 0.5);
    draw_errors(&mut canvas, &panel, traces, |agent| {
        Stroke::solid(palette::agent(agent), 0.45).faint(opacity)
    });
    if traces.agents() <= LINES {
        draw_running_rms(&mut canvas, &panel, traces, limit, figure.markers);
    }
    draw_markers(&mut canvas, &panel, figure.markers);
    if let Some(transient) = transient(traces, limit) {
        draw_transient(&mut canvas, &panel, traces, transient);
    }
    panel.draw_frame(&mut canvas, labels);
    panel.label_x(&mut canvas, TIME_LABEL);
    panel.label_y(&mut canvas, AXIS_LABEL, 14.0);
    Figure { svg: canvas.finish(area.bottom() + BOTTOM_MARGIN) }
}

fn legend(traces: &Traces) -> Vec<Entry> {
    let entry = |text: &str, sample| Entry { text: text.to_owned(), sample };
    if traces.agents() > LINES {
        return vec![
            entry(&format!("{} agents:", traces.agents()), Sample::None),
            entry("median", Sample::Line(MEDIAN)),
            entry("5–95 %", Sample::Patch(palette::TOGETHER, BANDS[0] + BANDS[1])),
            entry("min–max", Sample::Patch(palette::TOGETHER, BANDS[0])),
        ];
    }
    let agents = (0..traces.agents())
        .map(|agent| entry(&format!("agent {}", agent + 1), Sample::Line(rms_line(agent))));
    let note = entry(&format!("bold: RMS over {} s", rms_window(traces)), Sample::None);
    agents.chain([note]).collect()
}

/// Width of the window of the running root mean square. \[s\]
fn rms_window(traces: &Traces) -> f64 {
    let time = traces.time();
    let length = time.last().zip(time.first()).map_or(0.0, |(end, start)| end - start);
    round_up(RMS_PART * length)
}

const fn rms_line(agent: usize) -> Stroke {
    Stroke::solid(palette::agent(agent), 1.4)
}

/// Draws the errors into the panel, with lines as given, or their spread if there are many.
fn draw_errors(
    canvas: &mut Canvas,
    panel: &Panel,
    traces: &Traces,
    line_of: impl Fn(usize) -> Stroke,
) {
    let time = traces.time();
    if traces.agents() > LINES {
        let columns = series::columns(time, &panel.x, series::column_count(panel.area.width, 6));
        let spreads: Vec<Spread> =
            series::spreads(time, &columns, traces.agents(), |row, agent| traces.error(row, agent));
        series::draw_spreads(canvas, panel, &spreads);
        return;
    }
    let columns = columns(panel, traces);
    for agent in 0..traces.agents() {
        let line = series::line(panel, time, &columns, |row| traces.error(row, agent));
        canvas.line(line, line_of(agent));
    }
}

fn columns(panel: &Panel, traces: &Traces) -> Vec<Range<usize>> {
    let count = series::column_count(panel.area.width, 2 * traces.agents());
    series::columns(traces.time(), &panel.x, count)
}

/// Draws running root mean squares where a whole window lies behind the transient and not
/// across an instant at which the error may jump.
fn draw_running_rms(
    canvas: &mut Canvas,
    panel: &Panel,
    traces: &Traces,
    limit: f64,
    markers: &[Marker<'_>],
) {
    let time = traces.time();
    let columns = columns(panel, traces);
    let window = rms_window(traces);
    // Without an end of the transient there is nothing steady.
    let mut breaks = vec![settling_row(traces, limit).unwrap_or(traces.rows())];
    let jumps = markers.iter().filter(|marker| marker.jump);
    breaks.extend(jumps.map(|marker| time.partition_point(|&t| t < marker.time)));
    breaks.push(traces.rows());
    breaks.sort_unstable();
    for agent in 0..traces.agents() {
        let errors: Vec<f64> = (0..traces.rows()).map(|row| traces.error(row, agent)).collect();
        for piece in breaks.windows(2) {
            let line = running_rms(panel, time, &errors, piece[0]..piece[1], &columns, window);
            canvas.line(line, rms_line(agent));
        }
    }
}

/// Root mean square of `errors` over a window centred at every second column, where the window
/// lies within these rows.
fn running_rms(
    panel: &Panel,
    time: &[f64],
    errors: &[f64],
    rows: Range<usize>,
    columns: &[Range<usize>],
    window: f64,
) -> PathData {
    let mut line = ClippedLine::new(panel.area);
    let (Some(&begin), Some(&end)) = (time.get(rows.start), time[..rows.end].last()) else {
        return line.finish();
    };
    let (mut first, mut last, mut sum) = (rows.start, rows.start, 0.0);
    for row in columns.iter().step_by(2).map(|column| column.start) {
        let (from, to) = (time[row] - 0.5 * window, time[row] + 0.5 * window);
        if from < begin || to > end {
            continue;
        }
        while last < rows.end && time[last] <= to {
            sum += errors[last] * errors[last];
            last += 1;
        }
        while time[first] < from {
            sum -= errors[first] * errors[first];
            first += 1;
        }
        let mean = sum.max(0.0) / (last - first) as f64;
        line.line_to(panel.at_x(time[row]), panel.at_y(mean.sqrt()));
    }
    line.finish()
}

fn draw_markers(canvas: &mut Canvas, panel: &Panel, markers: &[Marker<'_>]) {
    let mut labelled_to = f64::NEG_INFINITY;
    let shown = |marker: &&Marker<'_>| (panel.x.from..=panel.x.to).contains(&marker.time);
    for marker in markers.iter().filter(shown) {
        let x = panel.at_x(marker.time);
        canvas.segment((x, panel.area.bottom()), (x, panel.area.top), marker.stroke);
        // A label stands left of its line; of lines that are close together the first has one.
        if x - labelled_to > 1.3 * TICK_SIZE {
            let at = TextAt::new(x - 3.0, panel.area.top + 5.0, TICK_SIZE - 0.5, Anchor::End);
            canvas.text(marker.label, at.upwards().colored(marker.stroke.color));
            labelled_to = x;
        }
    }
}

/// The first row at which all errors are within `limit`.
fn settling_row(traces: &Traces, limit: f64) -> Option<usize> {
    let within =
        |row: &usize| largest_error(traces, *row..row + 1).is_none_or(|error| error <= limit);
    (0..traces.rows()).find(within)
}

/// Until when the inset shows the transient that the main axes cut off \[s\]; `None` if there
/// is none.
fn transient(traces: &Traces, limit: f64) -> Option<f64> {
    let time = traces.time();
    let (start, end) = (*time.first()?, *time.last()?);
    let settled = settling_row(traces, limit).filter(|&row| row > 0)?;
    let length = round_up(1.5 * (time[settled] - start));
    (length < 0.25 * (end - start)).then_some(start + length)
}

/// Draws the transient in full into the upper right corner.
fn draw_transient(canvas: &mut Canvas, panel: &Panel, traces: &Traces, until: f64) {
    let main = panel.area;
    let width = 0.40 * main.width;
    let area = Rect {
        left: main.right() - width - 9.0,
        top: main.top + 9.0,
        width,
        height: 0.34 * main.height,
    };
    let start = panel.x.from;
    let last = traces.time().partition_point(|&time| time <= until);
    let largest = largest_error(traces, 0..last).unwrap_or(1.0);
    let inset = Panel {
        tick_size: TICK_SIZE - 1.0,
        ..Panel::new(
            area,
            Axis::horizontal(start, until, width, TICK_SIZE - 1.0),
            Axis::rounded(0.0, largest, 3.0),
        )
    };
    let behind = Rect {
        left: area.left - 22.0,
        top: main.top,
        width: main.right() - area.left + 22.0,
        height: area.height + 27.0,
    };
    canvas.fill(behind, "#ffffff");
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: false };
    inset.draw_grid(canvas, labels);
    draw_errors(canvas, &inset, traces, |agent| Stroke::solid(palette::agent(agent), 0.9));
    inset.draw_frame(canvas, labels);
    let at = TextAt::new(area.right() - 5.0, area.top + 12.0, TICK_SIZE - 1.0, Anchor::End);
    canvas.text("transient in full", at);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_running_rms_is_that_of_whole_windows_of_its_rows() {
        let area = Rect { left: 0.0, top: 0.0, width: 100.0, height: 100.0 };
        let panel = Panel::new(area, Axis::exact(0.0, 10.0, 5.0), Axis::exact(0.0, 10.0, 5.0));
        let time: Vec<f64> = (0..=1000).map(|row| f64::from(row) * 0.01).collect();
        // 3 where it counts; a window that reached beyond would show some of the 9.
        let rows = 200..801;
        let errors: Vec<f64> =
            (0..=1000).map(|row| if rows.contains(&row) { 3.0 } else { 9.0 }).collect();
        let columns = series::columns(&time, &panel.x, 100);
        let line = running_rms(&panel, &time, &errors, rows, &columns, 1.0);
        // From t = 2.6 to 7.4, every 0.2: half a window from 2 and 8, at even columns.
        assert_eq!(line.points(), 25);
        let text = line.into_text();
        assert!(text.starts_with("M26 70l2 0") && !text.contains('-'), "{text}");
    }
}
