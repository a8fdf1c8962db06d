//! A page about a run or a study: one HTML file that works without a network.
//!
//! The page holds its data as one JSON element with the id `run`, a style sheet, a script, and the plotting
//! library uPlot. The script reads only that element, so the data can be taken from the page by other
//! programs.
//!
//! | module | purpose |
//! | --- | --- |
//! | [`traces`] | errors, states and innovations over time, thinned to what a screen can show |
//! | [`events`] | times of broadcasts, or their number in intervals |
//! | [`curves`] | errors of the training runs, epoch by epoch |
//! | [`layout`] | where agents of a graph are drawn |

pub mod curves;
pub mod events;
pub mod layout;
mod number;
mod table;
pub mod traces;

use std::path::PathBuf;

use crate::files::output::FileKind;

const PAGE: &str = include_str!("../../assets/page/page.html");
const STYLE: &str = include_str!("../../assets/page/style.css");
const LIBRARY: &str = include_str!("../../assets/page/uplot/uPlot.iife.min.js");
const LIBRARY_STYLE: &str = include_str!("../../assets/page/uplot/uPlot.min.css");
const SCRIPTS: [&str; 6] = [
    include_str!("../../assets/page/elements.js"),
    include_str!("../../assets/page/time_plots.js"),
    include_str!("../../assets/page/agent_plots.js"),
    include_str!("../../assets/page/graph.js"),
    include_str!("../../assets/page/study.js"),
    include_str!("../../assets/page/page.js"),
];

/// Marks a page of this program.
pub const GENERATOR: &str = "<meta name=\"generator\" content=\"host-sim\">";

/// The kind of pages.
pub const KIND: FileKind = FileKind {
    name: "a page about results",
    recognises: |bytes| {
        let head = &bytes[..bytes.len().min(1024)];
        head.windows(GENERATOR.len()).any(|window| window == GENERATOR.as_bytes())
    },
};

/// Why a table of results cannot be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum TableError {
    /// The file cannot be read as CSV.
    #[error("{}: cannot be read: {error}; rerun the command that wrote it", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The reader's error.
        error: csv::Error,
    },
    /// A field is not what its column says.
    #[error(
        "{}, line {line}: \"{field}\" is not {expected}; rerun the command that wrote it",
        path.display()
    )]
    Field {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The text of the field.
        field: String,
        /// What was expected.
        expected: &'static str,
    },
    /// Columns or rows are missing.
    #[error("{}: it is not {expected}; rerun the command that wrote it", path.display())]
    Kind {
        /// The file.
        path: PathBuf,
        /// What was expected.
        expected: &'static str,
    },
}

/// Returns the page called `title` with these data, the text of a JSON object.
#[must_use]
pub fn html(title: &str, data: &str) -> String {
    // Nothing in a JSON string can end the element or begin a comment.
    let data = data.replace('<', "\\u003c");
    let scripts = SCRIPTS.concat();
    let style = [LIBRARY_STYLE, STYLE].concat();
    let parts = [
        ("{{generator}}", GENERATOR),
        ("{{title}}", &escaped(title)),
        ("{{style}}", &style),
        ("{{data}}", &data),
        ("{{library}}", LIBRARY),
        ("{{script}}", &scripts),
    ];
    let mut page = String::with_capacity(data.len() + PAGE.len() + 200_000);
    let mut rest = PAGE;
    // In the order of the template, so that nothing is replaced within a part.
    for (name, part) in parts {
        if let Some((before, after)) = rest.split_once(name) {
            page.push_str(before);
            page.push_str(part);
            rest = after;
        }
    }
    page.push_str(rest);
    page
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_has_its_place_in_the_template() {
        let page = html("T", "{\"x\":1}");
        assert!(!page.contains("{{"), "a part is missing");
        assert!(page.contains(GENERATOR) && page.contains("<title>T</title>"));
        assert!(page.contains("<script type=\"application/json\" id=\"run\">{\"x\":1}</script>"));
    }

    #[test]
    fn data_and_title_cannot_leave_their_elements() {
        let page = html("</title><b>", "{\"x\":\"</script><!--{{library}}\"}");
        assert!(page.contains("<title>&lt;/title&gt;&lt;b&gt;</title>"));
        assert!(page.contains("{\"x\":\"\\u003c/script>\\u003c!--{{library}}\"}"));
    }

    #[test]
    fn the_page_asks_for_nothing_from_a_network() {
        let page = html("T", "{}");
        for reference in ["src=", "href=\"http", "url(", "@import", "fetch(", "XMLHttpRequest"] {
            assert!(!page.contains(reference), "{reference}");
        }
    }
}
