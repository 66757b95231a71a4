//! The same charts as SVG: sharp at any size, with text that can be searched.

use std::fmt::Write as _;

use embedded_graphics::pixelcolor::{Rgb888, RgbColor};

use crate::chart::{CHART, COLOURS, Chart, MARGIN, Mark, number};

/// Charts side by side as one picture.
#[must_use]
pub fn text(charts: &[Chart]) -> String {
    let (width, height) = (CHART.width * charts.len().max(1) as u32, CHART.height);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" font-family=\"sans-serif\" \
         font-size=\"12\" fill=\"#282c34\">\n<rect width=\"{width}\" height=\"{height}\" fill=\"#fff\"/>\n"
    );
    for (place, chart) in charts.iter().enumerate() {
        write_chart(&mut svg, chart, place as i32 * CHART.width as i32);
    }
    svg + "</svg>\n"
}

// Writing to a string cannot fail.
fn write_chart(svg: &mut String, chart: &Chart, left: i32) {
    let bottom = CHART.height as i32 - MARGIN[3];
    let label = |svg: &mut String, x: f64, y: f64, anchor: &str, text: &str| {
        let _ = writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\">{}</text>", escaped(text));
    };
    let _ = writeln!(
        svg,
        "<text x=\"{}\" y=\"18\" font-size=\"15\" font-weight=\"bold\">{}</text>",
        left + MARGIN[0],
        escaped(&chart.title)
    );
    let (right, low) = (f64::from(left + CHART.width as i32 - MARGIN[2]), f64::from(bottom));
    label(svg, f64::from(left + 8), 36.0, "start", &chart.y.label);
    label(svg, right, low + 38.0, "end", &chart.x.label);
    let ([x_low, x_high], [y_low, y_high]) = (chart.x.range, chart.y.range);
    for x in chart.x.ticks() {
        write_rule(svg, chart, (x, y_low), (x, y_high), left);
        if let Some([x_pixel, y_pixel]) = chart.pixel(x, y_low, left) {
            label(svg, x_pixel, y_pixel + 18.0, "middle", &number(x));
        }
    }
    for y in chart.y.ticks() {
        write_rule(svg, chart, (x_low, y), (x_high, y), left);
        if let Some([x_pixel, y_pixel]) = chart.pixel(x_low, y, left) {
            label(svg, x_pixel - 8.0, y_pixel + 4.0, "end", &number(y));
        }
    }
    let mut row = f64::from(MARGIN[1]) + 16.0;
    for (series, &colour) in chart.series.iter().zip(COLOURS.iter().cycle()) {
        let colour = hex(colour);
        let points: Vec<[f64; 2]> = series.points.iter().filter_map(|&(x, y)| chart.pixel(x, y, left)).collect();
        if series.mark != Mark::Dots {
            let path: Vec<String> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
            let path = path.join(" ");
            let _ = writeln!(svg, "<polyline points=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2\"/>");
        }
        let radius = match series.mark {
            Mark::Line => None,
            Mark::Dots => Some(1.5),
            Mark::LineAndDots => Some(3.5),
        };
        for ([x, y], radius) in points.iter().zip(std::iter::repeat(radius)) {
            if let Some(radius) = radius {
                let _ = writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{radius}\" fill=\"{colour}\"/>");
            }
        }
        let swatch = f64::from(left + MARGIN[0] + 12);
        let top = row - 9.0;
        let _ = writeln!(svg, "<rect x=\"{swatch}\" y=\"{top}\" width=\"10\" height=\"10\" fill=\"{colour}\"/>");
        label(svg, swatch + 16.0, row, "start", &series.name);
        row += 16.0;
    }
}

fn write_rule(svg: &mut String, chart: &Chart, from: (f64, f64), to: (f64, f64), left: i32) {
    if let (Some([x1, y1]), Some([x2, y2])) = (chart.pixel(from.0, from.1, left), chart.pixel(to.0, to.1, left)) {
        let line = format!("<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"#e2e5ea\"/>");
        let _ = writeln!(svg, "{line}");
    }
}

fn hex(colour: Rgb888) -> String {
    format!("#{:02x}{:02x}{:02x}", colour.r(), colour.g(), colour.b())
}

/// Text that means itself inside of markup.
#[must_use]
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chart::{Axis, Series};

    #[test]
    fn a_chart_is_lines_points_and_words() {
        let chart = Chart {
            title: "AP < 1".into(),
            x: Axis::linear("delay", [0.0, 500.0]),
            y: Axis::linear("AP", [0.0, 1.0]),
            series: vec![Series {
                name: "max".into(),
                points: vec![(0.0, 0.9), (500.0, 0.5), (f64::NAN, 0.1)],
                mark: Mark::LineAndDots,
            }],
        };
        let svg = text(&[chart.clone(), chart]);
        assert!(svg.starts_with("<svg") && svg.ends_with("</svg>\n") && svg.contains("AP &lt; 1"));
        assert_eq!((svg.matches("<polyline").count(), svg.matches("<circle").count()), (2, 4));
        assert!(svg.contains("viewBox=\"0 0 1120 440\""));
    }
}
