//! Pixels to draw on and to write as a PNG, with fonts of their own.

use std::fs::File;
use std::io::{self, BufWriter};
use std::path::Path;

use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::pixelcolor::Rgb888;
use embedded_graphics::prelude::{DrawTarget, Drawable, OriginDimensions, Pixel, Point, Primitive, RgbColor, Size};
use embedded_graphics::primitives::{Line, PrimitiveStyle};
use embedded_graphics::text::Text;

/// Why a picture is not on disk.
#[derive(Debug, thiserror::Error)]
pub enum CanvasError {
    /// The file cannot be created.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// The file cannot be written to its end.
    #[error(transparent)]
    Encode(#[from] png::EncodingError),
}

/// Pixels to draw on; what lies outside is not drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Canvas {
    size: Size,
    pixels: Vec<Rgb888>,
}

impl Canvas {
    /// A canvas of one colour.
    #[must_use]
    pub fn new(size: Size, background: Rgb888) -> Self {
        Self { size, pixels: vec![background; size.width as usize * size.height as usize] }
    }

    /// Writes a PNG.
    ///
    /// # Errors
    /// [`CanvasError`] when the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), CanvasError> {
        let mut encoder = png::Encoder::new(BufWriter::new(File::create(path)?), self.size.width, self.size.height);
        encoder.set_color(png::ColorType::Rgb);
        let mut writer = encoder.write_header()?;
        let rgb: Vec<u8> = self.pixels.iter().flat_map(|pixel| [pixel.r(), pixel.g(), pixel.b()]).collect();
        writer.write_image_data(&rgb)?;
        Ok(writer.finish()?)
    }

    /// Draws a straight line.
    pub fn line(&mut self, from: Point, to: Point, style: PrimitiveStyle<Rgb888>) {
        self.show(Line::new(from, to).into_styled(style));
    }

    /// Writes a line of text whose baseline begins at `at`.
    pub fn text(&mut self, text: &str, at: Point, style: MonoTextStyle<'_, Rgb888>) {
        self.show(Text::new(text, at, style));
    }

    /// Draws anything.
    pub fn show(&mut self, shape: impl Drawable<Color = Rgb888>) {
        let Ok(_) = shape.draw(self);
    }

    /// The colour at a place, if it is on the canvas.
    #[must_use]
    pub fn pixel(&self, at: Point) -> Option<Rgb888> {
        self.index(at).map(|index| self.pixels[index])
    }

    /// Moves a pixel towards `colour`, never away from it: points that overlap must not darken each other.
    pub fn blend(&mut self, at: Point, colour: Rgb888, strength: f32) {
        let Some(index) = self.index(at) else { return };
        let mix = |under: u8, over: u8| (f32::from(under) + (f32::from(over) - f32::from(under)) * strength) as u8;
        let under = self.pixels[index];
        self.pixels[index] =
            Rgb888::new(mix(under.r(), colour.r()), mix(under.g(), colour.g()), mix(under.b(), colour.b()));
    }

    /// Puts a canvas of `factor` times the size into the upper left corner, averaged down.
    pub fn paste_shrunk(&mut self, large: &Self, factor: u32) {
        let shrunk = large.size / factor;
        let count = factor * factor;
        for y in 0..shrunk.height.min(self.size.height) {
            for x in 0..shrunk.width.min(self.size.width) {
                let mut sum = [0_u32; 3];
                for (dx, dy) in (0..factor).flat_map(|dy| (0..factor).map(move |dx| (dx, dy))) {
                    let row = (y * factor + dy) as usize * large.size.width as usize;
                    let pixel = large.pixels[row + (x * factor + dx) as usize];
                    for (sum, part) in sum.iter_mut().zip([pixel.r(), pixel.g(), pixel.b()]) {
                        *sum += u32::from(part);
                    }
                }
                let [r, g, b] = sum.map(|sum| (sum / count) as u8);
                self.pixels[y as usize * self.size.width as usize + x as usize] = Rgb888::new(r, g, b);
            }
        }
    }

    fn index(&self, at: Point) -> Option<usize> {
        let (x, y) = (u32::try_from(at.x).ok()?, u32::try_from(at.y).ok()?);
        (x < self.size.width && y < self.size.height).then(|| y as usize * self.size.width as usize + x as usize)
    }
}

impl OriginDimensions for Canvas {
    fn size(&self) -> Size {
        self.size
    }
}

impl DrawTarget for Canvas {
    type Color = Rgb888;
    type Error = std::convert::Infallible;

    fn draw_iter<I: IntoIterator<Item = Pixel<Rgb888>>>(&mut self, pixels: I) -> Result<(), Self::Error> {
        for Pixel(at, colour) in pixels {
            if let Some(index) = self.index(at) {
                self.pixels[index] = colour;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_outside_is_not_drawn_and_a_shrunk_line_is_grey() {
        let mut large = Canvas::new(Size::new(8, 8), Rgb888::BLACK);
        large.line(Point::new(-5, 2), Point::new(90, 2), PrimitiveStyle::with_stroke(Rgb888::WHITE, 1));
        let mut small = Canvas::new(Size::new(4, 4), Rgb888::BLACK);
        small.paste_shrunk(&large, 2);
        assert_eq!(small.pixel(Point::new(3, 1)), Some(Rgb888::new(127, 127, 127)));
        assert_eq!(small.pixel(Point::new(3, 2)), Some(Rgb888::BLACK));
        assert_eq!((small.pixel(Point::new(4, 0)), small.pixel(Point::new(0, -1))), (None, None));
    }

    #[test]
    fn a_folder_that_is_not_there_is_an_error() {
        let canvas = Canvas::new(Size::new(2, 2), Rgb888::BLACK);
        assert!(matches!(canvas.save(Path::new("/nowhere/picture.png")), Err(CanvasError::Io(_))));
    }
}
