//! Messages between connected automated vehicles (CAVs): types, wire format and conventions.
//!
//! This crate holds plain data and the two conversions between that data and bytes, [`wire::encode`] and
//! [`wire::decode`]. It depends on no network, clock, file or tensor library.
//!
//! ```
//! use protocol::{
//!     Bev, BevFeatures, BevGrid, CavId, CodecConfig, Dtype, Key, Limits, Pose, PoseEstimate, RunId, Stamp, Stream,
//!     encode_features, wire,
//! };
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! // An agent: half precision, at most 2,000 bytes, the most confident cells first.
//! let grid = BevGrid { x_min_m: -51.2, y_min_m: -38.4, cell_m: 0.8, width: 32, height: 24 };
//! let features = BevFeatures { grid, channels: 4, code_of: None, values: vec![0.5; 4 * 24 * 32] };
//! let config = CodecConfig { dtype: Dtype::F16, budget_bytes: Some(2_000), ..CodecConfig::default() };
//! let confidence: Vec<f32> = (0..24 * 32).map(|cell| cell as f32 / 768.0).collect();
//! let message = Bev {
//!     pose: PoseEstimate::new(Pose::from_xyz_yaw([12.0, -3.5, 1.9], 0.3), 0.8),
//!     features: encode_features(features, &config, Some(&confidence))?,
//! };
//! let cav = CavId::new("4279")?;
//! let key = Key::stream(&RunId::new("demo")?, &cav, Stream::Bev);
//! assert_eq!(key.to_string(), "v2v/demo/4279/bev");
//! let stamp = Stamp { cav, epoch: 7, sequence: 1, capture_nanos: 100_000_000, publish_nanos: 0 };
//! let encoded = wire::encode(&stamp, message)?;
//! assert!(encoded.body.len() <= 2_000);
//!
//! // The ego: the payload may be in any number of pieces.
//! let (header, bev) = wire::decode::<Bev>(encoded.pieces(), &Limits::DEFAULT)?;
//! header.check_sender(&"4279".parse()?)?;
//! bev.features.check_shape(&grid, 4, None)?;
//! let received = bev.features.decode(&Limits::DEFAULT)?;
//! let sent_cells = received.sent.expect("not all cells fit").iter().filter(|sent| **sent).count();
//! assert_eq!(sent_cells, (2_000 - 24 * 32 / 8) / (4 * 2));
//! # Ok(())
//! # }
//! ```
//!
//! # Messages
//!
//! | message | stream or key | from | to |
//! | --- | --- | --- | --- |
//! | [`Lidar`], [`Radar`] | `lidar`, `radar` | replay | that vehicle's agent |
//! | [`Camera`] | `camera/<k>` | replay | viewers, recorders |
//! | [`Gnss`] | `gnss` | replay | that vehicle's agent |
//! | [`PoseEstimate`] | `pose` | agent | ego-fusers |
//! | [`Bev`] | `bev` | agent | ego-fusers (intermediate fusion) |
//! | [`Boxes`] | `boxes` | agent | ego-fusers (late fusion, box input) |
//! | [`Points`] | `points` | agent | ego-fusers (early fusion) |
//! | [`Descriptor`] | `descriptor` | agent | ego-fusers |
//! | [`Detections`] | `detections` | ego-fuser | scorer, anyone |
//! | [`Tracks`] | `tracks` | ego-fuser | scorer, anyone |
//! | [`DetectionsReport`], [`TracksReport`] | `detections/json`, `tracks/json` | ego-fuser | any reader of JSON |
//! | [`Truth`] | `truth` | replay | scorer |
//! | [`Control`] | `control/*`, and probes on any key | operator, replay, every process | replay, every process |
//! | [`Stats`] | `stats/<process>` | every process | operator |
//!
//! A message is a header ([`header`]: sender, sequence, times, sizes, two checksums), metadata, and a body of raw
//! little-endian values ([`Body`]). Keys are defined in [`key`], the encoding of feature maps in [`codec`].
//!
//! # Guarantees to a receiver
//!
//! Any bytes may arrive. Decoding never panics, allocates no memory for sizes that are only claimed, and returns only
//! values that the sender has sealed: sizes that agree with each other and with [`Limits`], values that are finite and
//! bounded, valid poses. Every rejected message has a [`WireError`] with both numbers and a [`DropReason`] under which
//! the [`Ledger`] counts it. The checksums detect accidents; the transport has to authenticate the peer.
//!
//! # Conventions
//!
//! They hold everywhere behind the readers of `sim-replay`, where the conventions of the data sets end.
//!
//! - Frames are right-handed: x forward, y left, z up. Lengths are metres, angles radians (degrees only where a name
//!   ends in `_deg` or a number is printed), heading and yaw turn x towards y.
//! - A transform is named target-from-source: `ego_from_cav` maps points of the CAV's LiDAR frame to the ego's.
//!   `world_from_cav` is the pose of a CAV, always of its LiDAR.
//! - A box is `(x, y, z, dx, dy, dz, heading)`: centre, full length, width and height.
//! - BEV feature maps are `[C, H, W]`: the row grows with y, the column with x.
//! - Times are nanoseconds: capture times on the clock of the scene, everything else on the Unix clock.

// This crate reads what other processes and people wrote: an index or a cast that does not fit is an error there, not
// a panic or another number.
#![cfg_attr(not(test), deny(clippy::cast_possible_truncation))]
#![cfg_attr(not(test), deny(clippy::cast_sign_loss))]
#![cfg_attr(not(test), deny(clippy::indexing_slicing))]

pub mod access;
mod bev;
mod body;
mod box3d;
mod checks;
pub mod codec;
#[cfg(feature = "config")]
pub mod config;
mod drop_reason;
mod error;
pub mod header;
mod id;
mod intensity;
pub mod key;
mod ledger;
mod limits;
pub mod message;
mod metadata;
mod misbehaviour_reason;
mod point_cloud;
mod pose;
mod reconciliation;
pub mod rotated_iou;
mod stream;
mod string_enum;
pub mod text;
mod topic;
pub mod wire;

pub use access::{Operation, Permission, Principal, RunScope};
pub use bev::{BevFeatures, BevGrid};
pub use body::{Body, BodyShape};
pub use box3d::{Box3d, Detection, corners_within};
pub use codec::{
    ByteLimit, Codec, CodecConfig, Compression, ConfidenceGate, DecodedFeatures, Dtype,
    EncodedFeatures, LimitedBy, RateChoice, RateReason, Selection, Smoothing, encode_features,
    encode_within,
};
pub use drop_reason::DropReason;
pub(crate) use error::Result;
pub use error::WireError;
pub use header::{HEADER_LEN, Header, Stamp, WIRE_VERSION};
pub use id::{CavId, IdError, ProcessId, RunId};
pub use intensity::{COLOUR_FIELDS, INTENSITY_FIELDS, IntensityKind, intensity_divisor};
pub use key::{Key, KeyError, KeyExpr};
pub use ledger::{Account, Counts, Ledger};
pub use limits::Limits;
pub use message::{
    AgentTruth, Bev, Boxes, Camera, CameraMetadata, Control, Descriptor, Detections,
    DetectionsReport, EgoMotion, FrameReport, FusedNeighbour, Gnss, GnssSource, ImageFormat, Kind,
    Lidar, Message, ModelHash, NeighbourState, NoPoseReason, ObjectTrack, Pace, Payload,
    PerceivedObject, Pinhole, PlanarCovariance, Points, PoseEstimate, ProcessUsage, Radar,
    SkippedNeighbour, StageSummary, StageTiming, Stats, SweepArrival, ThreadUsage, TopicCount,
    TopicTraffic, Track, Tracks, TracksReport, TrueObject, Truth,
};
pub use misbehaviour_reason::MisbehaviourReason;
pub use point_cloud::{Handedness, PointCloud};
pub use pose::{InvalidPose, Pose, PoseError};
pub use reconciliation::{Discrepancy, Reconciliation, UnreceivedTopic};
pub use stream::Stream;
pub use topic::{Role, Topic, Verb};
pub use wire::Encoded;
