//! Sparse 3-D convolution: sites and rulebooks in Rust, arithmetic by the tensor library.
//!
//! A sweep occupies one voxel in a few hundred. Features therefore are rows `[N, C]`, one for each occupied voxel
//! (site), and a rulebook lists the neighbours of each row. A convolution gathers the neighbours of every output side
//! by side, `[N, 27 C]`, and is one matrix product from there on. Semantics are those of submanifold convolution
//! (Graham, Engelcke and van der Maaten 2018) at stride 1 and of MinkowskiEngine at stride 2: an output site exists
//! if its cell of 2x2x2 sites has one.

mod conv;
mod rulebook;
mod sites;

pub use conv::{Int8SparseConv, SparseConv};
pub use rulebook::{GatherIndex, KERNEL_VOLUME, Rulebook, rows};
pub use sites::Sites;
