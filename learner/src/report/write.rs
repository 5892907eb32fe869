//! Writes a report into a directory: `report.html`, and every picture as SVG and PNG.
//!
//! Invariant: a file is whole or not there. Each is written beside its place and renamed into it; the page comes last, so
//! that a page in place has its pictures beside it.

use super::pictures::{self, Picture};
use super::{Report, ReportError, html};
use rayon::prelude::*;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::{Path, PathBuf};

/// What was written.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Written {
    /// The page.
    pub html: PathBuf,
    /// The pictures: SVG and PNG of each, in the order in which they are shown.
    pub pictures: Vec<PathBuf>,
}

/// Draws and writes everything into `directory`, which is made where it is missing; files of the same names are replaced.
///
/// # Errors
/// Arrays of the wrong shape, a picture that cannot be drawn, a file that cannot be written. Nothing is written unless
/// all could be drawn.
pub fn write(report: &Report, directory: &Path) -> Result<Written, ReportError> {
    let drawn = pictures::all(report)?;
    let page = html::render_with(report, &drawn)?;
    let rasters: Vec<Vec<u8>> = drawn.par_iter().map(raster).collect::<Result<_, _>>()?;
    fs::create_dir_all(directory).map_err(|source| ReportError::Write { path: directory.to_owned(), source })?;
    let mut pictures = Vec::new();
    if let Some(frame) = &report.frame_png {
        pictures.push(replace(directory, "frame.png", frame)?);
    }
    for (picture, raster) in drawn.iter().zip(&rasters) {
        pictures.push(replace(directory, &format!("{}.svg", picture.name), picture.svg.as_bytes())?);
        pictures.push(replace(directory, &format!("{}.png", picture.name), raster)?);
    }
    let html = replace(directory, "report.html", page.as_bytes())?;
    Ok(Written { html, pictures })
}

fn raster(picture: &Picture) -> Result<Vec<u8>, ReportError> {
    pictures::png(&picture.svg).map_err(|message| ReportError::Picture { picture: picture.name, message })
}

/// Puts a file in its place in one step.
///
/// # Errors
/// It cannot be written.
pub fn replace(directory: &Path, name: &str, content: &[u8]) -> Result<PathBuf, ReportError> {
    let path = directory.join(name);
    let temporary = directory.join(format!(".{name}.{}.tmp", uuid::Uuid::new_v4()));
    let put = || {
        let mut file = File::create_new(&temporary)?;
        file.write_all(content)?;
        file.sync_all()?;
        fs::rename(&temporary, &path)
    };
    put().map_err(|source| {
        // The error of the write is the one to tell; what is left of the attempt is of no use.
        let _ = fs::remove_file(&temporary);
        ReportError::Write { path: path.clone(), source }
    })?;
    Ok(path)
}
