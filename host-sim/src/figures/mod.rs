//! Figures of a run: errors, broadcasts and states; and of a study: error against broadcasts. As SVG,
//! PNG and PDF.
//!
//! The SVG is the only source; PNG and PDF are made from it with an embedded typeface, so all look
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
mod format;
mod frontier;
#[cfg(test)]
mod label_tests;
mod logarithmic;
mod marks;
mod palette;
mod panel;
mod pdf;
mod raster;
mod render;
mod series;
mod states;
#[cfg(test)]
mod tests;
mod tradeoff;

use std::borrow::Cow;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::files::output::{OutputError, write_result};

pub use error_norms::{ErrorFigure, error_axis_limit, error_norms};
pub use event_figure::EventFigure;
pub use events::events;
pub use format::FigureFormat;
pub use frontier::{FrontierFigure, FrontierForm, FrontierPoint, frontier};
pub use marks::{Marker, Reference};
pub use render::{PNG_WIDTH, RenderError};
pub use states::{StateFigure, states};
pub use tradeoff::{TradeoffFigure, TradeoffLine, TradeoffPoint, tradeoff};

/// Label of an axis with errors against the plant's own state or a reference.
pub const RMSE_LABEL: &str = "largest RMSE of an agent [state unit]";
/// Label of an axis with what stands in for errors where the state is not known.
pub const INNOVATION_LABEL: &str = "largest innovation RMS of an agent [output unit]";

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

    /// Returns the figure as a PDF file of one page, with vector graphics and embedded fonts.
    ///
    /// # Errors
    /// If the renderer rejects the SVG, which would be a bug in this module.
    pub fn pdf(&self) -> Result<Vec<u8>, RenderError> {
        pdf::pdf(&self.svg)
    }

    /// Writes `stem.svg` and so on to `folder`, one file for each format; returns their paths.
    ///
    /// # Errors
    /// If a file cannot be written.
    pub fn write(
        &self,
        folder: &Path,
        stem: &str,
        formats: &[FigureFormat],
    ) -> Result<Vec<PathBuf>, FigureError> {
        formats.iter().map(|format| self.write_as(*format, folder, stem)).collect()
    }

    fn write_as(
        &self,
        format: FigureFormat,
        folder: &Path,
        stem: &str,
    ) -> Result<PathBuf, FigureError> {
        let path = folder.join(format.file_name(stem));
        let bytes = match format {
            FigureFormat::Svg => Ok(Cow::Borrowed(self.svg.as_bytes())),
            FigureFormat::Png => self.png().map(Cow::Owned),
            FigureFormat::Pdf => self.pdf().map(Cow::Owned),
        };
        let bytes = bytes.map_err(|error| FigureError::Render { path: path.clone(), error })?;
        write_result(&path, format.kind(), |file| file.write_all(&bytes))?;
        Ok(path)
    }
}

/// Writes several figures, each with its own stem and in each of the formats, in parallel.
///
/// # Errors
/// If a file cannot be written.
pub fn write_all(
    folder: &Path,
    figures: &[(&str, Figure)],
    formats: &[FigureFormat],
) -> Result<Vec<Vec<PathBuf>>, FigureError> {
    figures.par_iter().map(|(stem, figure)| figure.write(folder, stem, formats)).collect()
}

/// Why a figure could not be written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum FigureError {
    /// Why a file could not be written.
    #[error(transparent)]
    Write(#[from] OutputError),
    /// The PNG or PDF could not be made.
    #[error("{}: {error}; the SVG in the same folder is complete", path.display())]
    Render {
        /// Path of the PNG or PDF.
        path: PathBuf,
        /// The renderer's error.
        error: RenderError,
    },
}
