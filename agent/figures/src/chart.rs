//! Line and point charts as PNG, for results.

use std::path::Path;

use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::mono_font::ascii::{FONT_7X13, FONT_9X15_BOLD};
use embedded_graphics::pixelcolor::Rgb888;
use embedded_graphics::prelude::{Point, Primitive, Size};
use embedded_graphics::primitives::{Circle, PrimitiveStyle, Rectangle};

use crate::canvas::{Canvas, CanvasError};

/// Size of one chart, pixels.
pub(crate) const CHART: Size = Size::new(560, 440);
/// Space around the plotted area: left, top, right, bottom, pixels.
pub(crate) const MARGIN: [i32; 4] = [64, 44, 20, 52];
/// Lines and points are drawn this much larger and averaged down, which smooths their edges.
const OVERSAMPLING: u32 = 3;

const PAPER: Rgb888 = Rgb888::new(255, 255, 255);
const INK: Rgb888 = Rgb888::new(40, 44, 52);
const RULE: Rgb888 = Rgb888::new(226, 229, 234);
/// Colours of the series; told apart by most colour-blind readers.
pub(crate) const COLOURS: [Rgb888; 8] = [
    Rgb888::new(0, 114, 178),
    Rgb888::new(150, 150, 150),
    Rgb888::new(213, 94, 0),
    Rgb888::new(0, 158, 115),
    Rgb888::new(204, 121, 167),
    Rgb888::new(86, 180, 233),
    Rgb888::new(230, 159, 0),
    Rgb888::new(60, 60, 60),
];

/// One axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// What it shows, with its unit.
    pub label: String,
    /// Lower and upper end.
    pub range: [f64; 2],
    /// Whether equal distances are equal ratios; the range must be above 0 then.
    pub is_logarithmic: bool,
}

/// How a series is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// Small dots.
    Dots,
    /// Straight from point to point.
    Line,
    /// Straight from point to point, with the points.
    LineAndDots,
}

/// Values that belong together.
#[derive(Debug, Clone, PartialEq)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// x and y; what is not finite is left out.
    pub points: Vec<(f64, f64)>,
    /// How it is drawn.
    pub mark: Mark,
}

/// A chart with one x and one y axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Line on top.
    pub title: String,
    /// To the right.
    pub x: Axis,
    /// Up.
    pub y: Axis,
    /// What is drawn, later ones over earlier ones.
    pub series: Vec<Series>,
}

impl Axis {
    /// An axis of equal differences.
    #[must_use]
    pub fn linear(label: &str, range: [f64; 2]) -> Self {
        Self { label: label.into(), range, is_logarithmic: false }
    }

    /// An axis of equal ratios.
    #[must_use]
    pub fn logarithmic(label: &str, range: [f64; 2]) -> Self {
        Self { label: label.into(), range, is_logarithmic: true }
    }

    /// Place of a value: 0 at the lower end, 1 at the upper.
    fn share(&self, value: f64) -> f64 {
        let scale = |value: f64| if self.is_logarithmic { value.max(1e-300).ln() } else { value };
        let [low, high] = self.range.map(scale);
        (scale(value) - low) / (high - low)
    }

    /// Where lines and numbers stand.
    pub(crate) fn ticks(&self) -> Vec<f64> {
        let [low, high] = self.range;
        if self.is_logarithmic {
            let decades = low.log10().ceil() as i32..=high.log10().floor() as i32;
            return decades.map(|decade| 10.0_f64.powi(decade)).collect();
        }
        let step = (high - low) / 5.0;
        (0..=5).map(|tick| low + f64::from(tick) * step).collect()
    }
}

/// Writes charts side by side into one PNG.
///
/// # Errors
/// [`CanvasError`] when the file cannot be written.
pub fn save(charts: &[Chart], path: &Path) -> Result<(), CanvasError> {
    draw(charts).save(path)
}

fn draw(charts: &[Chart]) -> Canvas {
    let size = Size::new(CHART.width * charts.len().max(1) as u32, CHART.height);
    let mut large = Canvas::new(size * OVERSAMPLING, PAPER);
    for (place, chart) in charts.iter().enumerate() {
        chart.draw_marks(&mut large, place as i32 * CHART.width as i32);
    }
    let mut canvas = Canvas::new(size, PAPER);
    canvas.paste_shrunk(&large, OVERSAMPLING);
    for (place, chart) in charts.iter().enumerate() {
        chart.draw_texts(&mut canvas, place as i32 * CHART.width as i32);
    }
    canvas
}

impl Chart {
    /// Pixel of a value on the finished picture, for a chart whose left edge is at `left`.
    pub(crate) fn pixel(&self, x: f64, y: f64, left: i32) -> Option<[f64; 2]> {
        let [margin_left, top, right, bottom] = MARGIN.map(f64::from);
        let (width, height) = (f64::from(CHART.width), f64::from(CHART.height));
        let (across, up) = (self.x.share(x), self.y.share(y));
        let inside = |share: f64| (-0.01..=1.01).contains(&share);
        (inside(across) && inside(up)).then(|| {
            let x = f64::from(left) + margin_left + across * (width - margin_left - right);
            [x, height - bottom - up * (height - top - bottom)]
        })
    }

    fn draw_marks(&self, canvas: &mut Canvas, left: i32) {
        let scale = f64::from(OVERSAMPLING);
        let at = |x, y| self.pixel(x, y, left).map(|[x, y]| Point::new((x * scale) as i32, (y * scale) as i32));
        let rule = PrimitiveStyle::with_stroke(RULE, OVERSAMPLING);
        let [x_range, y_range] = [self.x.range, self.y.range];
        let vertical = self.x.ticks().into_iter().map(|x| ((x, y_range[0]), (x, y_range[1])));
        let horizontal = self.y.ticks().into_iter().map(|y| ((x_range[0], y), (x_range[1], y)));
        for (from, to) in vertical.chain(horizontal) {
            if let (Some(from), Some(to)) = (at(from.0, from.1), at(to.0, to.1)) {
                canvas.line(from, to, rule);
            }
        }
        for (series, &colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            let points: Vec<Point> = series.points.iter().filter_map(|&(x, y)| at(x, y)).collect();
            if series.mark != Mark::Dots {
                let style = PrimitiveStyle::with_stroke(colour, 2 * OVERSAMPLING);
                points.windows(2).for_each(|pair| canvas.line(pair[0], pair[1], style));
            }
            let diameter = match series.mark {
                Mark::Line => continue,
                Mark::Dots => 3,
                Mark::LineAndDots => 7,
            };
            for &point in &points {
                let dot = Circle::with_center(point, diameter * OVERSAMPLING);
                canvas.show(dot.into_styled(PrimitiveStyle::with_fill(colour)));
            }
        }
    }

    fn draw_texts(&self, canvas: &mut Canvas, left: i32) {
        let (title, small) = (MonoTextStyle::new(&FONT_9X15_BOLD, INK), MonoTextStyle::new(&FONT_7X13, INK));
        let bottom = CHART.height as i32 - MARGIN[3];
        canvas.text(&self.title, Point::new(left + MARGIN[0], 18), title);
        canvas.text(&self.y.label, Point::new(left + 8, 36), small);
        let label_width = 7 * self.x.label.len() as i32;
        canvas.text(&self.x.label, Point::new(left + CHART.width as i32 - MARGIN[2] - label_width, bottom + 36), small);
        for x in self.x.ticks() {
            let text = number(x);
            let Some([pixel, _]) = self.pixel(x, self.y.range[0], left) else { continue };
            canvas.text(&text, Point::new(pixel as i32 - 7 * text.len() as i32 / 2, bottom + 18), small);
        }
        for y in self.y.ticks() {
            let text = number(y);
            let Some([_, pixel]) = self.pixel(self.x.range[0], y, left) else { continue };
            canvas.text(&text, Point::new(left + MARGIN[0] - 8 - 7 * text.len() as i32, pixel as i32 + 4), small);
        }
        let mut row = MARGIN[1] + 16;
        for (series, &colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            let swatch = Rectangle::new(Point::new(left + MARGIN[0] + 12, row - 9), Size::new(10, 10));
            canvas.show(swatch.into_styled(PrimitiveStyle::with_fill(colour)));
            canvas.text(&series.name, Point::new(left + MARGIN[0] + 28, row), small);
            row += 16;
        }
    }
}

/// A number as short as it can be read.
pub(crate) fn number(value: f64) -> String {
    let rounded = (value * 1000.0).round() / 1000.0;
    format!("{rounded}")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chart() -> Chart {
        let points = vec![(0.0, 0.1), (0.5, 1.0), (1.0, 10.0), (f64::NAN, 1.0), (0.5, f64::INFINITY), (7.0, 1.0)];
        Chart {
            title: "error".into(),
            x: Axis::linear("sigma", [0.0, 1.0]),
            y: Axis::logarithmic("metres", [0.01, 100.0]),
            series: vec![Series { name: "sweeps".into(), points, mark: Mark::LineAndDots }],
        }
    }

    #[test]
    fn values_are_where_their_axes_say() {
        let (chart, canvas) = (chart(), draw(&[chart(), chart()]));
        let [x, y] = chart.pixel(0.5, 1.0, 0).unwrap();
        assert_eq!(canvas.pixel(Point::new(x as i32, y as i32)), Some(COLOURS[0]));
        // The second chart lies beside the first.
        assert_eq!(canvas.pixel(Point::new(x as i32 + CHART.width as i32, y as i32)), Some(COLOURS[0]));
        assert_eq!(chart.pixel(0.5, 1e9, 0), None);
        assert_eq!(chart.y.ticks().len(), 5);
    }

    #[test]
    fn a_chart_is_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("chart.png");
        save(&[chart()], &path).unwrap();
        assert!(std::fs::read(&path).unwrap().starts_with(b"\x89PNG"));
    }
}
