//! Norms of the estimation errors over time (Figures 1 and 2 of the paper).
//!
//! `|e_1i(t)|` starts at the norm of the initial error and then chatters at a small fraction of it.
//! The upper axes show the steady state on a linear scale, the lower ones the transient on a
//! logarithmic scale. The running root mean square, which the paper's table lists, is drawn over
//! the chattering lines, together with that of the baselines.

use std::ops::Range;

use super::Figure;
use super::axis::{Axis, round_up};
use super::canvas::{Anchor, Canvas, PathData, Rect, Stroke, TextAt, WIDTH};
use super::clip::ClippedLine;
use super::marks::{
    Marker, Reference, draw_markers, draw_references, marker_entries, reference_entries,
};
use super::palette::{self, LINES};
use super::panel::{
    BOTTOM_MARGIN, Entry, LABEL_BASELINE, LABEL_SPACE, LEGEND_ROW, LEGEND_TOP, Labels, NOTE, Panel,
    RIGHT_MARGIN, Sample, TICK_SIZE, TIME_LABEL, draw_legend, draw_title, legend_rows,
};
use super::series::{self, BANDS, MEDIAN, Spread};
use crate::engine::traces::Traces;

const AXIS_LABEL: &str = "estimation error ‖e₁ᵢ(t)‖ [state unit]";

/// Window of the running root mean square, as a fraction of the run.
const RMS_PART: f64 = 0.025;

/// Space above the largest error, as a multiple of it.
const HEADROOM: f64 = 1.06;

/// The transient is assumed to be over after the run divided by this, when choosing the axis.
const TRANSIENT_PART: usize = 4;

/// Height of the transient panel. \[user unit\]
const TRANSIENT_HEIGHT: f64 = 62.0;

/// Input of [`error_norms`].
#[derive(Clone, Copy, Debug)]
pub struct ErrorFigure<'a> {
    /// Title of the figure.
    pub title: &'a str,
    /// The run.
    pub traces: &'a Traces,
    /// Marked instants, in ascending order.
    pub markers: &'a [Marker<'a>],
    /// Runs to compare with.
    pub references: &'a [Reference<'a>],
    /// Upper end of the error axis; `None` uses [`error_axis_limit`] of this run. Pass the same
    /// limit to figures that are to be compared. \[state unit\]
    pub error_limit: Option<f64>,
}

/// Returns an upper limit of the error axis that suits all these runs: the largest error after the
/// first quarter or among the references, plus headroom, rounded up. \[state unit\]
#[must_use]
pub fn error_axis_limit(runs: &[&Traces], references: &[Reference<'_>]) -> f64 {
    let largest = runs.iter().map(|traces| {
        let steady = traces.rows() / TRANSIENT_PART..traces.rows();
        largest_error(traces, steady).unwrap_or(0.0)
    });
    let largest = largest.chain(references.iter().map(Reference::largest));
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
    let (traces, references) = (figure.traces, figure.references);
    let limit = figure.error_limit.unwrap_or_else(|| error_axis_limit(&[traces], references));
    let transient = transient(traces, limit);
    let y = Axis::exact(0.0, limit, 5.0);
    let widest = [Some(&y), transient.as_ref().map(|(_, y)| y)]
        .into_iter()
        .flatten()
        .map(|y| Panel::y_labels_width(y, TICK_SIZE))
        .fold(0.0, f64::max);
    let left = LABEL_SPACE + widest;
    let width = WIDTH - left - RIGHT_MARGIN;
    let mut entries = legend(traces);
    entries.extend(reference_entries(references));
    entries.extend(marker_entries(figure.markers));
    let rows = legend_rows(&entries, width);
    let note = if y.note().is_empty() { 0.0 } else { NOTE };
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0 + note;
    let area = Rect { left, top, width, height: 195.0 };
    let end = traces.time().last().copied().unwrap_or(1.0);
    let start = traces.time().first().copied().unwrap_or(0.0);
    let panel = Panel::new(area, Axis::horizontal(start, end, width, TICK_SIZE), y);

    let mut canvas = Canvas::new();
    draw_title(&mut canvas, figure.title, left);
    draw_legend(&mut canvas, &rows, left, LEGEND_TOP);
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: true };
    panel.draw_grid(&mut canvas, labels);
    // The more lines overlap, the fainter they are.
    let opacity = (1.5 / traces.agents().max(1) as f64).clamp(0.25, 0.5);
    let line = |agent| Stroke::solid(palette::agent(agent), 0.45).faint(opacity);
    draw_errors(&mut canvas, &panel, traces, line, |error| error);
    draw_references(&mut canvas, &panel, references);
    if traces.agents() <= LINES {
        draw_running_rms(&mut canvas, &panel, traces, limit, figure.markers);
    }
    draw_markers(&mut canvas, &panel, figure.markers);
    panel.draw_frame(&mut canvas, labels);
    panel.label_x(&mut canvas, TIME_LABEL);
    panel.label_y(&mut canvas, AXIS_LABEL, LABEL_BASELINE);
    let mut bottom = area.bottom();
    if let Some((until, y)) = transient {
        // The title of the lower panel goes between the two.
        let top = bottom + BOTTOM_MARGIN + TICK_SIZE + 8.0;
        let area = Rect { left, top, width, height: TRANSIENT_HEIGHT };
        let x = Axis::horizontal(start, until, width, TICK_SIZE);
        draw_transient(&mut canvas, &Panel::new(area, x, y), traces);
        bottom = area.bottom();
    }
    Figure { svg: canvas.finish(bottom + BOTTOM_MARGIN) }
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

/// Returns the window of the running root mean square. \[s\]
fn rms_window(traces: &Traces) -> f64 {
    let time = traces.time();
    let length = time.last().zip(time.first()).map_or(0.0, |(end, start)| end - start);
    round_up(RMS_PART * length)
}

const fn rms_line(agent: usize) -> Stroke {
    Stroke::solid(palette::agent(agent), 1.4)
}

/// Draws the errors into the panel: as lines, or as their spread if there are many agents. `scale`
/// is that of the panel's axis.
fn draw_errors(
    canvas: &mut Canvas,
    panel: &Panel,
    traces: &Traces,
    line_of: impl Fn(usize) -> Stroke,
    scale: impl Fn(f64) -> f64 + Sync,
) {
    let time = traces.time();
    if traces.agents() > LINES {
        let columns = series::columns(time, &panel.x, series::column_count(panel.area.width, 6));
        let error = |row, agent| scale(traces.error(row, agent));
        let spreads: Vec<Spread> = series::spreads(time, &columns, traces.agents(), error);
        series::draw_spreads(canvas, panel, &spreads);
        return;
    }
    let columns = columns(panel, traces);
    for agent in 0..traces.agents() {
        let line = series::line(panel, time, &columns, |row| scale(traces.error(row, agent)));
        canvas.line(line, line_of(agent));
    }
}

fn columns(panel: &Panel, traces: &Traces) -> Vec<Range<usize>> {
    let count = series::column_count(panel.area.width, 2 * traces.agents());
    series::columns(traces.time(), &panel.x, count)
}

/// Draws running root mean squares wherever a whole window lies after the transient and does not
/// contain an instant at which the error may jump.
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
    let mut breaks = vec![settling_row(traces, limit)];
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

/// Computes the root mean square of `errors` over a window centred at every second column, where
/// the window lies within these rows.
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

/// Returns the first row after which all errors of the first quarter stay within `limit`.
fn settling_row(traces: &Traces, limit: f64) -> usize {
    let beyond =
        |row: &usize| largest_error(traces, *row..row + 1).is_some_and(|error| error > limit);
    (0..traces.rows() / TRANSIENT_PART).rfind(beyond).map_or(0, |row| row + 1)
}

/// Returns the end \[s\] of the transient that the upper axes cut off, and an axis for it; `None`
/// if nothing is cut off.
fn transient(traces: &Traces, limit: f64) -> Option<(f64, Axis)> {
    let time = traces.time();
    let (start, end) = (*time.first()?, *time.last()?);
    let settled = Some(settling_row(traces, limit)).filter(|&row| row > 0)?;
    let until = (start + round_up(1.5 * (time[settled] - start))).min(end);
    let last = time.partition_point(|&time| time <= until);
    let largest = largest_error(traces, 0..last).unwrap_or(1.0);
    // Down to the first ticks of the upper axes; below that there is only chatter.
    Some((until, Axis::powers(0.2 * limit, largest)))
}

/// Draws the transient.
fn draw_transient(canvas: &mut Canvas, panel: &Panel, traces: &Traces) {
    let area = panel.area;
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: false };
    panel.draw_grid(canvas, labels);
    let line = |agent| Stroke::solid(palette::agent(agent), 0.9);
    draw_errors(canvas, panel, traces, line, libm::log10);
    panel.draw_frame(canvas, labels);
    panel.label_x(canvas, TIME_LABEL);
    let at = TextAt::new(area.left, area.top - 4.0, TICK_SIZE, Anchor::Start);
    canvas.text("transient in full", at);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn running_rms_uses_only_whole_windows_of_its_rows() {
        let area = Rect { left: 0.0, top: 0.0, width: 100.0, height: 100.0 };
        let panel = Panel::new(area, Axis::exact(0.0, 10.0, 5.0), Axis::exact(0.0, 10.0, 5.0));
        let time: Vec<f64> = (0..=1000).map(|row| f64::from(row) * 0.01).collect();
        // 3 in these rows and 9 outside; a window that reached outside would show it.
        let rows = 200..801;
        let errors: Vec<f64> =
            (0..=1000).map(|row| if rows.contains(&row) { 3.0 } else { 9.0 }).collect();
        let columns = series::columns(&time, &panel.x, 100);
        let line = running_rms(&panel, &time, &errors, rows, &columns, 1.0);
        // From t = 2.6 to 7.4 in steps of 0.2: half a window away from 2 and 8, at even columns.
        assert_eq!(line.points(), 25);
        let text = line.into_text();
        assert!(text.starts_with("M26 70l2 0") && !text.contains('-'), "{text}");
    }
}
