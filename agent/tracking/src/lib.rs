//! Multi-object tracking: detections of a vehicle get identities and velocities, and the metrics that judge tracks.
//!
//! [`Tracker`] follows objects in the ground plane of the world (map) frame, so that the motion of the ego does not
//! matter: a constant-velocity Kalman filter for each ([`kalman`]), an optimal assignment of detections to tracks
//! ([`assignment`]), and a probability of existence that hits raise and misses in the area of view lower. It reports them
//! in the LiDAR frame of the ego. Time is an argument; equal inputs give equal tracks. [`metrics`] has CLEAR MOT, AMOTA,
//! AMOTP, HOTA and IDF1.
//!
//! ```
//! use protocol::{Box3d, Detection, Pose};
//! use tracking::{Tracker, TrackerConfig};
//!
//! let mut tracker = Tracker::new(TrackerConfig::default());
//! let car = |x| Box3d { center_m: [x, 2.0, 0.8], size_m: [4.5, 1.9, 1.6], heading_rad: 0.0 };
//! let mut tracks = Vec::new();
//! for tick in 0..20_u32 {
//!     // 8 m/s, ten sweeps a second.
//!     let detection = Detection { box3d: car(0.8 * f64::from(tick)), score: 0.9, source: None };
//!     let capture_nanos = u64::from(tick) * 100_000_000;
//!     tracks = tracker.update(capture_nanos, &Pose::IDENTITY, None, &[detection]).unwrap();
//! }
//! assert_eq!((tracks.len(), tracks[0].id), (1, 1));
//! assert!((tracks[0].velocity_mps[0] - 8.0).abs() < 0.1);
//! ```

pub mod assignment;
pub mod kalman;
mod measurement;
pub mod metrics;
mod track;
mod tracker;

pub use tracker::{Tracker, TrackerConfig};
