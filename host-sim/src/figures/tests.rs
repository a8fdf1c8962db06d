//! Whole figures: documents that parse, and pictures that are not empty.

use resvg::usvg::roxmltree::Document;

use super::*;
use crate::engine::traces::Traces;

/// Reproducible noise in \[-1, 1) from a linear congruential generator.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f64 / f64::from(1 << 23) - 1.0
    }
}

/// Creates oscillations over 40 s; errors decay from about 5 per component to chatter of about
/// 0.05.
fn traces(dimension: usize, agents: usize, rows: usize) -> Traces {
    let mut noise = Noise(1);
    let mut traces = Traces::with_capacity(dimension, agents, rows);
    for row in 0..rows {
        let time = 40.0 * row as f64 / (rows - 1) as f64;
        let truth: Vec<f64> = (0..dimension)
            .map(|component| 3.0 * (time * (1.0 + 0.1 * component as f64)).cos())
            .collect();
        let estimates: Vec<f32> = (0..agents * dimension)
            .map(|index| {
                let error = 5.0 * (-time / 0.02).exp() + 0.05 * noise.next();
                (truth[index % dimension] + error) as f32
            })
            .collect();
        traces.push(time, &truth, estimates.chunks(dimension));
    }
    traces
}

/// Creates broadcasts of each agent about every `interval` steps, for 40,000 steps.
fn broadcasts(agents: usize, interval: u64) -> Vec<Vec<u64>> {
    (0..agents as u64)
        .map(|agent| (agent % interval..40_000).step_by(interval as usize).collect())
        .collect()
}

fn slices(events: &[Vec<u64>]) -> Vec<&[u64]> {
    events.iter().map(Vec::as_slice).collect()
}

/// Returns the texts of a document in document order.
fn texts(document: &Document<'_>) -> Vec<String> {
    let texts = document.descendants().filter(|node| node.has_tag_name("text"));
    texts.filter_map(|node| Some(node.text()?.trim().to_owned())).collect()
}

/// Returns the length of the longest path.
fn longest_path(document: &Document<'_>) -> usize {
    let paths = document.descendants().filter_map(|node| node.attribute("d"));
    paths.map(|data| data.bytes().filter(u8::is_ascii_digit).count()).max().unwrap_or(0)
}

/// Returns width, height, and the number of different colours.
fn picture(bytes: &[u8]) -> (u32, u32, usize) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    let mut colors: Vec<&[u8]> = pixels.chunks_exact(3).collect();
    colors.sort_unstable();
    colors.dedup();
    (info.width, info.height, colors.len())
}

#[test]
fn error_figure_shows_data_markers_and_transient() {
    let traces = traces(3, 3, 40_001);
    let markers = [
        Marker::collection_start(10.0, "starts"),
        Marker::collection_end(16.0, "ends"),
        Marker::apply(20.0, "applied"),
    ];
    let figure = error_norms(&ErrorFigure {
        title: "Errors",
        traces: &traces,
        markers: &markers,
        references: &[no_network(vec![Some(0.09), Some(0.08), Some(0.07)])],
        error_limit: None,
    });
    assert!(figure.svg().len() < 400_000, "{} bytes", figure.svg().len());
    let document = Document::parse(figure.svg()).unwrap();
    let texts = texts(&document);
    for text in [
        "Errors",
        "agent 3",
        "starts",
        "ends",
        "applied",
        "no network, RMS",
        "transient in full",
        "time t [s]",
    ] {
        assert!(texts.iter().any(|shown| shown == text), "{text:?} is not among {texts:?}");
    }
    assert!(longest_path(&document) > 4_000);
    let (width, height, colors) = picture(&figure.png().unwrap());
    assert_eq!(width, PNG_WIDTH);
    assert!((1000..1500).contains(&height), "{height}");
    assert!(colors > 200, "{colors}");
}

#[test]
fn error_axis_fits_the_steady_state_of_all_runs() {
    let quiet = traces(3, 3, 4_001);
    let limit = error_axis_limit(&[&quiet], &[]);
    assert!((0.05..0.15).contains(&limit), "{limit}");
    let worse = traces(12, 3, 4_001);
    assert!(error_axis_limit(&[&quiet, &worse], &[]) > limit);
    // The axis includes references.
    let reference = no_network(vec![Some(1.0), None, Some(0.5)]);
    assert!((1.0..1.3).contains(&error_axis_limit(&[&quiet], &[reference])));
    assert!((error_axis_limit(&[], &[]) - 1.0).abs() < f64::EPSILON);
}

#[test]
fn few_broadcasts_become_ticks() {
    let events = broadcasts(3, 10);
    let figure = events_of(&events, 19.75, 20.25);
    let document = Document::parse(figure.svg()).unwrap();
    let texts = texts(&document);
    // Multiples of 10, 10 k + 1 and 10 k + 2 from 19,750 to 20,250, both ends included.
    let summary = "151 broadcasts in 0.5 s: 51 of agent 1, 50 of agent 2, 50 of agent 3";
    assert!(texts.iter().any(|text| text == summary), "{texts:?}");
    let ticks = document.descendants().filter_map(|node| node.attribute("d"));
    assert!(ticks.map(|data| data.matches('M').count()).any(|count| count == 51));
}

fn no_network(errors: Vec<Option<f64>>) -> Reference<'static> {
    Reference { label: "no network", from: 20.0, to: 40.0, errors }
}

fn errors_of(title: &str, traces: &Traces) -> Figure {
    let (markers, references) = (&[], &[]);
    error_norms(&ErrorFigure { title, traces, markers, references, error_limit: None })
}

fn states_of(title: &str, traces: &Traces) -> Figure {
    let names: Vec<String> = (1..=traces.dimension()).map(|i| format!("x{i}")).collect();
    states(&StateFigure { title, traces, names: &names, truth: Some("true state") })
}

fn events_of(events: &[Vec<u64>], from: f64, to: f64) -> Figure {
    super::events(&EventFigure {
        title: "Broadcasts",
        events: &slices(events),
        step_size: 1e-3,
        from,
        to,
    })
}

#[test]
fn figures_of_large_networks_stay_small_and_parse() {
    let (large, wide) = (traces(2, 1000, 201), traces(12, 8, 4_001));
    let many = broadcasts(1000, 7);
    let figures = [
        errors_of("", &large),
        states_of("", &large),
        states_of("", &wide),
        events_of(&many, 19.75, 20.25),
        events_of(&many, 0.0, 40.0),
        events_of(&many[..50], 0.0, 40.0),
    ];
    for (index, figure) in figures.iter().enumerate() {
        assert!(figure.svg().len() < 400_000, "figure {index}: {} bytes", figure.svg().len());
        let document = Document::parse(figure.svg()).unwrap();
        assert!(longest_path(&document) > 100, "figure {index} shows nothing");
        let (width, _, colors) = picture(&figure.png().unwrap());
        assert_eq!(width, PNG_WIDTH);
        assert!(colors > 20, "figure {index}: {colors} colours");
    }
}

#[test]
fn empty_recording_gives_empty_axes() {
    let empty = Traces::with_capacity(3, 3, 0);
    let no_agents = Traces::with_capacity(0, 0, 0);
    for traces in [&empty, &no_agents] {
        let figures = [
            errors_of("Empty", traces),
            states_of("Empty", traces),
            events_of(&vec![Vec::new(); traces.agents()], 0.0, 1.0),
        ];
        for figure in figures {
            let document = Document::parse(figure.svg()).unwrap();
            assert!(texts(&document).iter().any(|text| text == "Empty" || text == "Broadcasts"));
        }
    }
}

#[test]
fn diverged_runs_are_drawn() {
    let mut traces = traces(2, 2, 501);
    for row in 0..500 {
        let value = if row < 250 { 1e30 } else { f32::NAN };
        traces.push(
            40.0 + 0.08 * f64::from(row + 1),
            &[f64::NAN, 1.0],
            [[value; 2]; 2].iter().map(|x| &x[..]),
        );
    }
    for figure in [errors_of("", &traces), states_of("", &traces)] {
        for wrong in ["NaN", "inf"] {
            let at = figure.svg().find(wrong);
            assert_eq!(
                at,
                None,
                "{:?}",
                at.map(|at| &figure.svg()[at.saturating_sub(90)..at + 20])
            );
        }
        assert!(picture(&figure.png().unwrap()).2 > 20);
    }
}

#[test]
fn output_is_deterministic_and_written_to_files() {
    let traces = traces(3, 9, 2_001);
    let draw = || states_of("Again", &traces);
    let (one, two) = (draw(), draw());
    assert_eq!(one, two);
    let folder = std::env::temp_dir().join(format!("figures-{}", std::process::id()));
    let paths = write_all(&folder, &[("one", one), ("two", two)], &FigureFormat::ALL).unwrap();
    let read = |path: &PathBuf| std::fs::read(path).unwrap();
    assert_eq!(read(&paths[0][0]), read(&paths[1][0]));
    assert_eq!(read(&paths[0][1]), read(&paths[1][1]));
    assert_eq!(read(&paths[0][2]), read(&paths[1][2]));
    assert_eq!(paths[1][1..], [folder.join("two.png"), folder.join("two.pdf")]);
    std::fs::remove_dir_all(&folder).unwrap();
}

#[test]
fn pdf_has_vectors_and_an_embedded_font() {
    let traces = traces(3, 3, 2_001);
    let pdf = states_of("Vectors", &traces).pdf().unwrap();
    let has = |text: &str| pdf.windows(text.len()).any(|window| window == text.as_bytes());
    assert!(pdf.starts_with(b"%PDF-") && has("/Type/Page"));
    assert!(has("+DejaVuSans") && has("/FontFile2"));
    // No date, so that the same data give the same bytes; and no pixels.
    assert!(!has("/CreationDate") && !has("/Subtype/Image"));
}

#[test]
fn error_names_the_file_that_cannot_be_written() {
    let folder = std::env::temp_dir().join(format!("in-the-way-{}", std::process::id()));
    std::fs::write(&folder, "a file").unwrap();
    let traces = traces(1, 1, 11);
    let error =
        states_of("", &traces).write(&folder, "figure", &FigureFormat::DEFAULT).unwrap_err();
    assert!(error.to_string().contains("figure.svg"), "{error}");
    std::fs::remove_file(&folder).unwrap();
}
