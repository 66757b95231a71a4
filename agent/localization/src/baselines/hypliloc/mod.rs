//! HypLiLoc (Wang et al. 2023), small: pose regression from points and a spherical image, fused in Euclidean and
//! hyperbolic space.
//!
//! Kept of the published network: PointNet++ with graph attention, a residual network on the image, L2-normalised
//! tokens with one pooled token of each branch, graph attention with a learnt metric in both geometries, blocks of each
//! modality between two fusions, a pose from points, image and fusion, each with its own loss. Smaller: 1,024 points
//! instead of 4,096, half as many channels, and a residual network of 16 to 128 channels without pretraining, on an
//! image of half the columns, to 46 tokens instead of 23.
//!
//! Departures: the heading is a cosine and a sine instead of a log-quaternion, since vehicles head in all directions;
//! the image has the channels x, y, z and range, for the mean of tokens would not tell a direction otherwise; a head of
//! the attention has a ball of its own and returns from it by the logarithm before the layer norm; the learnt metric
//! begins as the identity; batch norm of the mean tokens before each head; place classification by
//! each branch as an auxiliary loss.

mod config;
mod dense_norm;
mod fusion;
mod graph_attention;
mod groups;
mod image_branch;
mod localizer;
mod network;
mod poincare;
mod point_branch;
mod pose_head;
mod range_image;
mod sampling;
mod sweep_input;

pub use config::HypLiLocConfig;
pub use localizer::HypLiLocLocalizer;
pub use network::{BranchPoses, HypLiLoc, WIDTH};
pub use pose_head::NormalisedPoses;
pub use range_image::{COLUMNS, ROWS, roll_columns};
pub use sweep_input::{InputBatch, POINTS, RANGE_M, SweepInput};
