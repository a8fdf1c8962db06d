//! The file formats of figures.

use crate::files::output::FileKind;

/// A file format of figures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FigureFormat {
    /// Vector graphics for browsers, from which the others are made.
    Svg,
    /// Pixels.
    Png,
    /// Vector graphics for LaTeX, with embedded fonts.
    Pdf,
}

impl FigureFormat {
    /// The formats without `--pdf`.
    pub const DEFAULT: [Self; 2] = [Self::Svg, Self::Png];

    /// Every format.
    pub const ALL: [Self; 3] = [Self::Svg, Self::Png, Self::Pdf];

    /// Returns the name of a figure's file.
    #[must_use]
    pub fn file_name(self, stem: &str) -> String {
        let extension = match self {
            Self::Svg => "svg",
            Self::Png => "png",
            Self::Pdf => "pdf",
        };
        format!("{stem}.{extension}")
    }

    /// Returns what such a file may replace.
    pub(crate) fn kind(self) -> FileKind {
        match self {
            Self::Svg => FileKind::SVG,
            Self::Png => FileKind::PNG,
            Self::Pdf => FileKind::PDF,
        }
    }
}
