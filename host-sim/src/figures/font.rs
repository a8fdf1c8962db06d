//! The typeface of all figures.
//!
//! DejaVu Sans is compiled into the program, so that pictures are identical on machines without
//! fonts. An SVG names it and falls back on any sans-serif face of the viewer. Its licence
//! (Bitstream Vera, with changes in the public domain) allows embedding.

use std::sync::{Arc, LazyLock};

use resvg::usvg::fontdb::{Database, Source};
use ttf_parser::Face;

/// Name of the typeface inside the font file.
pub(super) const FAMILY: &str = "DejaVu Sans";

/// The `font-family` of an SVG.
pub(super) const FAMILY_WITH_FALLBACK: &str = "DejaVu Sans, Verdana, sans-serif";

/// Width of a character missing from the face, as a fraction of the font size.
const MISSING_ADVANCE: f64 = 0.6;

static DATABASE: LazyLock<Arc<Database>> = LazyLock::new(|| {
    let mut database = Database::new();
    database.load_font_source(Source::Binary(Arc::new(dejavu::sans::regular())));
    database.set_sans_serif_family(FAMILY);
    Arc::new(database)
});

static FACE: LazyLock<Option<Face<'static>>> =
    LazyLock::new(|| Face::parse(dejavu::sans::regular(), 0).ok());

/// Returns the font database, which holds only the embedded face.
pub(super) fn database() -> Arc<Database> {
    Arc::clone(&DATABASE)
}

/// Returns the width of `text` at font size `size`, in the unit of `size`.
pub(super) fn width(text: &str, size: f64) -> f64 {
    let advance = |character| {
        let face = FACE.as_ref()?;
        let units = face.glyph_hor_advance(face.glyph_index(character)?)?;
        Some(f64::from(units) / f64::from(face.units_per_em()))
    };
    text.chars().map(|character| advance(character).unwrap_or(MISSING_ADVANCE)).sum::<f64>() * size
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn embedded_face_has_the_name_used_in_figures() {
        let names: Vec<_> =
            database().faces().flat_map(|face| face.families.clone()).map(|name| name.0).collect();
        assert!(names.iter().any(|name| name == FAMILY), "{names:?}");
    }

    #[test]
    fn face_contains_all_characters_of_labels() {
        let face = FACE.as_ref().expect("the embedded font is a font");
        for character in "0123456789−.‖₁₂ᵢ()[]/ abcxyzt×–≤<µ".chars() {
            assert!(face.glyph_index(character).is_some(), "{character:?} would show as a box");
        }
    }

    #[test]
    fn text_width_is_the_sum_of_its_characters() {
        let (one, two) = (width("0", 10.0), width("00", 10.0));
        assert!((two - 2.0 * one).abs() < 1e-12);
        assert!(width("i", 10.0) < width("m", 10.0));
    }
}
