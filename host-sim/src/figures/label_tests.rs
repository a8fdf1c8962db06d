//! Labels do not overlap each other or a panel and stay within the figure, for runs of all shapes.

use resvg::usvg::roxmltree::{Document, Node};

use super::*;
use crate::engine::traces::Traces;

/// Creates traces of 20 s around `offset`; errors start at `size` and decay to a hundredth within a
/// second.
fn traces(dimension: usize, agents: usize, offset: f64, size: f64) -> Traces {
    let rows = 801;
    let mut traces = Traces::with_capacity(dimension, agents, rows);
    for row in 0..rows {
        let time = 20.0 * row as f64 / (rows - 1) as f64;
        let phase = |component: usize| time * (1.0 + 0.1 * component as f64);
        let truth: Vec<f64> =
            (0..dimension).map(|component| offset + size * phase(component).cos()).collect();
        let estimates: Vec<f32> = (0..agents * dimension)
            .map(|index| {
                let error = size * ((-time / 0.1).exp() + 0.01 * phase(index).sin());
                (truth[index % dimension] + error) as f32
            })
            .collect();
        traces.push(time, &truth, estimates.chunks(dimension));
    }
    traces
}

/// Left, top, right, bottom.
type Box = [f64; 4];

fn attribute(node: &Node<'_, '_>, name: &str) -> f64 {
    node.attribute(name).and_then(|value| value.parse().ok()).unwrap_or_default()
}

/// Returns a text and its bounding box; most texts have no descenders and do not fill their line.
fn text_box(node: &Node<'_, '_>) -> (String, Box) {
    let text = node.text().unwrap_or_default().trim().to_owned();
    let [x, y, size] = ["x", "y", "font-size"].map(|name| attribute(node, name));
    let width = font::width(&text, size);
    let before = match node.attribute("text-anchor") {
        Some("middle") => 0.5 * width,
        Some("end") => width,
        _ => 0.0,
    };
    let (ascent, descent) = (0.72 * size, 0.1 * size);
    let area = if node.attribute("transform").is_some() {
        // Reading upwards, the text left of the anchor lies below it.
        [x - ascent, y + before - width, x + descent, y + before]
    } else {
        [x - before, y - ascent, x - before + width, y + descent]
    };
    (text, area)
}

fn overlap(a: &Box, b: &Box) -> bool {
    a[0] < b[2] && b[0] < a[2] && a[1] < b[3] && b[1] < a[3]
}

/// Returns the panels: rectangles without a fill.
fn panels(document: &Document<'_>) -> Vec<Box> {
    let frames = document
        .descendants()
        .filter(|node| node.has_tag_name("rect") && node.attribute("fill") == Some("none"));
    let area = |node: Node<'_, '_>| {
        let [x, y, w, h] = ["x", "y", "width", "height"].map(|name| attribute(&node, name));
        [x, y, x + w, y + h]
    };
    frames.map(area).collect()
}

fn assert_legible(name: &str, figure: &Figure) {
    let document = Document::parse(figure.svg()).unwrap();
    let root = document.root_element();
    let whole = [0.0, 0.0, attribute(&root, "width"), attribute(&root, "height")];
    let texts = document.descendants().filter(|node| node.has_tag_name("text"));
    let texts: Vec<_> = texts.map(|node| text_box(&node)).collect();
    assert!(texts.len() > 5, "{name}");
    let panels = panels(&document);
    assert!(!panels.is_empty(), "{name}");
    for (index, (text, area)) in texts.iter().enumerate() {
        let inside = area[0] >= whole[0]
            && area[1] >= whole[1]
            && area[2] <= whole[2]
            && area[3] <= whole[3];
        assert!(inside, "{name}: {text:?} at {area:?} leaves {whole:?}");
        assert!(!panels.iter().any(|panel| overlap(panel, area)), "{name}: {text:?} on a panel");
        for (other, other_area) in &texts[..index] {
            assert!(!overlap(area, other_area), "{name}: {text:?} on {other:?}");
        }
    }
    for (index, panel) in panels.iter().enumerate() {
        assert!(!panels[..index].iter().any(|other| overlap(panel, other)), "{name}: two panels");
    }
}

#[test]
fn labels_do_not_overlap() {
    type Named = fn(usize) -> String;
    let long = |index: usize| format!("concentration_of_substrate_in_tank_{index}");
    let short = |index: usize| format!("x{index}");
    let shapes: [(&str, usize, usize, f64, f64, Named); 9] = [
        ("paper", 3, 3, 0.0, 3.0, short),
        ("one state", 1, 1, 0.0, 1.0, short),
        ("eight agents", 2, 8, 0.0, 1.0, short),
        ("many agents", 2, 100, 0.0, 1.0, short),
        ("many long names", 12, 2, 0.0, 1.0, long),
        ("few long names", 4, 2, 0.0, 1.0, long),
        ("tiny", 2, 2, 0.0, 1.3e-7, long),
        ("kelvin", 6, 2, 300.0, 0.1, long),
        ("huge", 3, 2, -1e9, 123.0, long),
    ];
    for (name, dimension, agents, offset, size, named) in shapes {
        let traces = traces(dimension, agents, offset, size);
        let names: Vec<String> = (1..=dimension).map(named).collect();
        let markers = [
            Marker::collection_start(2.0, "collect"),
            Marker::collection_end(2.1, "train"),
            Marker::apply(2.2, "apply"),
            Marker::apply(15.0, "apply"),
        ];
        let reference = |label| Reference {
            label,
            from: 10.0,
            to: 20.0,
            errors: vec![Some(0.02 * size); agents],
        };
        let errors = error_norms(&ErrorFigure {
            title: "Errors",
            traces: &traces,
            markers: &markers,
            references: &[reference("no network"), reference("untrained")],
            error_limit: None,
        });
        assert_legible(&format!("{name}, errors"), &errors);
        let truth = Some("true state");
        let states =
            states(&StateFigure { title: "States", traces: &traces, names: &names, truth });
        assert_legible(&format!("{name}, states"), &states);
        // A name in a smaller size is still present.
        assert!(names.iter().all(|name| states.svg().contains(name)), "{name}");
    }
}

#[test]
fn transient_panel_shows_what_the_upper_axes_cut_off() {
    // The error leaves the axes again long after it first entered them.
    let mut traces = Traces::with_capacity(1, 1, 401);
    for row in 0..=400 {
        let time = f64::from(row) * 0.05;
        let error = if time < 4.0 { 5.0 * (2.0 * time).cos() } else { 0.1 };
        traces.push(time, &[0.0], [[error as f32]].iter().map(|x| &x[..]));
    }
    let (markers, references) = (&[], &[]);
    let figure = error_norms(&ErrorFigure {
        title: "",
        traces: &traces,
        markers,
        references,
        error_limit: None,
    });
    let document = Document::parse(figure.svg()).unwrap();
    let texts = document.descendants().filter(|node| node.has_tag_name("text"));
    let texts: Vec<_> = texts.filter_map(|node| node.text().map(str::trim)).collect();
    // The last error beyond the axes is at 3.95 s; the lower axes extend to the round number above
    // 1.5 times that.
    let below = texts.iter().position(|text| *text == "transient in full").unwrap();
    assert!(texts[..below].contains(&"0.10") && texts.contains(&"6"), "{texts:?}");
    assert!(texts.contains(&"10⁻²") && texts.contains(&"10¹"), "{texts:?}");
}
