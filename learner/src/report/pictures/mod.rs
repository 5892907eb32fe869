//! Pictures of a report as SVG, and as PNG from those.

mod raster;

pub use raster::png;
