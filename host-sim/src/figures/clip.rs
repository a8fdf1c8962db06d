//! Clips lines to a rectangle.
//!
//! SVG has clip paths, but renderers then draw every line to a separate picture; clipping here
//! makes rendering several times faster and documents shorter.

use super::canvas::{PathData, Rect};

/// A line clipped to a rectangle.
#[derive(Clone, Debug)]
pub(super) struct ClippedLine {
    area: Rect,
    data: PathData,
    /// The last point, which may be outside the rectangle.
    last: Option<(f64, f64)>,
}

impl ClippedLine {
    pub(super) fn new(area: Rect) -> Self {
        Self { area, data: PathData::default(), last: None }
    }

    /// Draws to a point; the first call only places the pen.
    pub(super) fn line_to(&mut self, x: f64, y: f64) {
        let to = (x, y);
        if let Some([begin, end]) = self.last.and_then(|from| self.inside(from, to)) {
            if Some(begin) != self.last {
                self.data.lift();
            }
            self.data.line_to(begin.0, begin.1);
            self.data.line_to(end.0, end.1);
        } else {
            self.data.lift();
        }
        self.last = Some(to);
    }

    /// Lifts the pen: the next point starts a new line.
    pub(super) fn lift(&mut self) {
        self.data.lift();
        self.last = None;
    }

    /// Returns the clipped line.
    pub(super) fn finish(self) -> PathData {
        self.data
    }

    /// Returns the part of a segment inside the rectangle: each border limits the range of the
    /// segment's parameter (Liang–Barsky).
    fn inside(&self, from: (f64, f64), to: (f64, f64)) -> Option<[(f64, f64); 2]> {
        let (dx, dy) = (to.0 - from.0, to.1 - from.1);
        let borders = [
            (-dx, from.0 - self.area.left),
            (dx, self.area.right() - from.0),
            (-dy, from.1 - self.area.top),
            (dy, self.area.bottom() - from.1),
        ];
        let (mut begin, mut end) = (0.0_f64, 1.0_f64);
        for (outwards, room) in borders {
            if outwards < 0.0 {
                begin = begin.max(room / outwards);
            } else if outwards > 0.0 {
                end = end.min(room / outwards);
            } else if room < 0.0 {
                return None;
            }
        }
        let at = |part: f64| (from.0 + part * dx, from.1 + part * dy);
        (begin <= end).then(|| [at(begin), at(end)])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn drawn(points: &[(f64, f64)]) -> String {
        let mut line = ClippedLine::new(Rect { left: 0.0, top: 0.0, width: 10.0, height: 10.0 });
        points.iter().for_each(|&(x, y)| line.line_to(x, y));
        line.finish().into_text()
    }

    #[test]
    fn draws_only_the_part_inside() {
        assert_eq!(drawn(&[(1.0, 1.0), (9.0, 9.0)]), "M1 1l8 8");
        assert_eq!(drawn(&[(-5.0, 5.0), (15.0, 5.0)]), "M0 5l10 0");
        assert_eq!(drawn(&[(5.0, 5.0), (5.0, -5.0), (7.0, -5.0), (7.0, 5.0)]), "M5 5l0-5M7 0l0 5");
        assert_eq!(drawn(&[(-2.0, 1.0), (1.0, -2.0)]), "");
        assert_eq!(drawn(&[(2.0, 12.0), (8.0, 12.0)]), "");
    }
}
