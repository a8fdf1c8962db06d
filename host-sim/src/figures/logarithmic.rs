//! Logarithmic axes with ticks between the powers of ten.
//!
//! As many ticks are labelled as there is room for; all numbers of an axis are written in full
//! (`50`, `100`, `200`), or all with powers of ten (`5·10⁵`, `10⁶`).

use super::axis::{Axis, raised};
use super::canvas::{Anchor, Canvas, PathData, Stroke, TextAt, WIDTH};
use super::font;
use super::panel::{FRAME, Panel, TICK, TICK_SIZE};

const FAINT_GRID: Stroke = Stroke::solid("#ececec", 0.45);

/// Creates an axis of decimal logarithms over these values, with some room.
pub(super) fn axis(values: impl Iterator<Item = f64>) -> Axis {
    let (low, high) = values
        .filter(|&value| value > 0.0)
        .fold((f64::INFINITY, 0.0f64), |(low, high), value| (low.min(value), high.max(value)));
    let (low, high) = if low <= high { (low, high) } else { (1.0, 10.0) };
    let (low, high) = with_ticks(low, high);
    let mut axis = Axis::powers(low, high);
    let room = 0.05 * (high / low).log10().max(0.5);
    (axis.from, axis.to) = (low.log10() - room, high.log10() + room);
    axis
}

/// Extends a range that is too narrow to contain two ticks to those around it.
fn with_ticks(low: f64, high: f64) -> (f64, f64) {
    let unit = |value: f64| 10f64.powf(value.log10().floor());
    let (down, up) = (unit(low), unit(high));
    let (below, above) = ((low / down).floor() * down, (high / up).ceil() * up);
    let is_narrow = (high / up).floor() * up - (low / down).ceil() * down < 0.5 * down;
    if is_narrow { (below, above.max(below + down)) } else { (low, high) }
}

/// Returns multiples of all powers of ten of the axis, as power and leading digit.
fn multiples(axis: &Axis, leads: &[u8]) -> Vec<(i32, u8)> {
    let (first, last) = (axis.from.floor() as i32, axis.to.ceil() as i32);
    let of = |power: i32| leads.iter().map(move |&lead| (power, lead));
    let inside = |&tick: &(i32, u8)| (axis.from..=axis.to).contains(&place(tick));
    (first..=last).flat_map(of).filter(inside).collect()
}

/// Returns the decimal logarithm of a multiple of a power of ten.
fn place((power, lead): (i32, u8)) -> f64 {
    f64::from(power) + f64::from(lead).log10()
}

/// Draws the background and the grid, below the data.
pub(super) fn draw_fine_grid(canvas: &mut Canvas, panel: &Panel) {
    canvas.fill(panel.area, "#ffffff");
    let lines = |leads: &[u8]| {
        let area = panel.area;
        let mut grid = PathData::default();
        for tick in multiples(&panel.x, leads) {
            let x = panel.at_x(place(tick));
            grid.move_to(x, area.top);
            grid.line_to(x, area.bottom());
        }
        for tick in multiples(&panel.y, leads) {
            let y = panel.at_y(place(tick));
            grid.move_to(area.left, y);
            grid.line_to(area.right(), y);
        }
        grid
    };
    canvas.line(lines(&[2, 3, 4, 5, 6, 7, 8, 9]), FAINT_GRID);
    canvas.line(lines(&[1]), Stroke::solid("#d9d9d9", 0.6));
}

/// Font size of the labels. \[user unit\]
const SIZE: f64 = TICK_SIZE - 1.0;

/// The leading digits that are labelled, the most first.
const LEADS: [&[u8]; 6] =
    [&[1, 2, 3, 4, 5, 6, 7, 8, 9], &[1, 2, 3, 4, 6, 8], &[1, 2, 3, 5], &[1, 2, 5], &[1, 3], &[1]];

/// Numbers with these powers of ten are written in full, if all of an axis are.
const PLAIN: std::ops::RangeInclusive<i32> = -3..=4;

/// A label at a decimal logarithm.
struct Label {
    place: f64,
    text: String,
}

impl Label {
    fn width(&self) -> f64 {
        font::width(&self.text, SIZE)
    }
}

fn is_plain(ticks: &[(i32, u8)]) -> bool {
    ticks.iter().all(|(power, _)| PLAIN.contains(power))
}

/// Writes all numbers of an axis in full, or all as multiples of powers of ten.
fn labels(ticks: &[(i32, u8)]) -> Vec<Label> {
    let is_plain = is_plain(ticks);
    let label = |&(power, lead): &(i32, u8)| {
        let text = match lead {
            _ if is_plain => {
                let decimals = usize::try_from(-power).unwrap_or(0);
                format!("{:.decimals$}", f64::from(lead) * 10f64.powi(power))
            }
            1 => format!("10{}", raised(power)),
            _ => format!("{lead}·10{}", raised(power)),
        };
        Label { place: place((power, lead)), text }
    };
    ticks.iter().map(label).collect()
}

/// Returns the most labels that fit on an axis of this length, by what each takes of it. \[user unit\]
fn fitting(axis: &Axis, length: f64, extent: impl Fn(&Label) -> f64) -> Vec<Label> {
    let fits = |labels: &Vec<Label>| {
        labels.windows(2).all(|pair| {
            let distance = (axis.part(pair[1].place) - axis.part(pair[0].place)) * length;
            distance >= 0.5 * (extent(&pair[0]) + extent(&pair[1]))
        })
    };
    // Powers of ten are read best without anything between them.
    let powers = multiples(axis, &[1]);
    let dense: &[&[u8]] = if powers.len() > 2 && !is_plain(&powers) { &[&[1]] } else { &LEADS };
    let dense = dense.iter().map(|leads| labels(&multiples(axis, leads)));
    let every = |step: i32| {
        let powers = powers.iter().copied();
        labels(&powers.filter(|(power, _)| power % step == 0).collect::<Vec<_>>())
    };
    dense.chain((2..100).map(every)).find(fits).unwrap_or_default()
}

fn labels_of_x(x: &Axis, width: f64) -> Vec<Label> {
    fitting(x, width, |label| label.width() + 0.6 * SIZE)
}

fn labels_of_y(y: &Axis, height: f64) -> Vec<Label> {
    fitting(y, height, |_| 1.15 * SIZE)
}

/// Returns the width of the labels of a y axis of this height. \[user unit\]
pub(super) fn labels_width(y: &Axis, height: f64) -> f64 {
    let labels = labels_of_y(y, height);
    let widths = labels.iter().map(Label::width);
    TICK + 2.0 + widths.fold(0.0, f64::max)
}

/// Draws the frame with ticks and labels, over the data.
pub(super) fn draw_frame(canvas: &mut Canvas, panel: &Panel) {
    let (left, bottom) = (panel.area.left, panel.area.bottom());
    let mut ticks = PathData::default();
    for label in labels_of_x(&panel.x, panel.area.width) {
        let x = panel.at_x(label.place);
        ticks.move_to(x, bottom);
        ticks.line_to(x, bottom + TICK);
        // The last label must stay within the figure.
        let x = x.min(WIDTH - 1.0 - 0.5 * label.width());
        let at = TextAt::new(x, bottom + TICK + 1.0 + TICK_SIZE, SIZE, Anchor::Middle);
        canvas.text(&label.text, at);
    }
    for label in labels_of_y(&panel.y, panel.area.height) {
        let y = panel.at_y(label.place);
        ticks.move_to(left, y);
        ticks.line_to(left - TICK, y);
        let at = TextAt::new(left - TICK - 2.0, y + 0.36 * SIZE, SIZE, Anchor::End);
        canvas.text(&label.text, at);
    }
    canvas.line(ticks, FRAME);
    canvas.frame(panel.area, FRAME);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn texts(labels: Vec<Label>) -> Vec<String> {
        labels.into_iter().map(|label| label.text).collect()
    }

    #[test]
    fn axes_have_as_many_labels_as_fit_in_one_notation() {
        for (low, high, x, y) in [
            (30.0, 400.0, "30 40 60 80 100 200 300 400", "30 40 60 80 100 200 300 400"),
            (5.5, 18.5, "6 7 8 9 10", "6 7 8 9 10"),
            (8300.0, 8450.0, "8000 9000", "8000 9000"),
            (0.004, 2.0, "0.005 0.01 0.02 0.05 0.1 0.2 0.5 1 2", ""),
            (300.0, 3e6, "10³ 10⁴ 10⁵ 10⁶", ""),
            (2e-7, 6e-7, "2·10⁻⁷ 3·10⁻⁷ 4·10⁻⁷ 5·10⁻⁷ 6·10⁻⁷", ""),
            (1e-30, 1e30, "", ""),
        ] {
            let axis = axis([low, high].into_iter());
            let found = [texts(labels_of_x(&axis, 400.0)), texts(labels_of_y(&axis, 250.0))];
            for (found, expected) in found.iter().zip([x, y]) {
                assert!(found.len() >= 2, "{low} to {high}: {found:?}");
                if !expected.is_empty() {
                    assert_eq!(found.join(" "), expected, "{low} to {high}");
                }
            }
        }
    }

    #[test]
    fn a_narrow_range_is_extended_to_the_ticks_around_it() {
        for (low, high, extended) in [
            (8300.0, 8450.0, (8000.0, 9000.0)),
            (9900.0, 10_100.0, (9000.0, 20_000.0)),
            (0.05, 0.05, (0.05, 0.06)),
            (8300.0, 9900.0, (8000.0, 10_000.0)),
            (1900.0, 3100.0, (1900.0, 3100.0)),
        ] {
            let (from, to) = with_ticks(low, high);
            let close = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-9;
            assert!(close(from, extended.0) && close(to, extended.1), "{low}: {from}, {to}");
        }
    }
}
