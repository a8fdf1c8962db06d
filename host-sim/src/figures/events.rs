//! Instants of broadcasts (Figure 3 of the paper).
//!
//! Up to sixty agents whose broadcasts can be told apart get a row of ticks each, one tick a
//! broadcast. Otherwise a map is drawn, a cell an agent (or a group of them) and a short time:
//! the darker, the more broadcasts; under it the mean rate of all agents.

use super::Figure;
use super::axis::Axis;
use super::canvas::{Anchor, Canvas, PathData, Rect, Stroke, TextAt, WIDTH};
use super::palette::{self, LINES};
use super::panel::{
    BOTTOM_MARGIN, Entry, LEGEND_ROW, LEGEND_TOP, Labels, Panel, RIGHT_MARGIN, Sample, TICK_SIZE,
    TIME_LABEL, draw_legend, draw_title,
};

/// Up to this many agents have a row each.
const ROWS: usize = 60;

/// Up to this many broadcasts of an agent are drawn as ticks: about one every user unit.
const TICKS: usize = 380;

/// Most rows of the map.
const MAP_ROWS: usize = 125;

/// Most columns of the map and of the rate.
const MAP_COLUMNS: u64 = 190;

/// Shades of the map.
const SHADES: u32 = 5;

/// Left end of the panels. \[user unit\]
const LEFT: f64 = 50.0;

/// What [`events`] draws.
#[derive(Clone, Copy, Debug)]
pub struct EventFigure<'a> {
    /// Stands above the figure; how many broadcasts are shown is added under it.
    pub title: &'a str,
    /// Of each agent, the steps at whose beginning it broadcast, in ascending order.
    pub events: &'a [&'a [u64]],
    /// Length of a step. \[s\]
    pub step_size: f64,
    /// Begin of the window that is shown. \[s\]
    pub from: f64,
    /// End of the window that is shown. \[s\]
    pub to: f64,
}

impl EventFigure<'_> {
    fn time(&self, tick: u64) -> f64 {
        tick as f64 * self.step_size
    }

    /// The broadcasts of an agent that the window holds.
    fn shown(&self, agent: usize) -> &[u64] {
        let events = self.events[agent];
        // Half a step of tolerance: times are multiples of the step only up to rounding.
        let tolerance = 0.5 * self.step_size;
        let first = events.partition_point(|&tick| self.time(tick) < self.from - tolerance);
        let last = events.partition_point(|&tick| self.time(tick) <= self.to + tolerance);
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
fn agent_panel(figure: &EventFigure<'_>, top: f64) -> Panel {
    let agents = figure.events.len().max(1) as f64;
    let width = WIDTH - LEFT - RIGHT_MARGIN;
    let height = (42.0 * agents).min((2.0 * agents).clamp(150.0, 260.0));
    let x = Axis::horizontal(figure.from, figure.to, width, TICK_SIZE);
    Panel::new(Rect { left: LEFT, top, width, height }, x, Axis::exact(0.0, agents, 1.0))
}

/// Writes the names of a few agents, or numbers of some of many, beside their rows.
fn label_agents(canvas: &mut Canvas, panel: &Panel, agents: usize) {
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

/// Broadcasts of groups of agents in columns of time.
struct Counts {
    rows: usize,
    columns: usize,
    /// Agents that share a row.
    group: usize,
    /// Length of a column, a whole number of steps: otherwise columns of more and of fewer steps
    /// would alternate. \[s\]
    length: f64,
    cells: Vec<u32>,
}

impl Counts {
    fn of(figure: &EventFigure<'_>) -> Self {
        let agents = figure.events.len();
        let group = agents.div_ceil(MAP_ROWS).max(1);
        let rows = agents.div_ceil(group);
        let steps = (((figure.to - figure.from) / figure.step_size).round() as u64).max(1);
        let steps_each = steps.div_ceil(MAP_COLUMNS);
        let columns = steps.div_ceil(steps_each) as usize;
        let length = steps_each as f64 * figure.step_size;
        let mut cells = vec![0; rows * columns];
        for agent in 0..agents {
            for &tick in figure.shown(agent) {
                // Half a step of tolerance: see `shown`.
                let since = figure.time(tick) - figure.from + 0.5 * figure.step_size;
                let column = ((since / length) as usize).min(columns - 1);
                cells[agent / group * columns + column] += 1;
            }
        }
        Self { rows, columns, group, length, cells }
    }

    fn row(&self, row: usize) -> &[u32] {
        &self.cells[row * self.columns..][..self.columns]
    }

    /// The count from which on a cell has the darkest shade: that of one cell in two hundred,
    /// so that a single busy one does not make all others pale.
    fn dark(&self) -> u32 {
        let mut counts: Vec<u32> = self.cells.iter().copied().filter(|&count| count > 0).collect();
        counts.sort_unstable();
        counts
            .get((counts.len() * 199 / 200).min(counts.len().saturating_sub(1)))
            .map_or(1, |&dark| dark)
    }
}

/// Draws the map and under it the rate; returns where the lower panel ends.
fn draw_map(canvas: &mut Canvas, figure: &EventFigure<'_>) -> f64 {
    let counts = Counts::of(figure);
    let map = agent_panel(figure, LEGEND_TOP + 2.0 * LEGEND_ROW + 2.0);
    let area = map.area;
    canvas.fill(area, "#ffffff");
    let dark = counts.dark();
    let shades = SHADES.min(dark);
    let row_height = area.height / counts.rows as f64;
    let cells =
        if counts.group == 1 { "an agent".to_owned() } else { format!("{} agents", counts.group) };
    let milliseconds = (counts.length * 1e5).round() / 100.0;
    let text = format!("broadcasts of {cells} in {milliseconds} ms:");
    let mut legend = vec![Entry { text, sample: Sample::None }];
    for shade in 0..shades {
        // Counts from 1 to `dark` in as many equal classes as there are shades.
        let (above, upto) =
            ((shade * dark).div_ceil(shades), ((shade + 1) * dark).div_ceil(shades));
        let upto = if shade + 1 == shades { u32::MAX } else { upto };
        let opacity = f64::from(shade + 1) / f64::from(shades);
        let mut runs = PathData::default();
        for row in 0..counts.rows {
            let y = area.top + (row as f64 + 0.5) * row_height;
            let mut column = 0;
            for run in counts
                .row(row)
                .chunk_by(|&a, &b| (a > above && a <= upto) == (b > above && b <= upto))
            {
                let end = column + run.len();
                if run[0] > above && run[0] <= upto {
                    let x = |column: usize| map.at_x(figure.from + column as f64 * counts.length);
                    runs.move_to(x(column), y);
                    runs.line_to(x(end).min(area.right()), y);
                }
                column = end;
            }
        }
        canvas.line(runs, Stroke::solid(palette::TOGETHER, row_height).faint(opacity));
        let text = if upto == u32::MAX && above + 1 < u32::MAX {
            format!("≥ {}", above + 1)
        } else {
            class_name(above + 1, upto)
        };
        legend.push(Entry { text, sample: Sample::Patch(palette::TOGETHER, opacity) });
    }
    draw_legend(canvas, &[legend.iter().collect()], LEFT, LEGEND_TOP + LEGEND_ROW);
    label_agents(canvas, &map, figure.events.len());
    map.draw_frame(canvas, Labels { x_ticks: false, y_ticks: false, minor_grid: false });
    draw_rate(canvas, figure, &counts, Rect { top: area.bottom() + 8.0, height: 60.0, ..area })
}

/// The counts of a shade.
fn class_name(first: u32, last: u32) -> String {
    if first == last { first.to_string() } else { format!("{first}–{last}") }
}

/// Draws the mean rate of all agents; returns where the panel ends.
fn draw_rate(canvas: &mut Canvas, figure: &EventFigure<'_>, counts: &Counts, area: Rect) -> f64 {
    let agents = figure.events.len() as f64;
    let rate = |column: usize| {
        let total: u32 = (0..counts.rows).map(|row| counts.row(row)[column]).sum();
        let end = (figure.from + (column + 1) as f64 * counts.length).min(figure.to);
        f64::from(total) / agents / (end - figure.from - column as f64 * counts.length)
    };
    // The last column may be a fraction of a step long.
    let rates: Vec<f64> = (0..counts.columns).map(rate).filter(|rate| rate.is_finite()).collect();
    let largest = rates.iter().copied().fold(0.0, f64::max);
    let x = Axis::horizontal(figure.from, figure.to, area.width, TICK_SIZE);
    let panel = Panel::new(area, x, Axis::rounded(0.0, largest.max(1e-9) * 1.05, 2.0));
    let labels = Labels { x_ticks: true, y_ticks: true, minor_grid: false };
    panel.draw_grid(canvas, labels);
    let mut steps = PathData::default();
    for (column, &rate) in rates.iter().enumerate() {
        let at = |column: usize| {
            panel.at_x(figure.from + column as f64 * counts.length).min(area.right())
        };
        steps.line_to(at(column), panel.at_y(rate));
        steps.line_to(at(column + 1), panel.at_y(rate));
    }
    canvas.line(steps, Stroke::solid(palette::TOGETHER, 0.9));
    panel.draw_frame(canvas, labels);
    panel.label_x(canvas, TIME_LABEL);
    panel.label_y(canvas, "mean [1/s]", 14.0);
    area.bottom()
}
