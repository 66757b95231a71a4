//! Figures: line and point charts and drawn images, as PNG and SVG, by `plotters`.
//!
//! ```
//! use figures::{Axis, Chart, Mark, Series, svg};
//!
//! # fn main() -> Result<(), figures::FigureError> {
//! let chart = Chart {
//!     title: "AP over latency".into(),
//!     x: Axis::linear("latency, ms", [0.0, 500.0]),
//!     y: Axis::linear("AP@0.5", [0.0, 1.0]),
//!     series: vec![Series { name: "max".into(), points: vec![(0.0, 0.9), (500.0, 0.6)], mark: Mark::LineAndDots }],
//! };
//! assert!(svg(&[chart])?.contains("AP over latency"));
//! # Ok(())
//! # }
//! ```

mod chart;
mod scale;

use std::io;
use std::path::{Path, PathBuf};

use plotters::coord::Shift;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind, IntoDrawingArea};
use plotters::prelude::{BitMapBackend, DrawingBackend, SVGBackend};
use plotters::style::{FontStyle, RGBColor, register_font};
use support::atomic_file;

pub use chart::{Axis, Chart, Mark, Series};

/// The only font: DejaVu Sans in images; the viewer's own font in SVG.
pub const FONT: &str = "sans-serif";
/// Width and height of one chart, pixels.
const CHART: (u32, u32) = (560, 440);
const PAPER: RGBColor = RGBColor(255, 255, 255);

/// Result of drawing or writing a figure: a [`FigureError`] if nothing else is named.
pub type Result<T, E = FigureError> = std::result::Result<T, E>;

/// Area of an image; x to the right and y down, pixels.
pub type Image<'a> = DrawingArea<BitMapBackend<'a>, Shift>;

/// Error of drawing or writing a figure.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    /// The file cannot be written.
    #[error("{}: {source}", path.display())]
    Write {
        /// Path of the file.
        path: PathBuf,
        /// Error of the operating system.
        source: io::Error,
    },
    /// A shape or a text cannot be drawn.
    #[error("cannot draw: {0}")]
    Draw(String),
}

impl<E: std::error::Error + Send + Sync> From<DrawingAreaErrorKind<E>> for FigureError {
    fn from(error: DrawingAreaErrorKind<E>) -> Self {
        Self::Draw(error.to_string())
    }
}

/// Writes charts side by side into one PNG.
///
/// # Errors
/// [`FigureError`] when the file cannot be written.
pub fn save_png(charts: &[Chart], path: &Path) -> Result<(), FigureError> {
    save_image(path, size(charts), |image| draw(charts, image))
}

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

/// Charts side by side as the text of an SVG: sharp at any size, with text that can be searched.
///
/// # Errors
/// [`FigureError::Draw`] when a chart cannot be drawn.
pub fn svg(charts: &[Chart]) -> Result<String, FigureError> {
    load_font()?;
    let mut text = String::new();
    let backend = SVGBackend::with_string(&mut text, size(charts));
    draw(charts, &backend.into_drawing_area())?;
    Ok(text)
}

fn size(charts: &[Chart]) -> (u32, u32) {
    (CHART.0 * charts.len().max(1) as u32, CHART.1)
}

fn draw<DB: DrawingBackend>(
    charts: &[Chart],
    area: &DrawingArea<DB, Shift>,
) -> Result<(), FigureError> {
    area.fill(&PAPER)?;
    let parts = area.split_evenly((1, charts.len().max(1)));
    for (chart, part) in charts.iter().zip(&parts) {
        chart.draw(part)?;
    }
    Ok(area.present()?)
}

/// Registers the font with plotters, which has none of its own.
fn load_font() -> Result<(), FigureError> {
    register_font(FONT, FontStyle::Normal, dejavu::sans::regular())
        .map_err(|_| FigureError::Draw("the font is not readable".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        let points = vec![
            (0.0, 0.1),
            (0.5, 1.0),
            (1.0, 10.0),
            (f64::NAN, 1.0),
            (0.5, f64::INFINITY),
            (7.0, 1.0),
        ];
        Chart {
            title: "error < 1".into(),
            x: Axis::linear("sigma", [0.0, 1.0]),
            y: Axis::logarithmic("metres", [0.01, 100.0]),
            series: vec![Series {
                name: "sweeps".into(),
                points,
                mark: Mark::LineAndDots,
            }],
        }
    }

    #[test]
    fn an_svg_shows_finite_points_within_the_axes_and_words() {
        let text = svg(&[chart(), chart()]).unwrap();
        assert!(
            text.contains("width=\"1120\" height=\"440\"") && text.contains("error &lt; 1"),
            "{text}"
        );
        // One line with three points and three dots for each chart.
        assert_eq!(text.matches("<circle").count(), 2 * 3, "{text}");
        for word in ["sweeps", "sigma", "metres", "0.01", "100"] {
            assert!(text.contains(&format!("\n{word}\n")), "{word}: {text}");
        }
    }

    #[test]
    fn a_png_has_the_size_of_its_charts() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("chart.png");
        save_png(&[chart(), chart()], &path).unwrap();
        let reader =
            png::Decoder::new(std::io::BufReader::new(std::fs::File::open(&path).unwrap()));
        let reader = reader.read_info().unwrap();
        assert_eq!((reader.info().width, reader.info().height), (1120, 440));
        let error = save_png(&[], Path::new("/nowhere/chart.png"))
            .unwrap_err()
            .to_string();
        assert!(error.starts_with("/nowhere/chart.png: "), "{error}");
    }

    #[test]
    fn axes_without_extent_are_drawn_all_the_same() {
        for range in [
            [0.0, 0.0],
            [f64::NAN, 1.0],
            [0.0, f64::INFINITY],
            [3.0, 1.0],
        ] {
            let chart = Chart {
                x: Axis::linear("x", range),
                y: Axis::logarithmic("y", range),
                ..chart()
            };
            assert!(svg(&[chart]).unwrap().contains("</svg>"), "{range:?}");
        }
    }
}
