//! Error against broadcasts of several forms of the observer, on logarithmic axes.
//!
//! Each form has a line through its settings, from their medians, with bars over the range of all runs.
//! Filled marks are certified. Down and left is better.

use super::Figure;
use super::canvas::{Canvas, INK, Rect, Stroke, WIDTH};
use super::clip::ClippedLine;
use super::logarithmic::{axis, draw_fine_grid, draw_frame, labels_width};
use super::palette::{self, SIGNAL};
use super::panel::{
    BOTTOM_MARGIN, Entry, LABEL_BASELINE, LABEL_SPACE, LEGEND_ROW, LEGEND_TOP, Panel, RIGHT_MARGIN,
    Sample, draw_legend, draw_title, legend_rows,
};
use crate::number::significant;

/// Input of [`frontier`].
#[derive(Clone, Debug)]
pub struct FrontierFigure<'a> {
    /// Title of the figure.
    pub title: &'a str,
    /// Label of the horizontal axis.
    pub broadcasts_label: &'a str,
    /// Label of the vertical axis.
    pub error_label: &'a str,
    /// The forms, in the order of their colours.
    pub forms: Vec<FrontierForm<'a>>,
    /// The requested errors, smallest and largest. \[state unit\]
    pub target: (f64, f64),
    /// What the target is.
    pub target_label: &'a str,
    /// Whether marks show what is certified.
    pub has_certificates: bool,
    /// What the ringed point is.
    pub own_label: &'a str,
}

/// One form of the observer.
#[derive(Clone, Debug, PartialEq)]
pub struct FrontierForm<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its settings, in the order of the line.
    pub points: Vec<FrontierPoint>,
}

/// One setting: smallest, median and largest value over all runs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrontierPoint {
    /// Broadcasts of all agents.
    pub broadcasts: [f64; 3],
    /// The largest error of an agent. \[state unit\]
    pub error: [f64; 3],
    /// Whether every run is certified.
    pub is_certified: bool,
    /// Whether it is marked with a ring.
    pub is_own: bool,
}

impl FrontierPoint {
    fn is_drawable(&self) -> bool {
        self.broadcasts.iter().chain(&self.error).all(|&value| value.is_finite() && value > 0.0)
    }
}

const HEIGHT: f64 = 250.0;
const BAR: f64 = 0.7;
const LINE: f64 = 1.1;
const MARK: f64 = 3.3;
const RING: f64 = 6.2;
const TARGET: Stroke = Stroke::solid(SIGNAL, 0.9).dashed(5.0, 3.0);

/// Errors above this multiple of the target are beyond the upper end of the axis.
const FAR: f64 = 30.0;

/// Draws the figure.
#[must_use]
pub fn frontier(figure: &FrontierFigure<'_>) -> Figure {
    let points = || figure.forms.iter().flat_map(|form| &form.points).filter(|p| p.is_drawable());
    let (low, high) = figure.target;
    let far = FAR * high;
    let values = |of: fn(&FrontierPoint) -> [f64; 3]| {
        points().filter(move |p| p.error[1] <= far).flat_map(of)
    };
    let x = axis(values(|p| p.broadcasts));
    let y = axis(values(|p| p.error).map(|error| error.min(far)).chain([low, high]));
    let left = LABEL_SPACE + labels_width(&y, HEIGHT);
    let width = WIDTH - left - RIGHT_MARGIN;
    let entries = legend(figure);
    let rows = legend_rows(&entries, width);
    let top = LEGEND_TOP + rows.len() as f64 * LEGEND_ROW + 5.0;
    let panel = Panel::new(Rect { left, top, width, height: HEIGHT }, x, y);

    let mut canvas = Canvas::new();
    draw_title(&mut canvas, figure.title, left);
    draw_legend(&mut canvas, &rows, left, LEGEND_TOP);
    draw_fine_grid(&mut canvas, &panel);
    for level in if low < high { vec![low, high] } else { vec![high] } {
        let y = panel.at_y(level.log10());
        canvas.segment((panel.area.left, y), (panel.area.right(), y), TARGET);
    }
    for (index, form) in figure.forms.iter().enumerate() {
        draw_form(&mut canvas, &panel, form, palette::agent(index));
    }
    draw_frame(&mut canvas, &panel);
    panel.label_x(&mut canvas, figure.broadcasts_label);
    panel.label_y(&mut canvas, figure.error_label, LABEL_BASELINE);
    Figure { svg: canvas.finish(panel.area.bottom() + BOTTOM_MARGIN) }
}

fn draw_form(canvas: &mut Canvas, panel: &Panel, form: &FrontierForm<'_>, color: &'static str) {
    let area = panel.area;
    let at =
        |broadcasts: f64, error: f64| (panel.at_x(broadcasts.log10()), panel.at_y(error.log10()));
    let points = || form.points.iter().filter(|point| point.is_drawable());
    let mut line = ClippedLine::new(area);
    for point in points() {
        let (x, y) = at(point.broadcasts[1], point.error[1]);
        line.line_to(x, y);
    }
    canvas.line(line.finish(), Stroke::solid(color, LINE));
    for point in points() {
        let mut bars = ClippedLine::new(area);
        for (ends, along) in [(point.error, true), (point.broadcasts, false)] {
            let end = |value| match along {
                true => at(point.broadcasts[1], value),
                false => at(value, point.error[1]),
            };
            bars.lift();
            for (x, y) in [end(ends[0]), end(ends[2])] {
                bars.line_to(x, y);
            }
        }
        canvas.line(bars.finish(), Stroke::solid(color, BAR).faint(0.6));
    }
    for point in points() {
        let (x, y) = at(point.broadcasts[1], point.error[1]);
        if y < area.top {
            continue;
        }
        canvas.mark((x, y), MARK, if point.is_certified { color } else { "#ffffff" }, color);
        if point.is_own {
            canvas.ring((x, y), RING, Stroke::solid(INK, 1.0));
        }
    }
}

/// Returns the form's name, and how many of its points are above the picture, whose highest error is `far`.
fn named(form: &FrontierForm<'_>, far: f64) -> String {
    let drawable: Vec<f64> =
        form.points.iter().filter(|p| p.is_drawable()).map(|p| p.error[1]).collect();
    let above: Vec<f64> = drawable.iter().copied().filter(|&error| error > far).collect();
    match (above.len(), drawable.len()) {
        (0, _) => form.name.to_owned(),
        (1, 1) => format!("{}: {}, above the picture", form.name, significant(above[0], 3)),
        (count, all) => format!("{} ({count} of {all} above the picture)", form.name),
    }
}

fn legend(figure: &FrontierFigure<'_>) -> Vec<Entry> {
    let entry = |text: &str, sample| Entry { text: text.to_owned(), sample };
    let forms = figure.forms.iter().enumerate();
    let mut entries: Vec<Entry> = forms
        .map(|(index, form)| {
            let name = named(form, FAR * figure.target.1);
            entry(&name, Sample::Line(Stroke::solid(palette::agent(index), LINE)))
        })
        .collect();
    if figure.has_certificates {
        entries.push(entry("certified", Sample::Mark { is_filled: true, is_ringed: false }));
        entries.push(entry("simulation only", Sample::Mark { is_filled: false, is_ringed: false }));
    }
    let has_own = figure.forms.iter().any(|form| form.points.iter().any(|point| point.is_own));
    if has_own {
        let ringed = Sample::Mark { is_filled: true, is_ringed: true };
        entries.push(entry(figure.own_label, ringed));
    }
    entries.push(entry(figure.target_label, Sample::Line(TARGET)));
    let is_spread = |point: &FrontierPoint| point.error[0] < point.error[2];
    if figure.forms.iter().any(|form| form.points.iter().any(is_spread)) {
        entries.push(entry("bars: all runs", Sample::None));
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::super::RMSE_LABEL;
    use super::*;

    fn figure(error: f64) -> String {
        let point = |broadcasts: f64, is_certified, is_own| FrontierPoint {
            broadcasts: [0.9 * broadcasts, broadcasts, 1.1 * broadcasts],
            error: [0.5 * error, error, 2.0 * error],
            is_certified,
            is_own,
        };
        let forms = vec![
            FrontierForm { name: "paper", points: vec![point(8000.0, true, true)] },
            FrontierForm {
                name: "flow",
                points: vec![point(700.0, true, false), point(300.0, false, false)],
            },
        ];
        let figure = FrontierFigure {
            title: "a < b",
            broadcasts_label: "broadcasts",
            error_label: RMSE_LABEL,
            forms,
            target: (0.06, 0.09),
            target_label: "target",
            has_certificates: true,
            own_label: "as set",
        };
        frontier(&figure).svg().to_owned()
    }

    #[test]
    fn marks_tell_certified_settings_and_the_scenarios_own() {
        let svg = figure(0.05);
        for text in ["paper", "flow", "certified", "simulation only", "as set", "target"] {
            assert!(svg.contains(&format!("\n{text}\n")) || svg.contains(text), "{text}: {svg}");
        }
        // A ring in the panel and one in the legend.
        assert_eq!(svg.matches("stroke-width=\"1\"").count(), 2, "{svg}");
    }

    #[test]
    fn values_without_a_logarithm_are_left_out() {
        for error in [0.0, f64::NAN, f64::INFINITY] {
            let svg = figure(error);
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
