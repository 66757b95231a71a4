//! What crosses the air between connected automated vehicles (CAVs), and in which convention.
//!
//! This crate holds plain data and the two doors between that data and bytes. It knows no network, no clock, no file
//! and no tensor library.
//!
//! # Conventions
//!
//! They hold everywhere behind the readers of `sim-replay`, where the conventions of the datasets end.
//!
//! - Frames are right-handed: x forward, y left, z up. Lengths are metres, angles radians (degrees only where a name
//!   says `_deg` or a number is printed), heading and yaw turn x towards y.
//! - A transform is named target-from-source: `ego_from_cav` takes points of the CAV's LiDAR frame to the ego's.
//!   `world_from_cav` is the pose of a CAV, always of its LiDAR.
//! - A box is `(x, y, z, dx, dy, dz, heading)`: centre, full length, width and height.
//! - BEV maps are `[C, H, W]`: the row grows with y, the column with x.
//! - Times are nanoseconds: capture times on the clock of the scene, everything else on the Unix clock.

mod bev;
mod body;
mod box3d;
pub mod codec;
mod error;
pub mod header;
mod id;
pub mod key;
mod ledger;
mod limits;
pub mod message;
mod metadata;
mod point_cloud;
mod pose;
mod stream;
pub mod wire;

pub use bev::{BevFeatures, BevGrid};
pub use body::{Body, BodyShape};
pub use box3d::{Box3d, Detection};
pub use codec::{Codec, CodecConfig, DecodedFeatures, Dtype, EncodedFeatures, Packing, Selection, encode_features};
pub use error::WireError;
pub use header::{HEADER_LEN, Header, Kind, Stamp, WIRE_VERSION};
pub use id::{CavId, IdError, ProcessId, RunId};
pub use key::{Key, KeyError, Role, Selector, Topic, Verb};
pub use ledger::{Account, Balance, Counts, Difference, DropReason, Ledger, Unheard};
pub use limits::Limits;
pub use message::{
    AgentTruth, Bev, Boxes, Control, Descriptor, Detections, DetectionsReport, FusedNeighbour, Gnss, GnssSource, Lidar,
    Message, ModelHash, NoPoseReason, Payload, Points, PoseEstimate, Radar, SkippedNeighbour, StageSummary,
    StageTiming, Stats, TopicCount, TrueObject, Truth,
};
pub use point_cloud::{Handedness, PointCloud};
pub use pose::{Pose, PoseError};
pub use stream::Stream;
pub use wire::Encoded;
