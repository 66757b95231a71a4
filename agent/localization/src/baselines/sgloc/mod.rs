//! SGLoc (Li et al. 2023), small: scene coordinates of cells, from which a solver finds the pose.
//!
//! Kept of the published network: the position of a cell as a feature, the attention between scales, the residual head
//! with batch normalisation, the shift of a cell's own position as output, the L1 loss and RANSAC.
//!
//! Departures: PGC's encoder, frozen, in place of one of its own of 55 million parameters; a head of 2.7 million in
//! place of 57; no inter-geometric-consistency term, which the published training code does not use either.

mod head;
mod localizer;
mod network;

pub use localizer::SgLocLocalizer;
pub use network::{SgLoc, SgLocConfig};
