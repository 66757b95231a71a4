//! Tracking metrics: tracks compared with the true tracks of the same sequences.
//!
//! Objects and tracks are points in the ground plane; a pair matches at a centre distance below 2 m, as in nuScenes.
//! All objects are of one class. Definitions:
//!
//! - [`ClearMot`]: MOTA, MOTP, IDS, FRAG, MT, ML (Bernardin and Stiefelhagen 2008), equal to `motmetrics`.
//! - [`Amota`]: AMOTA and AMOTP over 40 recall values (Weng et al. 2020), equal to `nuscenes-devkit`.
//! - [`Hota`]: HOTA, DetA, AssA (Luiten et al. 2021), equal to `trackeval`.
//! - [`IdentityCounts`]: IDF1 (Ristani et al. 2016), equal to `trackeval` and `motmetrics`.
//! - [`TrackQuality`]: all of them, as tables show them.

mod amota;
mod clear_mot;
mod hota;
mod identity;
mod quality;
mod sequence;

pub use amota::{Amota, OperatingPoint};
pub use clear_mot::ClearMot;
pub use hota::Hota;
pub use identity::IdentityCounts;
pub use quality::TrackQuality;
pub use sequence::{DuplicateId, Sequence, TrackPoint, TrackedFrame, TruePoint};

/// Centre distance in the plane below which a track matches an object, metres.
pub const MATCH_DISTANCE_M: f64 = 2.0;
