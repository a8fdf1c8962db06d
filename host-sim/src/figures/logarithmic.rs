//! Logarithmic axes with ticks between the powers of ten.

use super::axis::Axis;
use super::canvas::{Anchor, Canvas, PathData, Stroke, TextAt};
use super::font;
use super::panel::{Panel, TICK_SIZE};
use crate::number::significant;

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

/// Returns 2 to 9 times all powers of ten of the axis, as value and leading digit.
fn fine_ticks(axis: &Axis) -> Vec<(f64, u8)> {
    let (first, last) = (axis.from.floor() as i32, axis.to.ceil() as i32);
    let of = |power: i32| (2..=9u8).map(move |lead| (10f64.powi(power) * f64::from(lead), lead));
    let inside = |&(value, _): &(f64, u8)| (axis.from..=axis.to).contains(&value.log10());
    (first..=last).flat_map(of).filter(inside).collect()
}

/// Draws the background and the grid, below the data.
pub(super) fn draw_fine_grid(canvas: &mut Canvas, panel: &Panel) {
    let area = panel.area;
    canvas.fill(area, "#ffffff");
    let mut grid = PathData::default();
    for (value, _) in fine_ticks(&panel.x) {
        let x = panel.at_x(value.log10());
        grid.move_to(x, area.top);
        grid.line_to(x, area.bottom());
    }
    for (value, _) in fine_ticks(&panel.y) {
        let y = panel.at_y(value.log10());
        grid.move_to(area.left, y);
        grid.line_to(area.right(), y);
    }
    canvas.line(grid, FAINT_GRID);
    let mut grid = PathData::default();
    for tick in panel.x.ticks() {
        grid.move_to(panel.at_x(tick), area.top);
        grid.line_to(panel.at_x(tick), area.bottom());
    }
    for tick in panel.y.ticks() {
        grid.move_to(area.left, panel.at_y(tick));
        grid.line_to(area.right(), panel.at_y(tick));
    }
    canvas.line(grid, Stroke::solid("#d9d9d9", 0.6));
}

/// Font size of labels between powers of ten. \[user unit\]
const FINE_SIZE: f64 = TICK_SIZE - 2.0;

fn fine_label(value: f64) -> String {
    if value >= 1.0 { format!("{value:.0}") } else { significant(value, 1) }
}

/// Whether a tick is labelled: at 2 and 5 times powers of ten; on a short axis all.
fn is_labelled(axis: &Axis, lead: u8) -> bool {
    axis.to - axis.from < 0.5 || lead == 2 || lead == 5
}

/// Returns the width of the labels of the y axis. \[user unit\]
pub(super) fn labels_width(y: &Axis) -> f64 {
    let fine = fine_ticks(y).into_iter().filter(|(_, lead)| is_labelled(y, *lead));
    let widths = fine.map(|(value, _)| font::width(&fine_label(value), FINE_SIZE));
    widths.fold(Panel::y_labels_width(y, TICK_SIZE), |widest, width| widest.max(width + 5.5))
}

/// Labels the ticks between powers of ten.
pub(super) fn draw_fine_labels(canvas: &mut Canvas, panel: &Panel) {
    let area = panel.area;
    let labelled = |axis: &Axis| {
        fine_ticks(axis)
            .into_iter()
            .filter(|(_, lead)| is_labelled(axis, *lead))
            .collect::<Vec<_>>()
    };
    for (value, _) in labelled(&panel.x) {
        let at = (panel.at_x(value.log10()), area.bottom() + 4.5 + TICK_SIZE);
        let at = TextAt::new(at.0, at.1, FINE_SIZE, Anchor::Middle);
        canvas.text(&fine_label(value), at);
    }
    for (value, _) in labelled(&panel.y) {
        let at = (area.left - 5.5, panel.at_y(value.log10()) + 0.36 * FINE_SIZE);
        canvas.text(&fine_label(value), TextAt::new(at.0, at.1, FINE_SIZE, Anchor::End));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_between_powers_of_ten() {
        let ticks = fine_ticks(&axis([30.0, 400.0].into_iter()));
        let values: Vec<f64> = ticks.into_iter().map(|(value, _)| value).collect();
        assert_eq!(values, [30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 90.0, 200.0, 300.0, 400.0]);
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
