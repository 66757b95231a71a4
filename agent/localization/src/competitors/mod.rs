//! Competitors of PGC in the paper, small, and the floor that a regression has to beat.

mod by_kind;
pub mod diffloc;
mod end_to_end;
mod end_to_end_localizer;
pub mod hypliloc;
mod lightloc;
mod retrieval;
mod sgloc_head;

pub use by_kind::load_competitor;
pub use end_to_end::{EndToEnd, EndToEndConfig, EndToEndKind};
pub use end_to_end_localizer::EndToEndLocalizer;
pub use hypliloc::HypLiLocLocalizer;
pub use lightloc::LightLoc;
pub use retrieval::{DescribedSweep, Retrieval, SweepDatabase};
