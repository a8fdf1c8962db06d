//! Axes on the canvas: frame, grid, ticks and labels.

use super::axis::Axis;
use super::canvas::{Anchor, Canvas, INK, PathData, Rect, Stroke, TextAt, WIDTH};
use super::font;

/// Font size of axis labels and titles. \[user unit\]
pub(super) const LABEL_SIZE: f64 = 11.5;

/// Height reserved for a note above a panel. \[user unit\]
pub(super) const NOTE: f64 = 11.0;

/// Position of the y axis label, and the space left of tick labels. \[user unit\]
pub(super) const LABEL_BASELINE: f64 = 14.0;
pub(super) const LABEL_SPACE: f64 = 23.0;

/// Font size of tick labels and legends. \[user unit\]
pub(super) const TICK_SIZE: f64 = 10.5;

const MAJOR_GRID: Stroke = Stroke::solid("#d9d9d9", 0.6);
const MINOR_GRID: Stroke = Stroke::solid("#efefef", 0.45);
pub(super) const FRAME: Stroke = Stroke::solid(INK, 0.8);

/// Space right of all panels, for half of the last tick label. \[user unit\]
pub(super) const RIGHT_MARGIN: f64 = 13.0;

/// Space below the lowest panel, for the time axis. \[user unit\]
pub(super) const BOTTOM_MARGIN: f64 = 37.0;

/// Label of every time axis.
pub(super) const TIME_LABEL: &str = "time t [s]";

/// Writes the title of a figure whose panels start at `left`; legends start at [`LEGEND_TOP`].
pub(super) fn draw_title(canvas: &mut Canvas, title: &str, left: f64) {
    let at = TextAt::new(left, 15.0, LABEL_SIZE + 0.5, Anchor::Start);
    canvas.text(title, at.within(WIDTH - left - RIGHT_MARGIN));
}

/// Top of the legends. \[user unit\]
pub(super) const LEGEND_TOP: f64 = 22.0;

/// Length of a tick. \[user unit\]
pub(super) const TICK: f64 = 3.5;

/// The parts of the axes to draw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Labels {
    pub x_ticks: bool,
    pub y_ticks: bool,
    pub minor_grid: bool,
}

/// A plotting area with its axes.
#[derive(Clone, Debug)]
pub(super) struct Panel {
    pub area: Rect,
    pub x: Axis,
    pub y: Axis,
    /// Font size of tick labels.
    pub tick_size: f64,
}

impl Panel {
    pub(super) fn new(area: Rect, x: Axis, y: Axis) -> Self {
        Self { area, x, y, tick_size: TICK_SIZE }
    }

    /// Maps a value of the x axis to the canvas.
    #[inline]
    pub(super) fn at_x(&self, value: f64) -> f64 {
        self.area.left + self.x.part(value) * self.area.width
    }

    /// Maps a value of the y axis to the canvas.
    #[inline]
    pub(super) fn at_y(&self, value: f64) -> f64 {
        self.area.bottom() - self.y.part(value) * self.area.height
    }

    /// Draws the background and the grid, behind the data.
    pub(super) fn draw_grid(&self, canvas: &mut Canvas, labels: Labels) {
        canvas.fill(self.area, "#ffffff");
        if labels.minor_grid {
            canvas.line(self.grid(&self.x.minor_ticks(), &self.y.minor_ticks()), MINOR_GRID);
        }
        canvas.line(self.grid(&self.x.ticks(), &self.y.ticks()), MAJOR_GRID);
    }

    fn grid(&self, x_ticks: &[f64], y_ticks: &[f64]) -> PathData {
        let mut grid = PathData::default();
        for &tick in x_ticks {
            grid.move_to(self.at_x(tick), self.area.top);
            grid.line_to(self.at_x(tick), self.area.bottom());
        }
        for &tick in y_ticks {
            grid.move_to(self.area.left, self.at_y(tick));
            grid.line_to(self.area.right(), self.at_y(tick));
        }
        grid
    }

    /// Returns the width of the y axis tick labels, including the tick. \[user unit\]
    pub(super) fn y_labels_width(y: &Axis, tick_size: f64) -> f64 {
        let widths = y.ticks().into_iter().map(|tick| font::width(&y.label(tick), tick_size));
        TICK + 2.0 + widths.fold(0.0, f64::max)
    }

    /// Draws the frame, the ticks and their labels over the data, and the note of the y axis above
    /// its right end.
    pub(super) fn draw_frame(&self, canvas: &mut Canvas, labels: Labels) {
        let mut ticks = PathData::default();
        let (left, bottom) = (self.area.left, self.area.bottom());
        for tick in self.x.ticks() {
            let x = self.at_x(tick);
            ticks.move_to(x, bottom);
            ticks.line_to(x, bottom + TICK);
            if labels.x_ticks {
                let label = self.x.label(tick);
                // The last label must stay within the figure.
                let half = 0.5 * font::width(&label, self.tick_size);
                let x = x.min(WIDTH - 1.0 - half);
                let y = bottom + TICK + 1.0 + self.tick_size;
                canvas.text(&label, TextAt::new(x, y, self.tick_size, Anchor::Middle));
            }
        }
        for tick in self.y.ticks() {
            if !labels.y_ticks {
                break;
            }
            let y = self.at_y(tick);
            ticks.move_to(left, y);
            ticks.line_to(left - TICK, y);
            let at = TextAt::new(
                left - TICK - 2.0,
                y + 0.36 * self.tick_size,
                self.tick_size,
                Anchor::End,
            );
            canvas.text(&self.y.label(tick), at);
        }
        canvas.line(ticks, FRAME);
        canvas.frame(self.area, FRAME);
        let note = self.y.note();
        if labels.y_ticks && !note.is_empty() {
            let at = TextAt::new(
                self.area.right(),
                self.area.top - 3.0,
                self.tick_size - 1.0,
                Anchor::End,
            );
            canvas.text(&note, at);
        }
    }

    /// Writes the label and the note of the x axis below its tick labels.
    pub(super) fn label_x(&self, canvas: &mut Canvas, label: &str) {
        let label = match self.x.note() {
            note if note.is_empty() => label.to_owned(),
            note => format!("{label}  ({note})"),
        };
        let x = self.area.left + 0.5 * self.area.width;
        let y = self.area.bottom() + TICK + self.tick_size + LABEL_SIZE + 4.5;
        canvas.text(&label, TextAt::new(x, y, LABEL_SIZE, Anchor::Middle));
    }

    /// Writes the label of the y axis, reading upwards, with its baseline at `x` and not much
    /// longer than the axis.
    pub(super) fn label_y(&self, canvas: &mut Canvas, label: &str, x: f64) {
        let y = self.area.top + 0.5 * self.area.height;
        let at = TextAt::new(x, y, LABEL_SIZE, Anchor::Middle).upwards();
        canvas.text(label, at.within(self.area.height + 6.0));
    }
}

/// An entry of a legend.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    pub text: String,
    pub sample: Sample,
}

/// The sample in front of a legend text.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Sample {
    Line(Stroke),
    /// A line that is vertical in the figure.
    Upright(Stroke),
    /// A filled patch with colour and opacity.
    Patch(&'static str, f64),
    /// A point.
    Mark {
        is_filled: bool,
        is_ringed: bool,
    },
    None,
}

/// Radii of a point in a legend, and of the ring around it. \[user unit\]
const MARK: f64 = 3.0;
const MARK_RING: f64 = 5.4;

const SAMPLE_WIDTH: f64 = 16.0;
const SAMPLE_GAP: f64 = 4.0;
const ENTRY_GAP: f64 = 9.5;

/// Height of a row of a legend. \[user unit\]
pub(super) const LEGEND_ROW: f64 = 14.5;

/// Breaks a legend into rows of at most `width`.
pub(super) fn legend_rows(entries: &[Entry], width: f64) -> Vec<Vec<&Entry>> {
    let mut rows: Vec<Vec<&Entry>> = Vec::new();
    let mut used = f64::INFINITY;
    for entry in entries {
        let wide = entry_width(entry);
        if used + wide > width {
            rows.push(Vec::new());
            used = 0.0;
        }
        used += wide + ENTRY_GAP;
        rows.last_mut().expect("the first entry opens a row").push(entry);
    }
    rows
}

fn entry_width(entry: &Entry) -> f64 {
    sample_width(entry.sample) + font::width(&entry.text, TICK_SIZE)
}

/// Returns the width of a sample and the gap after it.
fn sample_width(sample: Sample) -> f64 {
    match sample {
        Sample::None => 0.0,
        Sample::Upright(_) => 4.0 + SAMPLE_GAP,
        Sample::Mark { .. } => 2.0 * MARK_RING + SAMPLE_GAP,
        Sample::Line(_) | Sample::Patch(..) => SAMPLE_WIDTH + SAMPLE_GAP,
    }
}

/// Draws a legend from (`left`, `top`) downwards.
pub(super) fn draw_legend(canvas: &mut Canvas, rows: &[Vec<&Entry>], left: f64, top: f64) {
    for (row, entries) in rows.iter().enumerate() {
        let middle = top + (row as f64 + 0.5) * LEGEND_ROW;
        let mut x = left;
        for entry in entries {
            let text_at = x + sample_width(entry.sample);
            match entry.sample {
                Sample::Line(stroke) => {
                    canvas.segment((x, middle), (x + SAMPLE_WIDTH, middle), stroke);
                }
                Sample::Upright(stroke) => {
                    let half = 0.46 * LEGEND_ROW;
                    canvas.segment((x + 2.0, middle + half), (x + 2.0, middle - half), stroke);
                }
                Sample::Patch(color, opacity) => {
                    let mut patch = PathData::default();
                    for (dx, dy) in
                        [(0.0, -4.0), (SAMPLE_WIDTH, -4.0), (SAMPLE_WIDTH, 4.0), (0.0, 4.0)]
                    {
                        patch.line_to(x + dx, middle + dy);
                    }
                    canvas.area(patch, color, opacity);
                }
                Sample::Mark { is_filled, is_ringed } => {
                    let centre = (x + MARK_RING, middle);
                    canvas.mark(centre, MARK, if is_filled { INK } else { "#ffffff" }, INK);
                    if is_ringed {
                        canvas.ring(centre, MARK_RING, Stroke::solid(INK, 1.0));
                    }
                }
                Sample::None => {}
            }
            let at = TextAt::new(text_at, middle + 0.36 * TICK_SIZE, TICK_SIZE, Anchor::Start);
            canvas.text(&entry.text, at);
            x += entry_width(entry) + ENTRY_GAP;
        }
    }
}
