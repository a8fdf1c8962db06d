//! From SVG to PNG.

use png::{BitDepth, ColorType, Compression, Encoder, Filter};
use resvg::tiny_skia::{Color, Pixmap, Transform};
use resvg::usvg::{Options, Tree};

use super::font;

/// Width of every picture. \[pixel\]
pub const PNG_WIDTH: u32 = 1600;

/// The renderer or the PNG encoder refused a figure.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RenderError {
    /// The SVG is not one that the renderer understands.
    #[error("the SVG cannot be rendered: {0}")]
    Svg(String),
    /// The picture would be empty or larger than memory.
    #[error("a picture of {PNG_WIDTH} x {height} pixels cannot be made")]
    Size {
        /// Its height. \[pixel\]
        height: u32,
    },
    /// The encoder failed.
    #[error("the picture cannot be encoded: {0}")]
    Png(#[from] png::EncodingError),
}

/// Renders a figure on white.
pub(super) fn png(svg: &str) -> Result<Vec<u8>, RenderError> {
    let options = Options {
        fontdb: font::database(),
        font_family: font::FAMILY.to_owned(),
        ..Options::default()
    };
    let tree =
        Tree::from_str(svg, &options).map_err(|error| RenderError::Svg(error.to_string()))?;
    let scale = PNG_WIDTH as f32 / tree.size().width();
    let height = (tree.size().height() * scale).round() as u32;
    let mut picture = Pixmap::new(PNG_WIDTH, height).ok_or(RenderError::Size { height })?;
    picture.fill(Color::WHITE);
    resvg::render(&tree, Transform::from_scale(scale, scale), &mut picture.as_mut());
    encode(&picture)
}

/// On white every pixel is opaque: three channels say all.
fn encode(picture: &Pixmap) -> Result<Vec<u8>, RenderError> {
    let opaque: Vec<u8> =
        picture.data().chunks_exact(4).flat_map(|pixel| [pixel[0], pixel[1], pixel[2]]).collect();
    let mut bytes = Vec::with_capacity(opaque.len() / 16);
    let mut encoder = Encoder::new(&mut bytes, picture.width(), picture.height());
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    // Of the filters this one makes the smallest files, and is as fast as any.
    encoder.set_filter(Filter::Paeth);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&opaque)?;
    writer.finish()?;
    Ok(bytes)
}
