//! Competitors of PGC in the paper: networks trained end to end.

mod end_to_end;
mod end_to_end_localizer;

pub use end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
pub use end_to_end_localizer::EndToEndLocalizer;
