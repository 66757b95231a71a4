//! RGB image in memory: drawn on by plotters, written as a PNG.

use std::io;
use std::path::Path;

use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, IntoDrawingArea};
use plotters::prelude::BitMapBackend;
use support::atomic_file;

use super::{FigureError, load_font};
use crate::Result;

/// Area of an image; x to the right and y down, pixels.
pub type Image<'a> = DrawingArea<BitMapBackend<'a>, Shift>;

/// Draws an image of `size` (width and height, pixels) and writes it as a PNG.
///
/// # Errors
/// [`FigureError`] of `draw`, or when the file cannot be written.
pub fn save_image(
    path: &Path,
    size: (u32, u32),
    draw: impl FnOnce(&Image<'_>) -> Result<()>,
) -> Result<()> {
    let rgb = render(size, draw)?;
    write_png(path, size, &rgb).map_err(|source| FigureError::Write {
        path: path.to_owned(),
        source,
    })
}

/// Pixels of a drawn image, row by row from the top, three bytes each.
///
/// # Errors
/// [`FigureError`] of `draw`.
pub fn render(size: (u32, u32), draw: impl FnOnce(&Image<'_>) -> Result<()>) -> Result<Vec<u8>> {
    load_font()?;
    let mut rgb = vec![0; 3 * size.0 as usize * size.1 as usize];
    draw(&BitMapBackend::with_buffer(&mut rgb, size).into_drawing_area())?;
    Ok(rgb)
}

fn write_png(path: &Path, (width, height): (u32, u32), rgb: &[u8]) -> io::Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(rgb)?;
    writer.finish()?;
    atomic_file::write(path, bytes)
}
