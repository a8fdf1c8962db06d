//! What an error figure shows besides the run: marked instants, and errors of other runs.

use super::canvas::{Canvas, INK, Stroke};
use super::palette::{self, LINES, SIGNAL};
use super::panel::{Entry, Panel, Sample};

/// An instant that is marked in a figure.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Marker<'a> {
    /// When. \[s\]
    pub(super) time: f64,
    label: &'a str,
    stroke: Stroke,
    /// Whether the error may jump here, so that no mean is taken across it.
    pub(super) jump: bool,
}

impl<'a> Marker<'a> {
    /// Agents begin to collect data, at `time` \[s\]: black, dashed.
    #[must_use]
    pub const fn collection_start(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1).dashed(5.0, 3.0), jump: false }
    }

    /// Agents stop collecting and train, at `time` \[s\]: black, solid.
    #[must_use]
    pub const fn collection_end(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid("#000000", 1.1), jump: false }
    }

    /// Trained networks are switched in, at `time` \[s\]: red, dashed.
    #[must_use]
    pub const fn apply(time: f64, label: &'a str) -> Self {
        Self { time, label, stroke: Stroke::solid(SIGNAL, 1.3).dashed(5.0, 3.0), jump: true }
    }

    fn is_shown(&self, panel: &Panel) -> bool {
        (panel.x.from..=panel.x.to).contains(&self.time)
    }
}

/// Draws vertical lines, which the legend explains.
pub(super) fn draw_markers(canvas: &mut Canvas, panel: &Panel, markers: &[Marker<'_>]) {
    for marker in markers.iter().filter(|marker| marker.is_shown(panel)) {
        let x = panel.at_x(marker.time);
        canvas.segment((x, panel.area.bottom()), (x, panel.area.top), marker.stroke);
    }
}

/// An entry for each kind of instant.
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

/// Root mean square errors of a run to compare with, drawn as horizontal lines in the colours of
/// the agents; of more agents than have lines of their own, their median in black.
#[derive(Clone, Debug, PartialEq)]
pub struct Reference<'a> {
    /// What the run is called.
    pub label: &'a str,
    /// Start of the time that the errors are taken over. \[s\]
    pub from: f64,
    /// End of the time that the errors are taken over. \[s\]
    pub to: f64,
    /// Of each agent, where there is one. \[state unit\]
    pub errors: Vec<Option<f64>>,
}

impl Reference<'_> {
    /// What is drawn: an error and its colour.
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

    /// The largest error that is drawn. \[state unit\]
    pub(super) fn largest(&self) -> f64 {
        self.levels().into_iter().map(|(error, _)| error).fold(0.0, f64::max)
    }
}

/// How the lines of a reference are drawn: the first one dotted, the second one dashed.
const fn stroke(index: usize, color: &'static str) -> Stroke {
    match index {
        0 => Stroke::solid(color, 1.6).dashed(1.5, 1.8),
        _ => Stroke::solid(color, 1.3).dashed(6.0, 2.5),
    }
}

/// Draws references on a white background, so that curves do not hide them. The last one is drawn
/// first: dots show on dashes, but dashes do not show on dots.
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

/// An entry for each reference.
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
    fn references_are_lines_of_agents_or_one_median() {
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
    fn each_kind_of_instant_has_one_entry() {
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
