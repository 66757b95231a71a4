//! Chart with one x and one y axis: series of points as lines and dots.

use plotters::chart::{ChartBuilder, ChartContext, SeriesLabelPosition};
use plotters::coord::Shift;
use plotters::coord::cartesian::Cartesian2d;
use plotters::drawing::{DrawingArea, DrawingAreaErrorKind};
use plotters::element::{Circle, Rectangle};
use plotters::prelude::DrawingBackend;
use plotters::series::LineSeries;
use plotters::style::{Color, IntoFont, RGBColor, TRANSPARENT, TextStyle};

use super::scale::AxisScale;
use super::{FONT, PAPER};
use crate::Result;

const INK: RGBColor = RGBColor(40, 44, 52);
const RULE: RGBColor = RGBColor(226, 229, 234);
/// Colours of the series, by Okabe and Ito with two greys: distinguishable with any colour vision.
const COLOURS: [RGBColor; 8] = [
    RGBColor(0, 114, 178),
    RGBColor(150, 150, 150),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(60, 60, 60),
];
/// Lines of the grid along an axis, at most.
const TICKS: usize = 6;

/// One axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Axis {
    /// Label with its unit.
    pub label: String,
    /// Lower and upper end.
    pub range: [f64; 2],
    /// True if the scale is logarithmic; the range must be above 0 then.
    pub is_logarithmic: bool,
}

/// Drawing style of a series.
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
    /// x and y; a point that is not finite or outside the axes is left out.
    pub points: Vec<(f64, f64)>,
    /// Drawing style.
    pub mark: Mark,
}

/// Chart with one x and one y axis.
#[derive(Debug, Clone, PartialEq)]
pub struct Chart {
    /// Line above the chart.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// Series; later ones are drawn over earlier ones.
    pub series: Vec<Series>,
}

type Context<'a, DB> = ChartContext<'a, DB, Cartesian2d<AxisScale, AxisScale>>;
type Drawn<DB> = Result<(), DrawingAreaErrorKind<<DB as DrawingBackend>::ErrorType>>;

impl Axis {
    /// Linear axis.
    pub fn linear(label: &str, range: [f64; 2]) -> Self {
        Self {
            label: label.into(),
            range,
            is_logarithmic: false,
        }
    }

    /// Logarithmic axis.
    pub fn logarithmic(label: &str, range: [f64; 2]) -> Self {
        Self {
            is_logarithmic: true,
            ..Self::linear(label, range)
        }
    }

    fn scale(&self) -> AxisScale {
        AxisScale::new(self.drawn_range(), self.is_logarithmic)
    }

    /// The range, or a substitute that can be drawn if it is empty or infinite.
    fn drawn_range(&self) -> [f64; 2] {
        let [low, high] = self.range;
        let lowest = match self.is_logarithmic {
            true => f64::MIN_POSITIVE,
            false => f64::MIN,
        };
        let can_be_drawn = low >= lowest && low < high && (high - low).is_finite();
        if can_be_drawn { self.range } else { [0.1, 1.0] }
    }

    /// Position of a value: 0 at the lower end, 1 at the upper.
    fn share(&self, value: f64) -> f64 {
        let [low, high] = self.drawn_range();
        let [low, high, value] = [low, high, value].map(|value| match self.is_logarithmic {
            true => value.ln(),
            false => value,
        });
        (value - low) / (high - low)
    }

    fn contains(&self, value: f64) -> bool {
        (-0.01..=1.01).contains(&self.share(value))
    }
}

impl Series {
    fn points_on<'a>(
        &'a self,
        x: &'a Axis,
        y: &'a Axis,
    ) -> impl Iterator<Item = (f64, f64)> + Clone + 'a {
        let points = self.points.iter().copied();
        points.filter(|point| x.contains(point.0) && y.contains(point.1))
    }
}

impl Chart {
    pub(super) fn draw<DB: DrawingBackend>(&self, area: &DrawingArea<DB, Shift>) -> Result<()> {
        let mut context = ChartBuilder::on(area)
            .margin(12)
            .margin_right(24)
            .caption(&self.title, font(18))
            .x_label_area_size(44)
            .y_label_area_size(60)
            .build_cartesian_2d(self.x.scale(), self.y.scale())?;
        self.draw_grid(&mut context)?;
        for (series, &colour) in self.series.iter().zip(COLOURS.iter().cycle()) {
            self.draw_series(series, colour, &mut context)?;
        }
        Ok(self.draw_legend(&mut context)?)
    }

    fn draw_grid<'a, DB: DrawingBackend + 'a>(&self, context: &mut Context<'a, DB>) -> Drawn<DB> {
        context
            .configure_mesh()
            .x_desc(&self.x.label)
            .y_desc(&self.y.label)
            .x_labels(TICKS)
            .y_labels(TICKS)
            .bold_line_style(RULE)
            .light_line_style(TRANSPARENT)
            .axis_style(INK)
            .axis_desc_style(font(14))
            .label_style(font(13))
            .draw()
    }

    fn draw_series<'a, DB: DrawingBackend + 'a>(
        &self,
        series: &Series,
        colour: RGBColor,
        context: &mut Context<'a, DB>,
    ) -> Drawn<DB> {
        let points = series.points_on(&self.x, &self.y);
        if series.mark != Mark::Dots {
            context.draw_series(LineSeries::new(points.clone(), colour.stroke_width(2)))?;
        }
        // No dots for lines alone, but the empty series still carries the entry of the legend.
        let radius: Option<u32> = match series.mark {
            Mark::Dots => Some(2),
            Mark::LineAndDots => Some(4),
            Mark::Line => None,
        };
        let dots =
            points.flat_map(|at| radius.map(|radius| Circle::new(at, radius, colour.filled())));
        let entry = context.draw_series(dots)?.label(&series.name);
        entry.legend(move |(x, y)| Rectangle::new([(x, y - 5), (x + 10, y + 5)], colour.filled()));
        Ok(())
    }

    fn draw_legend<'a, DB: DrawingBackend + 'a>(&self, context: &mut Context<'a, DB>) -> Drawn<DB> {
        context
            .configure_series_labels()
            .position(self.emptiest_corner())
            .legend_area_size(16)
            .margin(10)
            .background_style(PAPER.mix(0.85))
            .label_font(font(13))
            .draw()
    }

    /// The quarter of the chart with the fewest points.
    fn emptiest_corner(&self) -> SeriesLabelPosition {
        use SeriesLabelPosition::{LowerLeft, LowerRight, UpperLeft, UpperRight};
        let all = self.series.iter();
        let points = all.flat_map(|series| series.points_on(&self.x, &self.y));
        let mut counts = [0_usize; 4];
        for (x, y) in points {
            let (is_right, is_upper) = (self.x.share(x) > 0.5, self.y.share(y) > 0.5);
            counts[usize::from(is_right) + 2 * usize::from(!is_upper)] += 1;
        }
        let corners = [UpperLeft, UpperRight, LowerLeft, LowerRight];
        let counted = corners.into_iter().zip(counts);
        let fewest = counted.min_by_key(|(_, count)| *count);
        fewest.map_or(UpperLeft, |(corner, _)| corner)
    }
}

fn font(pixels: i32) -> TextStyle<'static> {
    (FONT, pixels).into_font().color(&INK)
}
