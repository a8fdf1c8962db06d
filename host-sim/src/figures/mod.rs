//! Figures of a run: errors, broadcasts and states; and of a study: error against broadcasts. As SVG and
//! PNG.
//!
//! The SVG is the only source; the PNG is rendered from it with an embedded typeface, so both look
//! the same on every machine. The same data give the same bytes.
//!
//! Networks of up to eight agents are drawn line by line; larger ones as median, 5th to 95th
//! percentile, and minimum to maximum over the agents.

mod axis;
mod canvas;
mod clip;
mod error_norms;
mod event_figure;
mod event_map;
mod events;
mod font;
mod frontier;
#[cfg(test)]
mod label_tests;
mod logarithmic;
mod marks;
mod palette;
mod panel;
mod raster;
mod series;
mod states;
#[cfg(test)]
mod tests;
mod tradeoff;

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::files::output::{FileKind, OutputError, write_result};

pub use error_norms::{ErrorFigure, error_axis_limit, error_norms};
pub use event_figure::EventFigure;
pub use events::events;
pub use frontier::{FrontierFigure, FrontierForm, FrontierPoint, frontier};
pub use marks::{Marker, Reference};
pub use raster::{PNG_WIDTH, RenderError};
pub use states::{StateFigure, states};
pub use tradeoff::{TradeoffFigure, TradeoffLine, TradeoffPoint, tradeoff};

/// A finished figure.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Figure {
    svg: String,
}

impl Figure {
    /// Returns the figure as an SVG document.
    #[must_use]
    pub fn svg(&self) -> &str {
        &self.svg
    }

    /// Returns the figure as a PNG file, [`PNG_WIDTH`] pixels wide.
    ///
    /// # Errors
    /// If the renderer rejects the SVG, which would be a bug in this module.
    pub fn png(&self) -> Result<Vec<u8>, RenderError> {
        raster::png(&self.svg)
    }

    /// Writes `stem.svg` and `stem.png` to `folder`; returns their paths.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(&self, folder: &Path, stem: &str) -> Result<[PathBuf; 2], FigureError> {
        let paths = ["svg", "png"].map(|extension| folder.join(format!("{stem}.{extension}")));
        write_result(&paths[0], FileKind::SVG, |file| file.write_all(self.svg.as_bytes()))?;
        let png =
            self.png().map_err(|error| FigureError::Render { path: paths[1].clone(), error })?;
        write_result(&paths[1], FileKind::PNG, |file| file.write_all(&png))?;
        Ok(paths)
    }
}

/// Writes several figures, each with its own stem, in parallel.
///
/// # Errors
/// If a file cannot be written.
pub fn write_all(
    folder: &Path,
    figures: &[(&str, Figure)],
) -> Result<Vec<[PathBuf; 2]>, FigureError> {
    figures.par_iter().map(|(stem, figure)| figure.write(folder, stem)).collect()
}

/// Why a figure could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FigureError {
    /// Why a file could not be written.
    #[error(transparent)]
    Write(#[from] OutputError),
    /// The PNG could not be rendered.
    #[error("{}: {error}; the SVG beside it is complete", path.display())]
    Render {
        /// Path of the PNG.
        path: PathBuf,
        /// The renderer's error.
        error: RenderError,
    },
}
