//! Basic shapes of the figures, on top of the SVG document.
//!
//! Lengths are in user units; a figure is [`WIDTH`] of them wide, so that a font size of 11 prints
//! at about 6 points in a column of 89 mm. Coordinates have a resolution of 0.1, finer than a pixel
//! of the PNG.

use std::fmt::Write;

use svg::Document;
use svg::node::Value;
use svg::node::element::{Circle, Group, Path, Rectangle, Text};

use super::font;

/// Width of every figure. \[user unit\]
pub(super) const WIDTH: f64 = 440.0;

/// Colour of text and frames.
pub(super) const INK: &str = "#1a1a1a";

/// A rectangle; the y axis points down.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Rect {
    pub left: f64,
    pub top: f64,
    pub width: f64,
    pub height: f64,
}

impl Rect {
    pub(super) fn right(&self) -> f64 {
        self.left + self.width
    }

    pub(super) fn bottom(&self) -> f64 {
        self.top + self.height
    }
}

/// A dash pattern. \[user unit\]
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Dash {
    pub drawn: f64,
    pub gap: f64,
}

/// How a line is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stroke {
    pub color: &'static str,
    pub width: f64,
    pub dash: Option<Dash>,
    pub opacity: f64,
}

impl Stroke {
    pub(super) const fn solid(color: &'static str, width: f64) -> Self {
        Self { color, width, dash: None, opacity: 1.0 }
    }

    pub(super) const fn dashed(self, drawn: f64, gap: f64) -> Self {
        Self { dash: Some(Dash { drawn, gap }), ..self }
    }

    pub(super) const fn faint(self, opacity: f64) -> Self {
        Self { opacity, ..self }
    }
}

/// Alignment of a text relative to its point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Anchor {
    Start,
    Middle,
    End,
}

/// Position and style of a text; its baseline goes through (`x`, `y`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct TextAt {
    pub x: f64,
    pub y: f64,
    pub size: f64,
    pub anchor: Anchor,
    /// Maximum width: longer text gets a smaller font size.
    pub room: f64,
    /// Whether it is rotated to read upwards.
    pub upwards: bool,
}

impl TextAt {
    pub(super) const fn new(x: f64, y: f64, size: f64, anchor: Anchor) -> Self {
        Self { x, y, size, anchor, room: f64::INFINITY, upwards: false }
    }

    pub(super) const fn within(self, room: f64) -> Self {
        Self { room, ..self }
    }

    pub(super) const fn upwards(self) -> Self {
        Self { upwards: true, ..self }
    }
}

/// Path data in relative moves of 0.1 units, which is compact and does not accumulate errors.
#[derive(Clone, Debug, Default)]
pub(super) struct PathData {
    text: String,
    /// Position of the pen. \[0.1 user unit\]
    pen: Option<(i64, i64)>,
    points: usize,
}

impl PathData {
    /// Moves the pen to a point without drawing.
    pub(super) fn move_to(&mut self, x: f64, y: f64) {
        let (x, y) = (tenths(x), tenths(y));
        self.text.push('M');
        self.number(x, false);
        self.number(y, true);
        self.text.push('l');
        self.pen = Some((x, y));
        self.points += 1;
    }

    /// Draws to a point; the first call only places the pen.
    pub(super) fn line_to(&mut self, x: f64, y: f64) {
        let Some((pen_x, pen_y)) = self.pen else { return self.move_to(x, y) };
        let (x, y) = (tenths(x), tenths(y));
        if (x, y) == (pen_x, pen_y) {
            return;
        }
        let after_number = self.text.ends_with(|last: char| last.is_ascii_digit());
        self.number(x - pen_x, after_number);
        self.number(y - pen_y, true);
        self.pen = Some((x, y));
        self.points += 1;
    }

    /// Lifts the pen: the next point starts a new line.
    pub(super) fn lift(&mut self) {
        self.pen = None;
    }

    /// Returns the number of points.
    pub(super) fn points(&self) -> usize {
        self.points
    }

    fn number(&mut self, tenths: i64, after_number: bool) {
        if tenths < 0 {
            self.text.push('-');
        } else if after_number {
            self.text.push(' ');
        }
        let (whole, rest) = (tenths.unsigned_abs() / 10, tenths.unsigned_abs() % 10);
        // Writing into a string cannot fail.
        let _ = if rest == 0 {
            write!(self.text, "{whole}")
        } else {
            write!(self.text, "{whole}.{rest}")
        };
    }

    /// Returns the path data as SVG text.
    pub(super) fn into_text(self) -> String {
        // A move without a line leaves a command without arguments.
        self.text.replace("lM", "M").trim_end_matches('l').to_owned()
    }
}

fn tenths(value: f64) -> i64 {
    (value * 10.0).round() as i64
}

/// A figure in progress.
pub(super) struct Canvas {
    group: Group,
}

impl Canvas {
    pub(super) fn new() -> Self {
        Self { group: Group::new() }
    }

    /// Draws a line.
    pub(super) fn line(&mut self, data: PathData, stroke: Stroke) {
        if data.points() < 2 {
            return;
        }
        let mut path = Path::new()
            .set("d", data.into_text())
            .set("fill", "none")
            .set("stroke", stroke.color)
            .set("stroke-width", number(stroke.width))
            .set("stroke-linejoin", "bevel");
        if let Some(dash) = stroke.dash {
            path = path.set("stroke-dasharray", (number(dash.drawn), number(dash.gap)));
        }
        if stroke.opacity < 1.0 {
            path = path.set("stroke-opacity", number(stroke.opacity));
        }
        self.add(path);
    }

    /// Draws a straight line.
    pub(super) fn segment(&mut self, from: (f64, f64), to: (f64, f64), stroke: Stroke) {
        let mut data = PathData::default();
        data.move_to(from.0, from.1);
        data.line_to(to.0, to.1);
        self.line(data, stroke);
    }

    /// Fills the area enclosed by a path.
    pub(super) fn area(&mut self, data: PathData, fill: &str, opacity: f64) {
        if data.points() < 3 {
            return;
        }
        let path = Path::new()
            .set("d", data.into_text())
            .set("fill", fill)
            .set("fill-opacity", number(opacity));
        self.add(path);
    }

    /// Draws a disc with an outline.
    pub(super) fn mark(&mut self, centre: (f64, f64), radius: f64, fill: &str, outline: &str) {
        let disc = circle(centre, radius).set("fill", fill).set("stroke", outline);
        self.add(disc.set("stroke-width", number(1.1)));
    }

    /// Draws a circle.
    pub(super) fn ring(&mut self, centre: (f64, f64), radius: f64, stroke: Stroke) {
        let ring = circle(centre, radius).set("fill", "none").set("stroke", stroke.color);
        self.add(ring.set("stroke-width", number(stroke.width)));
    }

    /// Fills a rectangle.
    pub(super) fn fill(&mut self, area: Rect, color: &str) {
        self.add(rectangle(area).set("fill", color));
    }

    /// Draws the outline of a rectangle.
    pub(super) fn frame(&mut self, area: Rect, stroke: Stroke) {
        let frame = rectangle(area).set("fill", "none").set("stroke", stroke.color);
        self.add(frame.set("stroke-width", number(stroke.width)));
    }

    /// Writes text. Characters that are invalid in XML become replacement characters.
    pub(super) fn text(&mut self, text: &str, at: TextAt) {
        let text = &text.replace(|c: char| c.is_control() || !in_xml(c), "\u{fffd}");
        let anchor = match at.anchor {
            Anchor::Start => "start",
            Anchor::Middle => "middle",
            Anchor::End => "end",
        };
        let width = font::width(text, at.size);
        let size = if width > at.room { at.size * at.room / width } else { at.size };
        let mut node = Text::new(text)
            .set("x", number(at.x))
            .set("y", number(at.y))
            .set("font-size", number(size))
            .set("text-anchor", anchor)
            .set("fill", INK);
        if at.upwards {
            node = node.set("transform", format!("rotate(-90 {} {})", number(at.x), number(at.y)));
        }
        self.add(node);
    }

    fn add(&mut self, node: impl svg::Node) {
        self.group = std::mem::replace(&mut self.group, Group::new()).add(node);
    }

    /// Returns the document, `height` user units high.
    pub(super) fn finish(self, height: f64) -> String {
        let background = Rect { left: 0.0, top: 0.0, width: WIDTH, height };
        let document = Document::new()
            .set("viewBox", (0, 0, number(WIDTH), number(height)))
            .set("width", number(WIDTH))
            .set("height", number(height))
            .set("font-family", font::FAMILY_WITH_FALLBACK)
            .add(rectangle(background).set("fill", "#ffffff"))
            .add(self.group);
        document.to_string()
    }
}

fn circle(centre: (f64, f64), radius: f64) -> Circle {
    Circle::new().set("cx", number(centre.0)).set("cy", number(centre.1)).set("r", number(radius))
}

fn rectangle(area: Rect) -> Rectangle {
    Rectangle::new()
        .set("x", number(area.left))
        .set("y", number(area.top))
        .set("width", number(area.width))
        .set("height", number(area.height))
}

/// Whether a character other than a control character is allowed in XML.
fn in_xml(character: char) -> bool {
    !matches!(character, '\u{fffe}' | '\u{ffff}')
}

/// Formats a number with at most two decimals.
fn number(value: f64) -> Value {
    Value::from((value * 100.0).round() / 100.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn path_data_is_compact_and_does_not_drift() {
        let mut data = PathData::default();
        data.line_to(1.04, 2.0);
        data.line_to(1.08, 1.5);
        data.line_to(1.12, 1.5);
        data.lift();
        data.line_to(5.0, 6.0);
        data.line_to(4.0, 6.25);
        assert_eq!(data.points(), 4);
        assert_eq!(data.into_text(), "M1 2l0.1-0.5M5 6l-1 0.3");
    }

    #[test]
    fn text_is_escaped_and_output_is_deterministic() {
        let draw = || {
            let mut canvas = Canvas::new();
            let at = TextAt::new(1.0, 2.0, 11.0, Anchor::Middle).upwards();
            canvas.text("a < b & c\u{1b}[31m]]>\n\"", at);
            canvas.frame(
                Rect { left: 0.0, top: 1.0, width: 2.0, height: 3.0 },
                Stroke::solid(INK, 0.8),
            );
            canvas.finish(100.0)
        };
        let (one, two) = (draw(), draw());
        assert_eq!(one, two);
        assert!(one.contains("a &lt; b &amp; c\u{fffd}[31m]]&gt;\u{fffd}"), "{one}");
        assert!(resvg::usvg::roxmltree::Document::parse(&one).is_ok(), "{one}");
    }
}
