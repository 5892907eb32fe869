//! Pictures of a report as SVG, and as PNG from those.
//!
//! A picture is a white card 400 units wide, which a phone shows whole, or a sheet of several. Colours mean the same on
//! all of them: darker is more, hatched was not visited by the demonstrations, tinted differs from what is known to be right, and a
//! question mark is what the data do not determine.

mod bands;
mod canvas;
mod colour;
mod features;
mod finite;
mod grid;
mod highway;
mod judged;
mod panel;
mod raster;
mod trace;

use super::{Report, ReportError};
pub use bands::comparison;
pub use raster::png;

/// What a picture tells of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Part {
    /// The demonstrations.
    Seen,
    /// What was learned from them.
    Learned,
    /// What is known to be right.
    True,
    /// How the fit went.
    Fit,
    /// Several pictures on one sheet, for a paper or a slide; not repeated on the page.
    Sheet,
}

/// A picture with what is said of it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Picture {
    /// File name without its extension.
    pub name: &'static str,
    /// What it tells of.
    pub part: Part,
    /// A few words.
    pub title: &'static str,
    /// How to read it.
    pub caption: String,
    /// The picture: an SVG document that refers to nothing outside.
    pub svg: String,
}

/// All pictures of a report, in the order in which they are shown.
///
/// # Errors
/// Arrays of the wrong shape, or what the drawing library says.
pub fn all(report: &Report) -> Result<Vec<Picture>, ReportError> {
    report.check()?;
    let mut pictures = grid::pictures(report)?;
    pictures.extend(highway::pictures(report)?);
    if report.grid.is_none() {
        pictures.extend(finite::pictures(report, !report.is_highway())?);
    }
    pictures.extend(features::picture(report)?);
    pictures.extend(judged::pictures(report)?);
    pictures.extend(trace::picture(report)?);
    Ok(pictures)
}
