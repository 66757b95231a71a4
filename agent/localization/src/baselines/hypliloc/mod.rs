//! HypLiLoc (Wang et al. 2023), small: pose regression from two views of the tokens of PGC's frozen encoder, fused in
//! Euclidean and hyperbolic space.
//!
//! Kept of the published network: a branch of points with graph attention, a convolutional branch of a panorama,
//! L2-normalised tokens with one pooled token of each branch, graph attention with a learnt metric in both geometries,
//! blocks of each modality between two fusions, a pose from points, panorama and fusion, each with its own loss.
//!
//! Departures: both branches read the same tokens, one as a set and one as a panorama of 32 columns, where the paper has
//! PointNet++ and a residual network that was pretrained on images; a pose is relative to the likeliest of some hundred
//! place classes, the true one in training; a map for each token's position in place of the mean of tokens, which would
//! forget where they lie; the heading is a cosine and a sine instead of a log-quaternion, since vehicles head in all
//! directions; a head of the attention has a ball of its own and returns from it by the logarithm before the layer
//! norm; the learnt metric begins as the identity; the weights of the losses are fixed in the first third.

mod branch;
mod fusion;
mod graph_attention;
mod network;
mod panorama;
mod poincare;
mod token_layer;

pub use branch::Branch;
pub use network::{HypLiLoc, HypLiLocLocalizer};
