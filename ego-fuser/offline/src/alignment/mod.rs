//! Alignment without GNSS: methods that estimate a neighbour's pose relative to the ego, compared on the same pairs.
//!
//! Every vehicle prepares a message from its own data only; the ego aligns with its own and the neighbour's message.
//! The paper's table is made of such pairs: time, transmitted bytes, and the share that is right to 3 m.
//!
//! - [`poses`]: each vehicle sends its own pose, from any [`localization::pose_source::PoseSource`];
//! - [`clouds`]: the neighbour sends its (decimated) sweep, which is registered against the ego's by ICP;
//! - [`free_align`], [`box_icp`]: it sends its boxes, which are matched with the ego's;
//!
//! `evaluation::alignment` runs them over scenes and counts.
//!
//! Differences from the papers: `free_align` has no graph network and does not use true poses; ICP on points is an
//! implementation of this project (point to plane), the paper's row "ICP" moves box centres and is `box-icp` here;
//! bytes are those of the actual messages, not of bare numbers.

pub mod box_icp;
pub mod clouds;
pub mod free_align;
pub mod poses;

mod boxes;
mod method;

pub use boxes::{BoxIcp, FreeAlign};
pub use clouds::CloudIcp;
pub use free_align::{NoAlignment, align as align_boxes};
pub use method::{AlignError, AlignInput, Alignment, AlignmentMethod, AlignmentSpec, NotAligned};
pub use poses::{GivenPose, Poses};
