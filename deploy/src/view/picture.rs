//! One fused frame as a PNG, seen from above: points in the colour of the CAV that measured them, truth, detections.

use std::path::{Path, PathBuf};

use embedded_graphics::mono_font::MonoTextStyle;
use embedded_graphics::mono_font::ascii::{FONT_8X13, FONT_10X20};
use embedded_graphics::pixelcolor::Rgb888;
use embedded_graphics::prelude::{OriginDimensions, Point, Primitive, Size};
use embedded_graphics::primitives::{Circle, PrimitiveStyle, Rectangle};
use figures::canvas::{Canvas, CanvasError};
use protocol::{Box3d, Pose};

/// Pixels a metre takes in the finished picture.
const PIXELS_PER_M: f64 = 12.0;
/// Everything but text is drawn this much larger and averaged down, which smooths its edges.
const OVERSAMPLING: u32 = 2;
/// Height of the strip below the map that holds legend and scale, pixels.
const LEGEND_HEIGHT: u32 = 84;
/// A picture is never larger than this, pixels a side: a scene's range comes from outside.
const MAX_SIDE: f64 = 8_192.0;

const BACKGROUND: Rgb888 = Rgb888::new(14, 17, 22);
const GRID: Rgb888 = Rgb888::new(38, 44, 54);
const INK: Rgb888 = Rgb888::new(222, 226, 233);
const FAINT: Rgb888 = Rgb888::new(139, 148, 160);
const TRUTH: Rgb888 = Rgb888::new(63, 206, 120);
const DETECTION: Rgb888 = Rgb888::new(255, 94, 77);
/// Colours of the CAVs, ego first; told apart by most colour-blind readers, and from truth and detections.
const CAV_COLOURS: [Rgb888; 6] = [
    Rgb888::new(120, 190, 255),
    Rgb888::new(255, 200, 87),
    Rgb888::new(205, 140, 255),
    Rgb888::new(94, 222, 224),
    Rgb888::new(255, 150, 200),
    Rgb888::new(190, 190, 190),
];

/// What one CAV measured.
#[derive(Debug, Clone)]
pub struct View<'a> {
    /// Who.
    pub name: String,
    /// Its LiDAR's pose in the ego's LiDAR frame.
    pub ego_from_cav: Pose,
    /// x, y, z, intensity of every point, in its own LiDAR frame, metres.
    pub xyzi: &'a [[f32; 4]],
}

/// One fused frame, in the ego's LiDAR frame.
#[derive(Debug, Clone)]
pub struct Picture<'a> {
    /// Line on top of the legend.
    pub title: String,
    /// Lower and upper x of the map, metres.
    pub x_m: [f64; 2],
    /// Lower and upper y of the map, metres.
    pub y_m: [f64; 2],
    /// Everyone's points; the ego first.
    pub views: Vec<View<'a>>,
    /// What is there.
    pub truth: Vec<Box3d>,
    /// What was found, with its score.
    pub detections: Vec<(Box3d, f32)>,
}

/// Why a picture could not be made.
#[derive(Debug, thiserror::Error)]
pub enum PictureError {
    /// The range is empty or far too large to draw.
    #[error("cannot draw x {x_m:?} m, y {y_m:?} m: a side must be above 0 and below {} m", MAX_SIDE / PIXELS_PER_M)]
    Range {
        /// Lower and upper x, metres.
        x_m: [f64; 2],
        /// Lower and upper y, metres.
        y_m: [f64; 2],
    },
    /// The file cannot be written.
    #[error("cannot write {}: {reason}", path.display())]
    Write {
        /// The picture's file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl Picture<'_> {
    /// Draws the frame into the PNG `path`: x to the right, y up.
    ///
    /// # Errors
    /// [`PictureError`] when the range makes no picture or the file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), PictureError> {
        let failed = |error: CanvasError| PictureError::Write { path: path.into(), reason: error.to_string() };
        self.draw()?.save(path).map_err(failed)
    }

    fn draw(&self) -> Result<Canvas, PictureError> {
        let [width, height] = [self.x_m, self.y_m].map(|[low, high]| ((high - low) * PIXELS_PER_M).ceil());
        if !(1.0..=MAX_SIDE).contains(&width) || !(1.0..=MAX_SIDE).contains(&height) {
            return Err(PictureError::Range { x_m: self.x_m, y_m: self.y_m });
        }
        let map = Size::new(width as u32, height as u32);
        let mut large = Canvas::new(map * OVERSAMPLING, BACKGROUND);
        self.draw_grid(&mut large);
        // The ego last, so that its points lie on top.
        for (index, view) in self.views.iter().enumerate().rev() {
            self.draw_points(view, CAV_COLOURS[index % CAV_COLOURS.len()], &mut large);
        }
        for truth in &self.truth {
            self.draw_box(truth, TRUTH, 3, &mut large);
        }
        for (found, _) in &self.detections {
            self.draw_box(found, DETECTION, 3, &mut large);
        }
        for (index, view) in self.views.iter().enumerate() {
            self.draw_position(view, CAV_COLOURS[index % CAV_COLOURS.len()], &mut large);
        }
        let mut canvas = Canvas::new(Size::new(map.width.max(760), map.height + LEGEND_HEIGHT), BACKGROUND);
        canvas.paste_shrunk(&large, OVERSAMPLING);
        for (found, score) in &self.detections {
            let at = self.pixel(found.center_m[0], found.center_m[1], 1) + Point::new(10, -8);
            canvas.text(&format!("{score:.2}"), at, MonoTextStyle::new(&FONT_8X13, DETECTION));
        }
        self.draw_legend(&mut canvas, map.height as i32);
        Ok(canvas)
    }

    /// Where a point of the ego frame lies on a canvas drawn `scale` times larger than the picture.
    fn pixel(&self, x: f64, y: f64, scale: u32) -> Point {
        let pixels_per_m = PIXELS_PER_M * f64::from(scale);
        // Far outside the canvas is outside, however far, and leaves room to add offsets.
        let place = |metres: f64| (metres * pixels_per_m).clamp(-1e6, 1e6) as i32;
        Point::new(place(x - self.x_m[0]), place(self.y_m[1] - y))
    }

    fn draw_grid(&self, canvas: &mut Canvas) {
        let style = PrimitiveStyle::with_stroke(GRID, 1);
        let tens = |[low, high]: [f64; 2]| {
            ((low / 10.0).ceil() as i64..=(high / 10.0).floor() as i64).map(|ten| 10.0 * ten as f64)
        };
        for x in tens(self.x_m) {
            canvas.line(self.pixel(x, self.y_m[0], OVERSAMPLING), self.pixel(x, self.y_m[1], OVERSAMPLING), style);
        }
        for y in tens(self.y_m) {
            canvas.line(self.pixel(self.x_m[0], y, OVERSAMPLING), self.pixel(self.x_m[1], y, OVERSAMPLING), style);
        }
    }

    fn draw_points(&self, view: &View<'_>, colour: Rgb888, canvas: &mut Canvas) {
        let ego_from_cav = view.ego_from_cav.isometry();
        for &[x, y, z, _] in view.xyzi {
            let point = ego_from_cav * nalgebra::Point3::new(f64::from(x), f64::from(y), f64::from(z));
            if !point.iter().all(|coordinate| coordinate.is_finite()) {
                continue;
            }
            let at = self.pixel(point.x, point.y, OVERSAMPLING);
            // The ground (about 1.9 m below the LiDAR) only hints at the road; what stands on it is bright.
            let strength = if point.z < -1.5 { 0.3 } else { 0.85 };
            for offset in [Point::new(0, 0), Point::new(1, 0), Point::new(0, 1), Point::new(1, 1)] {
                canvas.blend(at + offset, colour, strength);
            }
        }
    }

    fn draw_box(&self, shape: &Box3d, colour: Rgb888, stroke: u32, canvas: &mut Canvas) {
        let style = PrimitiveStyle::with_stroke(colour, stroke);
        let corners = shape.corners();
        let at = |index: usize| self.pixel(corners[index][0], corners[index][1], OVERSAMPLING);
        for side in 0..4 {
            canvas.line(at(side), at((side + 1) % 4), style);
        }
        // A stroke from the centre to the front says which way it faces.
        let front = [0, 1].map(|axis| (corners[0][axis] + corners[1][axis]) / 2.0);
        canvas.line(
            self.pixel(shape.center_m[0], shape.center_m[1], OVERSAMPLING),
            self.pixel(front[0], front[1], OVERSAMPLING),
            style,
        );
    }

    fn draw_position(&self, view: &View<'_>, colour: Rgb888, canvas: &mut Canvas) {
        let [x, y, _] = view.ego_from_cav.translation_m;
        let spot = Circle::with_center(self.pixel(x, y, OVERSAMPLING), 9 * OVERSAMPLING);
        canvas.show(spot.into_styled(PrimitiveStyle::with_fill(colour)));
        canvas.show(spot.into_styled(PrimitiveStyle::with_stroke(BACKGROUND, 2 * OVERSAMPLING)));
    }

    fn draw_legend(&self, canvas: &mut Canvas, top: i32) {
        let (large, small) = (MonoTextStyle::new(&FONT_10X20, INK), MonoTextStyle::new(&FONT_8X13, FAINT));
        canvas.line(
            Point::new(0, top),
            Point::new(canvas.size().width as i32, top),
            PrimitiveStyle::with_stroke(GRID, 2),
        );
        canvas.text(&self.title, Point::new(14, top + 24), large);
        let mut x = 14;
        let row = top + 50;
        for (label, colour, boxed) in self.legend() {
            let swatch = Rectangle::new(Point::new(x, row - 10), Size::new(12, 12));
            let style = if boxed { PrimitiveStyle::with_stroke(colour, 2) } else { PrimitiveStyle::with_fill(colour) };
            canvas.show(swatch.into_styled(style));
            canvas.text(&label, Point::new(x + 18, row), MonoTextStyle::new(&FONT_8X13, INK));
            x += 18 + 8 * label.len() as i32 + 22;
        }
        let (left, right, bar) = (14, 14 + (10.0 * PIXELS_PER_M) as i32, top + 70);
        let ink = PrimitiveStyle::with_stroke(FAINT, 2);
        canvas.line(Point::new(left, bar), Point::new(right, bar), ink);
        canvas.line(Point::new(left, bar - 4), Point::new(left, bar + 4), ink);
        canvas.line(Point::new(right, bar - 4), Point::new(right, bar + 4), ink);
        canvas.text("10 m   x to the right, y up, ego LiDAR frame", Point::new(right + 10, bar + 4), small);
    }

    fn legend(&self) -> Vec<(String, Rgb888, bool)> {
        let cavs = self.views.iter().zip(CAV_COLOURS.iter().cycle()).enumerate();
        let mut entries: Vec<_> = cavs
            .map(|(index, (view, &colour))| {
                let role = if index == 0 { "ego" } else { "CAV" };
                (format!("{role} {}", view.name), colour, false)
            })
            .collect();
        entries.push((format!("truth ({})", self.truth.len()), TRUTH, true));
        entries.push((format!("detected ({})", self.detections.len()), DETECTION, true));
        entries
    }
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use embedded_graphics::prelude::RgbColor;

    use super::*;

    fn car(x: f64, y: f64) -> Box3d {
        Box3d { center_m: [x, y, -1.0], size_m: [4.0, 2.0, 1.5], heading_rad: 0.0 }
    }

    fn picture<'a>(xyzi: &'a [[f32; 4]]) -> Picture<'a> {
        Picture {
            title: "tick 7".into(),
            x_m: [-40.0, 40.0],
            y_m: [-20.0, 20.0],
            views: vec![View { name: "4279".into(), ego_from_cav: Pose::IDENTITY, xyzi }],
            truth: vec![car(20.0, 10.0)],
            detections: vec![(car(-20.0, -10.0), 0.9)],
        }
    }

    fn colour_at(canvas: &Canvas, picture: &Picture<'_>, x: f64, y: f64) -> Rgb888 {
        canvas.pixel(picture.pixel(x, y, 1)).unwrap()
    }

    #[test]
    fn everything_is_drawn_where_it_is() {
        let points = [[5.0, 5.0, 0.0, 0.5]; 4];
        let picture = picture(&points);
        let canvas = picture.draw().unwrap();
        let near = |colour: Rgb888, wanted: Rgb888| {
            [colour.r().abs_diff(wanted.r()), colour.g().abs_diff(wanted.g()), colour.b().abs_diff(wanted.b())]
                .into_iter()
                .all(|difference| difference < 40)
        };
        assert!(near(colour_at(&canvas, &picture, 5.0, 5.0), CAV_COLOURS[0]));
        assert!(near(colour_at(&canvas, &picture, 20.0, 11.0), TRUTH), "left side of the true box");
        assert!(near(colour_at(&canvas, &picture, -18.0, -10.5), DETECTION), "front of the detection");
        assert!(near(colour_at(&canvas, &picture, 33.0, -13.0), BACKGROUND));
    }

    #[test]
    fn a_saved_picture_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("frame.png");
        picture(&[]).save(&file).unwrap();
        let mut reader = png::Decoder::new(std::io::BufReader::new(File::open(&file).unwrap())).read_info().unwrap();
        let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut pixels).unwrap();
        assert_eq!((reader.info().width, reader.info().height), (960, 480 + LEGEND_HEIGHT));
        let green = pixels.chunks(3).filter(|rgb| *rgb == [TRUTH.r(), TRUTH.g(), TRUTH.b()]).count();
        assert!(green > 50, "{green}");
    }

    #[test]
    fn points_that_are_nowhere_are_left_out() {
        let points = [[f32::NAN, 0.0, 0.0, 0.0], [f32::INFINITY, 3e9, 0.0, 0.0], [1e30, -1e30, 0.0, 0.0]];
        assert!(picture(&points).draw().unwrap() == picture(&[]).draw().unwrap());
    }

    #[test]
    fn a_range_that_makes_no_picture_is_refused() {
        for x_m in [[0.0, 0.0], [0.0, 1e9], [0.0, f64::NAN]] {
            let error = Picture { x_m, ..picture(&[]) }.draw().err().unwrap();
            assert!(error.to_string().starts_with("cannot draw x"), "{error}");
        }
    }
}
