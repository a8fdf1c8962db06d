//! Reduces series of thousands of rows to lines and bands with a few points per pixel.
//!
//! Within one pixel column of the picture, only the minimum and maximum of a line are visible, so
//! these two, in order of occurrence, give the same picture as all the rows. For many agents a
//! column shows minimum, 5th percentile, median, 95th percentile and maximum.

use std::ops::Range;

use rayon::prelude::*;

use super::axis::Axis;
use super::canvas::{Canvas, PathData, Stroke};
use super::clip::ClippedLine;
use super::palette;
use super::panel::Panel;

/// Points shared by all lines of a figure; at about 8 bytes each this keeps an SVG below 300 kB.
/// \[-\]
const POINTS: usize = 32_000;

/// Maximum number of columns per user unit: a picture has 3.6 pixels per unit.
const COLUMNS_PER_UNIT: f64 = 3.0;

/// Approximate number of values per column for percentiles; minimum and maximum use all values.
const POOL: usize = 1024;

/// Returns the number of columns for a panel `width` user units wide, if the figure shows `lines`
/// lines in all its panels.
pub(super) fn column_count(width: f64, lines: usize) -> usize {
    let finest = (width * COLUMNS_PER_UNIT) as usize;
    finest.min(POINTS / (2 * lines.max(1))).max(16)
}

/// Groups rows into `count` equal columns of an axis, omitting empty ones, plus one row before the
/// axis and one after it, so that lines reach its ends. Times must ascend.
pub(super) fn columns(time: &[f64], axis: &Axis, count: usize) -> Vec<Range<usize>> {
    let first = time.partition_point(|&t| t < axis.from).saturating_sub(1);
    let last = (time.partition_point(|&t| t <= axis.to) + 1).min(time.len());
    let column = |row: usize| (axis.part(time[row]) * count as f64).floor();
    let mut columns = Vec::with_capacity(count + 2);
    let mut begin = first;
    for row in first..last {
        if row + 1 == last || column(row + 1) != column(row) {
            columns.push(begin..row + 1);
            begin = row + 1;
        }
    }
    columns
}

/// Draws `value` (of a row) over `time`; non-finite values interrupt the line.
pub(super) fn line(
    panel: &Panel,
    time: &[f64],
    columns: &[Range<usize>],
    value: impl Fn(usize) -> f64,
) -> PathData {
    let mut data = ClippedLine::new(panel.area);
    for rows in columns {
        let (mut least, mut greatest) = ((f64::INFINITY, 0), (f64::NEG_INFINITY, 0));
        for row in rows.clone() {
            let y = value(row);
            if y.is_finite() {
                if y < least.0 {
                    least = (y, row);
                }
                if y > greatest.0 {
                    greatest = (y, row);
                }
            }
        }
        if least.0 > greatest.0 {
            data.lift();
            continue;
        }
        let (before, after) =
            if least.1 <= greatest.1 { (least, greatest) } else { (greatest, least) };
        data.line_to(panel.at_x(time[before.1]), panel.at_y(before.0));
        data.line_to(panel.at_x(time[after.1]), panel.at_y(after.0));
    }
    data.finish()
}

/// Distribution of the values of many agents in a column.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Spread {
    /// Mean time of the column. \[s\]
    pub time: f64,
    /// Minimum, 5th percentile, median, 95th percentile, maximum.
    pub levels: [f64; 5],
}

/// Returns the spread of `value` (of a row and an agent) in each column, omitting columns without
/// finite values.
pub(super) fn spreads(
    time: &[f64],
    columns: &[Range<usize>],
    agents: usize,
    value: impl Fn(usize, usize) -> f64 + Sync,
) -> Vec<Spread> {
    columns.par_iter().filter_map(|rows| spread(time, rows, agents, &value)).collect()
}

fn spread(
    time: &[f64],
    rows: &Range<usize>,
    agents: usize,
    value: &impl Fn(usize, usize) -> f64,
) -> Option<Spread> {
    // Whole rows are pooled, so that every agent has the same weight.
    let pooled_every = (rows.len() * agents).div_ceil(POOL).max(1);
    let (mut min, mut max) = (f64::INFINITY, f64::NEG_INFINITY);
    let mut pool = Vec::with_capacity(POOL.max(agents));
    for row in rows.clone() {
        let pooled = (row - rows.start).is_multiple_of(pooled_every);
        for value in (0..agents).map(|agent| value(row, agent)).filter(|value| value.is_finite()) {
            (min, max) = (min.min(value), max.max(value));
            if pooled {
                pool.push(value);
            }
        }
    }
    pool.sort_unstable_by(f64::total_cmp);
    let last = pool.len().checked_sub(1)?;
    let percentile = |part: f64| pool[(part * last as f64).round() as usize];
    let time = 0.5 * (time[rows.start] + time[rows.end - 1]);
    Some(Spread { time, levels: [min, percentile(0.05), percentile(0.5), percentile(0.95), max] })
}

/// Opacity of the min–max band and of the percentile band.
pub(super) const BANDS: [f64; 2] = [0.18, 0.35];

/// Line style of the median.
pub(super) const MEDIAN: Stroke = Stroke::solid(palette::TOGETHER, 1.1);

/// Draws spreads: a faint band from minimum to maximum, a stronger one between the percentiles, and
/// the median.
pub(super) fn draw_spreads(canvas: &mut Canvas, panel: &Panel, spreads: &[Spread]) {
    let at = |spread: &Spread, level: usize| {
        let (x, y) = (panel.at_x(spread.time), panel.at_y(spread.levels[level]));
        let area = panel.area;
        (x.clamp(area.left, area.right()), y.clamp(area.top, area.bottom()))
    };
    for (low, high, opacity) in [(0, 4, BANDS[0]), (1, 3, BANDS[1])] {
        let mut area = PathData::default();
        let upper = spreads.iter().map(|spread| at(spread, high));
        let lower = spreads.iter().rev().map(|spread| at(spread, low));
        upper.chain(lower).for_each(|(x, y)| area.line_to(x, y));
        canvas.area(area, palette::TOGETHER, opacity);
    }
    let mut median = ClippedLine::new(panel.area);
    for spread in spreads {
        median.line_to(panel.at_x(spread.time), panel.at_y(spread.levels[2]));
    }
    canvas.line(median.finish(), MEDIAN);
}

#[cfg(test)]
mod tests {
    use super::super::canvas::Rect;
    use super::*;

    fn panel() -> Panel {
        let area = Rect { left: 0.0, top: 0.0, width: 100.0, height: 100.0 };
        Panel::new(area, Axis::exact(0.0, 10.0, 5.0), Axis::exact(-2.0, 2.0, 4.0))
    }

    #[test]
    fn columns_contain_every_row_of_the_axis_once() {
        let time: Vec<f64> = (0..=2000).map(|row| f64::from(row) * 0.01).collect();
        let columns = columns(&time, &Axis::exact(5.0, 10.0, 5.0), 50);
        assert_eq!(columns.first().unwrap().start, 499);
        assert_eq!(columns.last().unwrap().end, 1002);
        assert!(columns.windows(2).all(|pair| pair[0].end == pair[1].start));
    }

    #[test]
    fn reduced_line_keeps_every_peak() {
        let time: Vec<f64> = (0..40_000).map(|row| f64::from(row) * 0.000_25).collect();
        let peak = |row: usize| if row == 12_345 { 1.5 } else { 0.0 };
        let panel = panel();
        let columns = columns(&time, &panel.x, column_count(panel.area.width, 1));
        let data = line(&panel, &time, &columns, peak);
        assert!(data.points() <= 2 * columns.len());
        let rise = format!("-{}", 1.5 / 4.0 * 100.0);
        assert!(format!("{data:?}").contains(&rise), "{data:?}");
    }

    #[test]
    fn non_finite_values_interrupt_a_line() {
        let panel = panel();
        let values = [0.0, 1.0, f64::NAN, 1.0, f64::INFINITY, 0.0];
        let time = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
        let columns = columns(&time, &panel.x, 300);
        let data = format!("{:?}", line(&panel, &time, &columns, |row| values[row]));
        assert_eq!(data.matches('M').count(), 3, "{data}");
    }

    #[test]
    fn spreads_match_the_agents() {
        let time = [0.0, 1.0];
        let columns = [0..1, 1..2];
        let spreads = spreads(&time, &columns, 101, |row, agent| (row + agent) as f64);
        assert_eq!(spreads[0].levels, [0.0, 5.0, 50.0, 95.0, 100.0]);
        assert_eq!(spreads[1].levels, [1.0, 6.0, 51.0, 96.0, 101.0]);
    }
}
