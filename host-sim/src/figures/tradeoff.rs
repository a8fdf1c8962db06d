//! Error against broadcasts of the cells of a study, on logarithmic axes.
//!
//! A mark is the median of a cell, bars its interval over all runs. Cells that differ in one key only
//! are joined by a line, which has its own colour. Down and left is better.

use super::Figure;
use super::canvas::{Anchor, Canvas, Rect, Stroke, TextAt, WIDTH};
use super::clip::ClippedLine;
use super::font;
use super::logarithmic::{axis, draw_fine_grid, draw_frame, labels_width};
use super::palette;
use super::panel::{
    BOTTOM_MARGIN, Entry, LABEL_BASELINE, LABEL_SPACE, LEGEND_ROW, LEGEND_TOP, Panel, RIGHT_MARGIN,
    Sample, TICK_SIZE, draw_legend, draw_title, legend_rows,
};

/// Input of [`tradeoff`].
#[derive(Clone, Debug, PartialEq)]
pub struct TradeoffFigure {
    /// Title of the figure.
    pub title: String,
    /// What the labels of marks are, such as the name of a key; empty without labels.
    pub label: String,
    /// Label of the vertical axis.
    pub error_label: &'static str,
    /// The lines, in the order of their colours.
    pub lines: Vec<TradeoffLine>,
}

/// Cells that share a colour.
#[derive(Clone, Debug, PartialEq)]
pub struct TradeoffLine {
    /// Its name in the legend; empty for a single one.
    pub name: String,
    /// Its cells, in the order of the line.
    pub points: Vec<TradeoffPoint>,
    /// Whether they are joined.
    pub is_joined: bool,
}

/// A cell: lower end, median and upper end over all runs.
#[derive(Clone, Debug, PartialEq)]
pub struct TradeoffPoint {
    /// Written beside the mark; may be empty.
    pub label: String,
    /// Broadcasts of all agents.
    pub broadcasts: [f64; 3],
    /// The largest error of an agent. \[state unit\]
    pub error: [f64; 3],
}

impl TradeoffPoint {
    fn is_drawable(&self) -> bool {
        self.broadcasts.iter().chain(&self.error).all(|&value| value.is_finite() && value > 0.0)
    }
}

const HEIGHT: f64 = 250.0;
const BAR: f64 = 0.7;
const LINE: f64 = 1.1;
const MARK: f64 = 3.3;
/// Distance of a label from its mark. \[user unit\]
const LABEL_GAP: f64 = 5.0;
const LABEL_SIZE: f64 = TICK_SIZE - 2.5;
/// The legend names this many lines at most.
const NAMES_MAX: usize = 12;

/// Draws the figure; cells without a logarithm are left out.
#[must_use]
pub fn tradeoff(figure: &TradeoffFigure) -> Figure {
    let points = || figure.lines.iter().flat_map(|line| &line.points).filter(|p| p.is_drawable());
    let x = axis(points().flat_map(|point| point.broadcasts));
    let y = axis(points().flat_map(|point| point.error));
    let left = LABEL_SPACE + labels_width(&y, HEIGHT);
    let width = WIDTH - left - RIGHT_MARGIN;
    let entries = legend(figure);
    let rows = legend_rows(&entries, width);
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0;
    let panel = Panel::new(Rect { left, top, width, height: HEIGHT }, x, y);

    let mut canvas = Canvas::new();
    draw_title(&mut canvas, &figure.title, left);
    draw_legend(&mut canvas, &rows, left, LEGEND_TOP);
    draw_fine_grid(&mut canvas, &panel);
    for (index, line) in figure.lines.iter().enumerate() {
        draw_line(&mut canvas, &panel, line, palette::agent(index));
    }
    draw_labels(&mut canvas, &panel, figure);
    draw_frame(&mut canvas, &panel);
    panel.label_x(&mut canvas, "broadcasts of all agents in the evaluation window");
    panel.label_y(&mut canvas, figure.error_label, LABEL_BASELINE);
    Figure { svg: canvas.finish(panel.area.bottom() + BOTTOM_MARGIN) }
}

fn at(panel: &Panel, broadcasts: f64, error: f64) -> (f64, f64) {
    (panel.at_x(broadcasts.log10()), panel.at_y(error.log10()))
}

fn draw_line(canvas: &mut Canvas, panel: &Panel, line: &TradeoffLine, color: &'static str) {
    let points = || line.points.iter().filter(|point| point.is_drawable());
    let middle = |point: &TradeoffPoint| at(panel, point.broadcasts[1], point.error[1]);
    if line.is_joined {
        let mut joined = ClippedLine::new(panel.area);
        for (x, y) in points().map(middle) {
            joined.line_to(x, y);
        }
        canvas.line(joined.finish(), Stroke::solid(color, LINE));
    }
    for point in points() {
        let mut bars = ClippedLine::new(panel.area);
        let ([x0, x, x1], [y0, y, y1]) = (point.broadcasts, point.error);
        for ends in [[(x, y0), (x, y1)], [(x0, y), (x1, y)]] {
            bars.lift();
            for (broadcasts, error) in ends {
                let (x, y) = at(panel, broadcasts, error);
                bars.line_to(x, y);
            }
        }
        canvas.line(bars.finish(), Stroke::solid(color, BAR).faint(0.6));
    }
    for point in points() {
        canvas.mark(middle(point), MARK, color, color);
    }
}

/// Writes the labels that do not cover others or marks.
fn draw_labels(canvas: &mut Canvas, panel: &Panel, figure: &TradeoffFigure) {
    let points = || figure.lines.iter().flat_map(|line| &line.points).filter(|p| p.is_drawable());
    let mut taken: Vec<Rect> = Vec::new();
    for point in points() {
        let (x, y) = at(panel, point.broadcasts[1], point.error[1]);
        taken.push(Rect { left: x - MARK, top: y - MARK, width: 2.0 * MARK, height: 2.0 * MARK });
    }
    for point in points().filter(|point| !point.label.is_empty()) {
        let (x, y) = at(panel, point.broadcasts[1], point.error[1]);
        let (width, height) = (font::width(&point.label, LABEL_SIZE), 0.8 * LABEL_SIZE);
        // To the upper right, or else to the lower left.
        let places = [
            Rect { left: x + LABEL_GAP, top: y - LABEL_GAP - height, width, height },
            Rect { left: x - LABEL_GAP - width, top: y + LABEL_GAP, width, height },
        ];
        let is_free = |place: &&Rect| {
            place.left >= panel.area.left
                && place.right() <= panel.area.right()
                && place.top >= panel.area.top
                && place.bottom() + 2.0 <= panel.area.bottom()
                && !taken.iter().any(|other| overlap(place, other))
        };
        if let Some(&place) = places.iter().find(is_free) {
            let at = TextAt::new(place.left, place.bottom(), LABEL_SIZE, Anchor::Start);
            canvas.text(&point.label, at);
            taken.push(place);
        }
    }
}

fn overlap(one: &Rect, other: &Rect) -> bool {
    one.left < other.right()
        && other.left < one.right()
        && one.top < other.bottom()
        && other.top < one.bottom()
}

fn legend(figure: &TradeoffFigure) -> Vec<Entry> {
    let entry = |text: String, sample| Entry { text, sample };
    let named = || figure.lines.iter().enumerate().filter(|(_, line)| !line.name.is_empty());
    let mut entries: Vec<Entry> = named()
        .take(NAMES_MAX)
        .map(|(index, line)| {
            let stroke =
                Stroke::solid(palette::agent(index), if line.is_joined { LINE } else { 3.0 });
            entry(line.name.clone(), Sample::Line(stroke))
        })
        .collect();
    if let Some(more) = named().count().checked_sub(NAMES_MAX).filter(|&more| more > 0) {
        entries.push(entry(format!("and {more} more"), Sample::None));
    }
    if !figure.label.is_empty() {
        entries.push(entry(format!("numbers: {}", figure.label), Sample::None));
    }
    entries.push(entry(
        "marks: median".to_owned(),
        Sample::Mark { is_filled: true, is_ringed: false },
    ));
    entries.push(entry("bars: 2.5 % to 97.5 % of the runs".to_owned(), Sample::None));
    entries
}

#[cfg(test)]
mod tests {
    use super::super::RMSE_LABEL;
    use super::*;

    fn figure(lines: usize, error: f64) -> TradeoffFigure {
        let point = |k: usize| TradeoffPoint {
            label: format!("L{k}"),
            broadcasts: [900.0, 1000.0, 1200.0].map(|x| x / (1 + k) as f64),
            error: [0.5 * error, error, 2.0 * error].map(|e| e * (1 + k) as f64),
        };
        let line = |number: usize| TradeoffLine {
            name: format!("line {number} < 9"),
            points: (0..4).map(point).collect(),
            is_joined: true,
        };
        TradeoffFigure {
            title: "a < b".to_owned(),
            label: "design.epsilon".to_owned(),
            error_label: RMSE_LABEL,
            lines: (0..lines).map(line).collect(),
        }
    }

    #[test]
    fn every_line_is_in_the_legend_and_labels_do_not_cover_each_other() {
        let svg = tradeoff(&figure(2, 0.05)).svg().to_owned();
        for text in ["line 0 &lt; 9", "line 1 &lt; 9", "design.epsilon", "L0", "L3"] {
            assert!(svg.contains(text), "{text}: {svg}");
        }
        // The lines lie on top of each other: a label of the second finds one free place at most.
        assert!(svg.matches("L0").count() <= 2, "{svg}");
        let many = tradeoff(&figure(20, 0.05)).svg().to_owned();
        assert!(many.contains("and 8 more"), "{many}");
    }

    #[test]
    fn values_without_a_logarithm_are_left_out() {
        for error in [0.0, f64::NAN, f64::INFINITY] {
            let svg = tradeoff(&figure(1, error)).svg().to_owned();
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
