//! Density map of the broadcasts of many agents, or over a long time. A cell stands for an agent
//! (or a group of agents) and a short time; darker cells have more broadcasts. A panel below shows
//! the mean rate of all agents.

use super::axis::Axis;
use super::canvas::{Anchor, Canvas, PathData, Rect, Stroke, TextAt};
use super::event_figure::{EventFigure, LEFT, agent_panel, label_agents};
use super::font;
use super::palette;
use super::panel::{LEGEND_ROW, LEGEND_TOP, Labels, Panel, TICK_SIZE, TIME_LABEL};

/// Maximum number of rows of the map.
const ROWS: usize = 125;

/// Maximum number of columns of the map and the rate.
const COLUMNS: u64 = 190;

/// Maximum number of shades.
const SHADES: u32 = 5;

/// Broadcast counts per group of agents and column of time.
struct Counts {
    rows: usize,
    columns: usize,
    /// Agents per row.
    group: usize,
    /// Steps per column. An integer: otherwise columns of more and fewer steps would alternate and
    /// show stripes.
    steps: u64,
    cells: Vec<u32>,
}

impl Counts {
    /// Counts all broadcasts except those at the last instant of the window, which has no column
    /// after it.
    fn of(figure: &EventFigure<'_>) -> Self {
        let window = figure.window();
        let length = window.end().saturating_sub(*window.start()).max(1);
        let steps = length.div_ceil(COLUMNS);
        let columns = length.div_ceil(steps) as usize;
        let agents = figure.events.len();
        let group = agents.div_ceil(ROWS).max(1);
        let rows = agents.div_ceil(group);
        let mut cells = vec![0; rows * columns];
        for agent in 0..agents {
            for tick in figure.shown(agent).iter().filter(|tick| *tick < window.end()) {
                let column = ((tick - window.start()) / steps) as usize;
                cells[agent / group * columns + column] += 1;
            }
        }
        Self { rows, columns, group, steps, cells }
    }

    fn row(&self, row: usize) -> &[u32] {
        &self.cells[row * self.columns..][..self.columns]
    }

    /// Returns the start of a column, which is the end of the previous one. \[s\]
    fn begin(&self, figure: &EventFigure<'_>, column: usize) -> f64 {
        figure.time(*figure.window().start() + column as u64 * self.steps).min(figure.to)
    }

    /// Returns the count at which a cell gets the darkest shade: exceeded by one in two hundred
    /// busy cells, so that a single busy cell does not make all others pale.
    fn dark(&self) -> u32 {
        let mut counts: Vec<u32> = self.cells.iter().copied().filter(|&count| count > 0).collect();
        counts.sort_unstable();
        counts.get(counts.len() * 199 / 200).copied().unwrap_or(1)
    }
}

/// Draws the map with the rate below it; returns the bottom of the lower panel.
pub(super) fn draw_map(canvas: &mut Canvas, figure: &EventFigure<'_>) -> f64 {
    let counts = Counts::of(figure);
    let map = agent_panel(figure, LEGEND_TOP + 2.0 * LEGEND_ROW + 5.0);
    let dark = counts.dark();
    let shades = SHADES.min(dark);
    canvas.fill(map.area, "#ffffff");
    for shade in 1..=shades {
        // Counts from 1 to `dark` fall into classes of equal size; the last class is open.
        let above = ((shade - 1) * dark).div_ceil(shades);
        let upto = if shade == shades { u32::MAX } else { (shade * dark).div_ceil(shades) };
        let cells = cells_of(figure, &map, &counts, |count| count > above && count <= upto);
        canvas.line(cells, shade_stroke(map.area.height / counts.rows as f64, shade, shades));
    }
    draw_shades(canvas, figure, &counts, shades, dark);
    label_agents(canvas, &map, figure.events.len());
    map.draw_frame(canvas, Labels { x_ticks: false, y_ticks: false, minor_grid: false });
    let below = Rect { top: map.area.bottom() + 13.0, height: 60.0, ..map.area };
    draw_rate(canvas, figure, &counts, below)
}

fn shade_stroke(width: f64, shade: u32, shades: u32) -> Stroke {
    Stroke::solid(palette::TOGETHER, width).faint(f64::from(shade) / f64::from(shades))
}

/// Returns the cells with counts in a class; neighbours in a row become one thick line.
fn cells_of(
    figure: &EventFigure<'_>,
    map: &Panel,
    counts: &Counts,
    in_class: impl Fn(u32) -> bool,
) -> PathData {
    let height = map.area.height / counts.rows as f64;
    let mut lines = PathData::default();
    for row in 0..counts.rows {
        let y = map.area.top + (row as f64 + 0.5) * height;
        let mut column = 0;
        for run in counts.row(row).chunk_by(|&one, &next| in_class(one) == in_class(next)) {
            let end = column + run.len();
            if in_class(run[0]) {
                lines.move_to(map.at_x(counts.begin(figure, column)), y);
                lines.line_to(map.at_x(counts.begin(figure, end)), y);
            }
            column = end;
        }
    }
    lines
}

/// Draws the legend of the map: the shades, and the counts of the lightest and the darkest.
fn draw_shades(
    canvas: &mut Canvas,
    figure: &EventFigure<'_>,
    counts: &Counts,
    shades: u32,
    dark: u32,
) {
    let (width, height) = (20.0, 11.0);
    let group =
        if counts.group == 1 { "agent".to_owned() } else { format!("{} agents", counts.group) };
    let milliseconds = (figure.time(counts.steps) * 1e5).round() / 100.0;
    let text = format!("per {group} and {milliseconds} ms:  1");
    let middle = LEGEND_TOP + 1.5 * LEGEND_ROW + 1.0;
    let baseline = middle + 0.36 * TICK_SIZE;
    canvas.text(&text, TextAt::new(LEFT, baseline, TICK_SIZE, Anchor::Start));
    let mut left = LEFT + font::width(&text, TICK_SIZE) + 5.0;
    for shade in 1..=shades {
        canvas.segment((left, middle), (left + width, middle), shade_stroke(height, shade, shades));
        left += width;
    }
    let text = if dark == 1 { "or more".to_owned() } else { format!("{dark} or more") };
    canvas.text(&text, TextAt::new(left + 5.0, baseline, TICK_SIZE, Anchor::Start));
}

/// Draws the mean rate of all agents; returns the bottom of the panel.
fn draw_rate(canvas: &mut Canvas, figure: &EventFigure<'_>, counts: &Counts, area: Rect) -> f64 {
    let agents = figure.events.len() as f64;
    let rate = |column: usize| {
        let (begin, end) = (counts.begin(figure, column), counts.begin(figure, column + 1));
        let total: u32 = (0..counts.rows).map(|row| counts.row(row)[column]).sum();
        (begin, end, f64::from(total) / agents / (end - begin))
    };
    let rates: Vec<_> =
        (0..counts.columns).map(rate).filter(|(_, _, rate)| rate.is_finite()).collect();
    let largest = rates.iter().map(|(_, _, rate)| *rate).fold(0.0, f64::max);
    let x = Axis::horizontal(figure.from, figure.to, area.width, TICK_SIZE);
    let panel = Panel::new(area, x, Axis::rounded(0.0, largest.max(1e-9) * 1.05, 2.0));
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: false };
    panel.draw_grid(canvas, labels);
    let mut steps = PathData::default();
    for (begin, end, rate) in rates {
        steps.line_to(panel.at_x(begin), panel.at_y(rate));
        steps.line_to(panel.at_x(end), panel.at_y(rate));
    }
    canvas.line(steps, Stroke::solid(palette::TOGETHER, 0.9));
    panel.draw_frame(canvas, labels);
    panel.label_x(canvas, TIME_LABEL);
    panel.label_y(canvas, "mean [1/s]", 14.0);
    area.bottom()
}
