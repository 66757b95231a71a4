//! Figures: charts and drawings of reports, as PNG and SVG.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod canvas;
pub mod chart;
pub mod chart_svg;
