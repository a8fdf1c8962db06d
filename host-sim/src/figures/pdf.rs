//! Renders SVG as PDF.

use krilla::Document;
use krilla::geom::Size;
use krilla::page::PageSettings;
use krilla_svg::{SurfaceExt, SvgSettings};

use super::render::{RenderError, tree};

/// Points per unit of a figure, of which CSS counts 96 per inch.
const POINTS: f32 = 72.0 / 96.0;

/// Renders a figure as the only page of a document.
pub(super) fn pdf(svg: &str) -> Result<Vec<u8>, RenderError> {
    let tree = tree(svg)?;
    let rejected = |problem: &str| RenderError::Pdf(problem.to_owned());
    let size = Size::from_wh(POINTS * tree.size().width(), POINTS * tree.size().height())
        .ok_or_else(|| rejected("the page would be empty"))?;
    let mut document = Document::new();
    let mut page = document.start_page_with(PageSettings::new(size));
    let mut surface = page.surface();
    let settings = SvgSettings { embed_text: true, ..SvgSettings::default() };
    surface
        .draw_svg(&tree, size, settings)
        .ok_or_else(|| rejected("the figure cannot be drawn"))?;
    surface.finish();
    page.finish();
    document.finish().map_err(|error| RenderError::Pdf(format!("{error:?}")))
}
