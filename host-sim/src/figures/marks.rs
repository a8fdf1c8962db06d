//! Marked instants and reference levels of an error figure.

use super::canvas::{Canvas, INK, Stroke};
use super::palette::{self, LINES, SIGNAL};
use super::panel::{Entry, Panel, Sample};

/// A marked instant of a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker<'a> {
    /// Time. \[s\]
    pub(super) time: f64,
    label: &'a str,
    stroke: Stroke,
    /// Whether the error may jump here, in which case means are not taken across it.
    pub(super) jump: bool,
}

impl<'a> Marker<'a> {
    /// Marks the start of data collection at `time` \[s\]: black, dashed.
    #[must_use]
    pub const fn collection_start(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1).dashed(5.0, 3.0), jump: false }
    }

    /// Marks the end of data collection and the training at `time` \[s\]: black, solid.
    #[must_use]
    pub const fn collection_end(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1), jump: false }
    }

    /// Marks the switch to trained networks at `time` \[s\]: red, dashed.
    #[must_use]
    pub const fn apply(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid(SIGNAL, 1.3).dashed(5.0, 3.0), jump: true }
    }

    /// Returns its time. \[s\]
    #[must_use]
    pub const fn time(&self) -> f64 {
        self.time
    }

    /// Returns what happens there.
    #[must_use]
    pub const fn label(&self) -> &str {
        self.label
    }

    fn is_shown(&self, panel: &Panel) -> bool {
        (panel.x.from..=panel.x.to).contains(&self.time)
    }
}

/// Draws the markers as vertical lines; the legend explains them.
pub(super) fn draw_markers(canvas: &mut Canvas, panel: &Panel, markers: &[Marker<'_>]) {
    for marker in markers.iter().filter(|marker| marker.is_shown(panel)) {
        let x = panel.at_x(marker.time);
        canvas.segment((x, panel.area.bottom()), (x, panel.area.top), marker.stroke);
    }
}

/// Returns one legend entry per kind of marker.
pub(super) fn marker_entries(markers: &[Marker<'_>]) -> Vec<Entry> {
    let mut kinds: Vec<&Marker<'_>> = Vec::new();
    for marker in markers {
        let same = |kind: &&Marker<'_>| (kind.label, kind.stroke) == (marker.label, marker.stroke);
        if !kinds.iter().any(same) {
            kinds.push(marker);
        }
    }
    let entry = |marker: &Marker<'_>| Entry {
        text: marker.label.to_owned(),
        sample: Sample::Upright(marker.stroke),
    };
    kinds.into_iter().map(entry).collect()
}

/// Root mean square errors of another run, drawn as horizontal lines in the agents' colours; if
/// there are too many agents for separate lines, their median is drawn in black.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference<'a> {
    /// Name of the run.
    pub label: &'a str,
    /// Start of the window of the errors. \[s\]
    pub from: f64,
    /// End of the window of the errors. \[s\]
    pub to: f64,
    /// Error of each agent, where known. \[state unit\]
    pub errors: Vec<Option<f64>>,
}

impl Reference<'_> {
    /// Returns the lines to draw: an error and its colour.
    fn levels(&self) -> Vec<(f64, &'static str)> {
        let finite = |error: &Option<f64>| error.filter(|error| error.is_finite());
        if self.errors.len() <= LINES {
            let levels = self.errors.iter().enumerate();
            return levels
                .filter_map(|(agent, error)| Some((finite(error)?, palette::agent(agent))))
                .collect();
        }
        let mut errors: Vec<f64> = self.errors.iter().filter_map(finite).collect();
        errors.sort_by(f64::total_cmp);
        errors.get(errors.len() / 2).map(|&median| (median, INK)).into_iter().collect()
    }

    /// Returns the largest error drawn. \[state unit\]
    pub(super) fn largest(&self) -> f64 {
        self.levels().into_iter().map(|(error, _)| error).fold(0.0, f64::max)
    }
}

/// Returns the line style of a reference: the first dotted, the second dashed.
const fn stroke(index: usize, color: &'static str) -> Stroke {
    match index {
        0 => Stroke::solid(color, 1.6).dashed(1.5, 1.8),
        _ => Stroke::solid(color, 1.3).dashed(6.0, 2.5),
    }
}

/// Draws references on a white background, so that curves do not hide them. The last one is drawn
/// first, because dots remain visible on dashes but not vice versa.
pub(super) fn draw_references(canvas: &mut Canvas, panel: &Panel, references: &[Reference<'_>]) {
    for (index, reference) in references.iter().enumerate().rev() {
        let (left, right) = (panel.at_x(reference.from), panel.at_x(reference.to));
        let (left, right) = (left.max(panel.area.left), right.min(panel.area.right()));
        for (error, color) in reference.levels() {
            let y = panel.at_y(error);
            if y < panel.area.top || left >= right {
                continue;
            }
            canvas.segment((left, y), (right, y), Stroke::solid("#ffffff", 2.2).faint(0.4));
            canvas.segment((left, y), (right, y), stroke(index, color));
        }
    }
}

/// Returns one legend entry per reference.
pub(super) fn reference_entries(references: &[Reference<'_>]) -> Vec<Entry> {
    let entry = |(index, reference): (usize, &Reference<'_>)| Entry {
        text: match reference.errors.len() {
            0..=LINES => format!("{}, RMS", reference.label),
            _ => format!("{}, median RMS", reference.label),
        },
        sample: Sample::Line(stroke(index, INK)),
    };
    references.iter().enumerate().map(entry).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_agents_share_a_median_reference() {
        let few = Reference {
            label: "untrained",
            from: 0.0,
            to: 1.0,
            errors: vec![Some(0.5), None, Some(f64::NAN), Some(0.25)],
        };
        let colors: Vec<_> = few.levels();
        assert_eq!(colors, [(0.5, palette::agent(0)), (0.25, palette::agent(3))]);
        let errors = (0..9).rev().map(|error| Some(f64::from(error))).collect();
        let many = Reference { errors, ..few };
        assert_eq!(many.levels(), [(4.0, INK)]);
    }

    #[test]
    fn legend_has_one_entry_per_kind_of_marker() {
        let markers = [
            Marker::collection_start(1.0, "collect"),
            Marker::apply(2.0, "apply"),
            Marker::collection_start(3.0, "collect"),
            Marker::apply(4.0, "apply"),
        ];
        let entries: Vec<_> =
            marker_entries(&markers).into_iter().map(|entry| entry.text).collect();
        assert_eq!(entries, ["collect", "apply"]);
    }
}
