//! What PNG and PDF have in common: the tree of an SVG.

use resvg::usvg::{Options, Tree};

use super::font;

/// Width of every PNG. \[pixels\]
pub const PNG_WIDTH: u32 = 1600;

/// Why a figure could not be rendered.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RenderError {
    /// The renderer rejected the SVG.
    #[error("the SVG cannot be rendered: {0}")]
    Svg(String),
    /// The picture would be empty or too large for memory.
    #[error("cannot allocate a picture of {PNG_WIDTH} x {height} pixels")]
    Size {
        /// Height. \[pixels\]
        height: u32,
    },
    /// The encoder failed.
    #[error("the picture cannot be encoded: {0}")]
    Png(#[from] png::EncodingError),
    /// The PDF could not be written.
    #[error("the PDF cannot be made: {0}")]
    Pdf(String),
}

/// Reads a figure, with the embedded typeface only.
pub(super) fn tree(svg: &str) -> Result<Tree, RenderError> {
    let options = Options {
        fontdb: font::database(),
        font_family: font::FAMILY.to_owned(),
        ..Options::default()
    };
    Tree::from_str(svg, &options).map_err(|error| RenderError::Svg(error.to_string()))
}
