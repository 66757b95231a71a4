//! One fused frame as a PNG, seen from above: points in the colour of the CAV that measured them, truth, detections.

use std::path::Path;

use figures::{self, FONT, FigureError, Image, Result};
use plotters::coord::cartesian::Cartesian2d;
use plotters::coord::types::RangedCoordf64;
use plotters::drawing::DrawingArea;
use plotters::element::{Circle, EmptyElement, PathElement, Rectangle, Text};
use plotters::prelude::BitMapBackend;
use plotters::style::{Color, IntoFont, RGBColor, ShapeStyle, TextStyle};
use protocol::{Box3d, Pose};

/// Scale of the finished picture, pixels per metre.
const PIXELS_PER_M: f64 = 12.0;
/// Height of the strip below the plan view that holds legend and scale, pixels.
const LEGEND_HEIGHT: u32 = 84;
/// Narrowest picture, pixels: the legend needs as much.
const MIN_WIDTH: u32 = 760;
/// Largest side of a picture, pixels: the range of a scene is external input.
const MAX_SIDE: f64 = 8_192.0;
/// Largest distance of a drawn box's corners from the plan view, metres.
const BOX_MARGIN_M: f64 = 50.0;
/// Width and height of a written score, pixels.
const SCORE_SIZE: [f64; 2] = [34.0, 16.0];
/// Height in the LiDAR's frame below which points are ground (about 1.9 m below the LiDAR), metres.
const GROUND_Z_M: f64 = -1.5;

const BACKGROUND: RGBColor = RGBColor(14, 17, 22);
const GRID: RGBColor = RGBColor(38, 44, 54);
const INK: RGBColor = RGBColor(222, 226, 233);
const FAINT: RGBColor = RGBColor(139, 148, 160);
/// Truth is light and detections are red: distinguishable with any colour vision.
const TRUTH: RGBColor = RGBColor(240, 240, 240);
const DETECTION: RGBColor = RGBColor(255, 94, 77);
/// Colours of the CAVs, ego first; distinct from each other, and from truth and detections.
const CAV_COLOURS: [RGBColor; 6] = [
    RGBColor(120, 190, 255),
    RGBColor(255, 200, 87),
    RGBColor(205, 140, 255),
    RGBColor(94, 222, 224),
    RGBColor(255, 150, 200),
    RGBColor(160, 160, 160),
];

/// The plan view: metres in the ego's LiDAR frame, x to the right and y up.
type PlanView<'a> = DrawingArea<BitMapBackend<'a>, Cartesian2d<RangedCoordf64, RangedCoordf64>>;

/// Point cloud of one CAV.
#[derive(Debug, Clone)]
pub(crate) struct CavView<'a> {
    /// Name of the CAV.
    pub name: String,
    /// Its LiDAR's pose in the ego's LiDAR frame.
    pub ego_from_cav: Pose,
    /// x, y, z, intensity of every point, in its own LiDAR frame, metres.
    pub xyzi: &'a [[f32; 4]],
}

/// One fused frame, in the ego's LiDAR frame.
#[derive(Debug, Clone)]
pub(crate) struct Picture<'a> {
    /// Line on top of the legend.
    pub title: String,
    /// Lower and upper x of the plan view, metres.
    pub x_m: [f64; 2],
    /// Lower and upper y of the plan view, metres.
    pub y_m: [f64; 2],
    /// Point clouds of all CAVs; the ego first.
    pub views: Vec<CavView<'a>>,
    /// True boxes.
    pub truth: Vec<Box3d>,
    /// Detected boxes, with their scores, 0..1.
    pub detections: Vec<(Box3d, f32)>,
}

impl Picture<'_> {
    /// Draws the frame into the PNG `path`: x to the right, y up.
    ///
    /// # Errors
    /// [`FigureError`] when the range makes no picture or the file cannot be written.
    pub(crate) fn save(&self, path: &Path) -> Result<()> {
        let map = self.map_size()?;
        figures::save_image(path, picture_size(map), |image| self.draw(map, image))
    }

    /// Width and height of the plan view, pixels.
    fn map_size(&self) -> Result<(u32, u32)> {
        let sides = [self.x_m, self.y_m].map(|[low, high]| ((high - low) * PIXELS_PER_M).ceil());
        if sides.iter().all(|side| (1.0..=MAX_SIDE).contains(side)) {
            Ok((sides[0] as u32, sides[1] as u32))
        } else {
            Err(FigureError::Draw(format!(
                "x {:?} m, y {:?} m: a side must be above 0 and below {} m",
                self.x_m,
                self.y_m,
                MAX_SIDE / PIXELS_PER_M
            )))
        }
    }

    fn draw(&self, (width, height): (u32, u32), image: &Image<'_>) -> Result<()> {
        image.fill(&BACKGROUND)?;
        let (map, legend) = image.split_vertically(height);
        let (x, y) = (self.x_m[0]..self.x_m[1], self.y_m[0]..self.y_m[1]);
        // Rows of pixels count downwards, so the range of the y axis is reversed.
        let plane =
            map.apply_coord_spec(Cartesian2d::new(x, y, (0..width as i32, height as i32..0)));
        // A line every 10 m.
        for x in tens(self.x_m) {
            plane.draw(&PathElement::new(self.y_m.map(|y| (x, y)), GRID))?;
        }
        for y in tens(self.y_m) {
            plane.draw(&PathElement::new(self.x_m.map(|x| (x, y)), GRID))?;
        }
        // The ego last, so that its points are on top.
        for (view, colour) in self.coloured_views().rev() {
            let ego_from_cav = view.ego_from_cav.isometry();
            for &[x, y, z, _] in view.xyzi {
                let point =
                    ego_from_cav * nalgebra::Point3::new(f64::from(x), f64::from(y), f64::from(z));
                // The ground only indicates the road; objects on it are bright.
                let opacity = if point.z < GROUND_Z_M { 0.3 } else { 0.85 };
                if self.is_near(point.x, point.y, 0.0) {
                    plane.draw_pixel((point.x, point.y), &colour.mix(opacity))?;
                }
            }
        }
        for truth in &self.truth {
            self.draw_box(truth, TRUTH, &plane)?;
        }
        for (found, _) in &self.detections {
            self.draw_box(found, DETECTION, &plane)?;
        }
        for (found, score) in self.labelled() {
            let [x, y, _] = found.center_m;
            if self.is_near(x, y, 0.0) {
                // Pixels, with y downwards: to the right of the centre and above it.
                let text = Text::new(format!("{score:.2}"), (10, -20), text(14, DETECTION));
                plane.draw(&(EmptyElement::at((x, y)) + text))?;
            }
        }
        for (view, colour) in self.coloured_views() {
            let [x, y, _] = view.ego_from_cav.translation_m;
            if self.is_near(x, y, 0.0) {
                plane.draw(&Circle::new((x, y), 6, BACKGROUND.filled()))?;
                plane.draw(&Circle::new((x, y), 4, colour.filled()))?;
            }
        }
        self.draw_legend(&legend)
    }

    fn coloured_views(&self) -> impl DoubleEndedIterator<Item = (&CavView<'_>, RGBColor)> {
        let views = self.views.iter().enumerate();
        views.map(|(index, view)| (view, CAV_COLOURS[index % CAV_COLOURS.len()]))
    }

    /// True if a point is on the plan view or at most `margin_m` outside it.
    fn is_near(&self, x: f64, y: f64, margin_m: f64) -> bool {
        [(self.x_m, x), (self.y_m, y)]
            .into_iter()
            .all(|([low, high], value)| (low - margin_m..=high + margin_m).contains(&value))
    }

    /// The outline, with a stroke from the centre to the front.
    fn draw_box(&self, shape: &Box3d, colour: RGBColor, plane: &PlanView<'_>) -> Result<()> {
        let corners = shape.corners();
        let mut places = corners.iter();
        if !places.all(|[x, y, _]| self.is_near(*x, *y, BOX_MARGIN_M)) {
            return Ok(());
        }
        // Corners 0 to 3 are the bottom face, and 0 and 1 its front edge.
        let outline = [0, 1, 2, 3, 0].map(|index: usize| (corners[index][0], corners[index][1]));
        plane.draw(&PathElement::new(outline, stroke(colour)))?;
        let front = [0, 1].map(|axis| (corners[0][axis] + corners[1][axis]) / 2.0);
        let [x, y, _] = shape.center_m;
        let ahead = [(x, y), (front[0], front[1])];
        Ok(plane.draw(&PathElement::new(ahead, stroke(colour)))?)
    }

    /// Detections whose score is written: the highest ones first, and none over another.
    fn labelled(&self) -> Vec<(&Box3d, f32)> {
        let scored = self.detections.iter().map(|(found, score)| (found, *score));
        let mut by_score: Vec<_> = scored.collect();
        by_score.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let mut labelled: Vec<(&Box3d, f32)> = Vec::new();
        for (found, score) in by_score {
            let [x, y, _] = found.center_m;
            let is_covered = labelled.iter().any(|(other, _)| {
                let [across, up] = [other.center_m[0] - x, other.center_m[1] - y].map(f64::abs);
                across * PIXELS_PER_M < SCORE_SIZE[0] && up * PIXELS_PER_M < SCORE_SIZE[1]
            });
            if !is_covered {
                labelled.push((found, score));
            }
        }
        labelled
    }

    fn draw_legend(&self, area: &Image<'_>) -> Result<()> {
        let right = area.dim_in_pixel().0 as i32;
        area.draw(&PathElement::new([(0, 0), (right, 0)], stroke(GRID)))?;
        area.draw(&Text::new(self.title.as_str(), (14, 8), text(18, INK)))?;
        let mut x = 14;
        for (label, colour, is_outline) in self.legend() {
            let style = match is_outline {
                true => stroke(colour),
                false => colour.filled(),
            };
            area.draw(&Rectangle::new([(x, 39), (x + 12, 51)], style))?;
            area.draw(&Text::new(label.as_str(), (x + 18, 38), text(15, INK)))?;
            x += 18 + area.estimate_text_size(&label, &text(15, INK))?.0 as i32 + 22;
        }
        // A bar of 10 m and the axes.
        let (left, right, y) = (14, 14 + (10.0 * PIXELS_PER_M) as i32, 68);
        for line in [
            [(left, y), (right, y)],
            [(left, y - 4), (left, y + 4)],
            [(right, y - 4), (right, y + 4)],
        ] {
            area.draw(&PathElement::new(line, stroke(FAINT)))?;
        }
        let text_line = "10 m   x to the right, y up, ego LiDAR frame";
        Ok(area.draw(&Text::new(text_line, (right + 10, y - 8), text(14, FAINT)))?)
    }

    fn legend(&self) -> Vec<(String, RGBColor, bool)> {
        let cavs = self.coloured_views().enumerate();
        let cavs = cavs.map(|(index, (view, colour))| {
            let role = if index == 0 { "ego" } else { "CAV" };
            (format!("{role} {}", view.name), colour, false)
        });
        let truth = (format!("truth ({})", self.truth.len()), TRUTH, true);
        let found = self.detections.len();
        let detected = (format!("detected ({found})"), DETECTION, true);
        cavs.chain([truth, detected]).collect()
    }
}

fn picture_size((width, height): (u32, u32)) -> (u32, u32) {
    (width.max(MIN_WIDTH), height + LEGEND_HEIGHT)
}

fn stroke(colour: RGBColor) -> ShapeStyle {
    colour.stroke_width(2)
}

fn text(pixels: i32, colour: RGBColor) -> TextStyle<'static> {
    (FONT, pixels).into_font().color(&colour)
}

/// Multiples of 10 in a range.
fn tens([low, high]: [f64; 2]) -> impl Iterator<Item = f64> {
    ((low / 10.0).ceil() as i64..=(high / 10.0).floor() as i64).map(|ten| 10.0 * ten as f64)
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;

    fn car(x: f64, y: f64) -> Box3d {
        Box3d {
            center_m: [x, y, -1.0],
            size_m: [4.0, 2.0, 1.5],
            heading_rad: 0.0,
        }
    }

    fn picture<'a>(xyzi: &'a [[f32; 4]]) -> Picture<'a> {
        Picture {
            title: "tick 7".into(),
            x_m: [-40.0, 40.0],
            y_m: [-20.0, 20.0],
            views: vec![CavView {
                name: "4279".into(),
                ego_from_cav: Pose::IDENTITY,
                xyzi,
            }],
            truth: vec![car(20.0, 10.0)],
            detections: vec![(car(-20.0, -10.0), 0.9)],
        }
    }

    fn pixels(picture: &Picture<'_>) -> Vec<u8> {
        let map = picture.map_size().unwrap();
        figures::render(picture_size(map), |image| picture.draw(map, image)).unwrap()
    }

    /// True if a pixel within one of the position has about this colour.
    fn shows(pixels: &[u8], [x, y]: [f64; 2], colour: RGBColor) -> bool {
        let (column, row) = (
            (PIXELS_PER_M * (x + 40.0)) as usize,
            (PIXELS_PER_M * (20.0 - y)) as usize,
        );
        let wanted = [colour.0, colour.1, colour.2];
        let mut around = (row - 1..=row + 1)
            .flat_map(|row| (column - 1..=column + 1).map(move |column| 960 * row + column));
        around.any(|place| {
            pixels[3 * place..]
                .iter()
                .zip(wanted)
                .all(|(found, wanted)| found.abs_diff(wanted) < 40)
        })
    }

    #[test]
    fn everything_is_drawn_where_it_is() {
        let points = [[5.0, 5.0, 0.0, 0.5]; 4];
        let pixels = pixels(&picture(&points));
        assert!(shows(&pixels, [5.0, 5.0], CAV_COLOURS[0]));
        assert!(
            shows(&pixels, [20.0, 11.0], TRUTH),
            "left side of the true box"
        );
        assert!(
            shows(&pixels, [-18.0, -10.5], DETECTION),
            "front of the detection"
        );
        assert!(shows(&pixels, [33.0, -13.0], BACKGROUND));
    }

    #[test]
    fn of_detections_upon_each_other_the_highest_score_is_written() {
        let detections = vec![
            (car(0.0, 0.0), 0.3),
            (car(1.0, 0.5), 0.9),
            (car(10.0, 0.0), 0.2),
        ];
        let picture = Picture {
            detections,
            ..picture(&[])
        };
        assert_eq!(
            picture
                .labelled()
                .iter()
                .map(|(_, score)| *score)
                .collect::<Vec<_>>(),
            [0.9, 0.2]
        );
    }

    #[test]
    fn a_saved_picture_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("frame.png");
        let picture = picture(&[]);
        picture.save(&file).unwrap();
        let mut reader = png::Decoder::new(std::io::BufReader::new(File::open(&file).unwrap()))
            .read_info()
            .unwrap();
        let mut read = vec![0; reader.output_buffer_size().unwrap()];
        reader.next_frame(&mut read).unwrap();
        assert_eq!(
            (reader.info().width, reader.info().height),
            (960, 480 + LEGEND_HEIGHT)
        );
        assert!(read == pixels(&picture));
    }

    #[test]
    fn points_and_boxes_that_are_nowhere_are_left_out() {
        let points = [
            [f32::NAN, 0.0, 0.0, 0.0],
            [f32::INFINITY, 3e9, 0.0, 0.0],
            [1e30, -1e30, 0.0, 0.0],
        ];
        let mut far = picture(&points);
        far.views.push(CavView {
            name: "far".into(),
            ..far.views[0].clone()
        });
        far.views[1].ego_from_cav.translation_m = [1e30, f64::NAN, 0.0];
        let mut near = picture(&[]);
        near.views.push(CavView {
            xyzi: &[],
            ego_from_cav: Pose::IDENTITY,
            ..far.views[1].clone()
        });
        near.views[1].ego_from_cav.translation_m = [500.0, 0.0, 0.0];
        let endless = Box3d {
            size_m: [f64::INFINITY, 2.0, 1.5],
            ..car(0.0, 0.0)
        };
        far.truth = vec![endless, car(1e30, 0.0)];
        near.truth = vec![car(500.0, 0.0), car(0.0, 500.0)];
        assert!(pixels(&far) == pixels(&near));
    }

    #[test]
    fn a_range_that_makes_no_picture_is_refused() {
        for x_m in [[0.0, 0.0], [0.0, 1e9], [0.0, f64::NAN]] {
            let error = Picture {
                x_m,
                ..picture(&[])
            }
            .map_size()
            .unwrap_err();
            assert!(error.to_string().starts_with("cannot draw: x"), "{error}");
        }
    }
}
