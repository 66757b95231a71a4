//! Ways to find out how a neighbour stands to the ego without GNSS, compared on the same pairs.
//!
//! Every vehicle prepares a message from what it alone has; the ego aligns with its own and the neighbour's message. The
//! paper's table is made of such pairs: time, bytes on the air, and the share that is right to 3 m.
//!
//! - [`poses`]: each vehicle sends its own pose, from any [`localization::pose_source::PoseSource`];
//! - [`clouds`]: the neighbour sends its (thinned) sweep, which is registered against the ego's by ICP;
//! - [`free_align`], [`box_icp`]: it sends its boxes, which are matched with the ego's;
//! - [`compare`] runs them over scenes, [`table`] counts.
//!
//! What differs from the papers: `free_align` has no graph network and no look at true poses; ICP on points is ours
//! (point to plane), the paper's row "ICP" moves box centres and is `box-icp` here; bytes are those of the real messages,
//! not of bare numbers.

pub mod box_icp;
pub mod clouds;
pub mod compare;
pub mod free_align;
pub mod poses;
pub mod table;

mod boxes;

use dataset::ReadError;
use dataset::frame::Frame;
use localization::pose_source::PoseSourceError;
use nalgebra::Isometry3;
use protocol::message::Message;
use protocol::{Box3d, WireError};

pub use boxes::{BoxIcp, FreeAlign};
pub use clouds::CloudIcp;
pub use free_align::{NoAlignment, align as align_boxes};
pub use poses::{Measured, Poses};

/// What a vehicle has to align with.
#[derive(Debug, Clone, Copy)]
pub struct Vehicle<'a> {
    /// Its frame. True poses in it are for those who measure, and for sources that are told to take them.
    pub frame: &'a Frame,
    /// Its boxes in the frame of its LiDAR, the surest first; empty where no approach asked for them.
    pub boxes: &'a [Box3d],
}

/// A way to align two vehicles.
pub trait Approach {
    /// Name in tables.
    fn name(&self) -> &str;

    /// Whether it looks at [`Vehicle::boxes`].
    fn needs_boxes(&self) -> bool {
        false
    }

    /// Forgets what it knew of vehicles: another scene begins.
    fn begin(&mut self) {}

    /// What a vehicle sends, from what it alone has.
    ///
    /// # Errors
    /// [`AlignError`] when the approach cannot go on at all.
    fn prepare(&mut self, vehicle: &Vehicle<'_>) -> Result<Message, AlignError>;

    /// `ego_from_neighbour`, both in the frames of their LiDARs, or why there is none.
    fn align(&self, ego: &Vehicle<'_>, own: &Message, received: &Message) -> Result<Isometry3<f64>, NotAligned>;
}

/// Why a pair was not aligned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NotAligned {
    /// One of the two has no pose.
    #[error("no pose")]
    NoPose,
    /// The boxes give no alignment.
    #[error(transparent)]
    Boxes(#[from] NoAlignment),
    /// The clouds give none.
    #[error(transparent)]
    Clouds(#[from] localization::registration::icp::NoIcpFit),
    /// A message is not one of this approach.
    #[error("a message of another kind")]
    Message,
}

impl NotAligned {
    /// One word for counting.
    #[must_use]
    pub fn reason(&self) -> &'static str {
        use localization::registration::icp::NoIcpFit;
        match self {
            Self::NoPose => "no_pose",
            Self::Boxes(NoAlignment::TooFewBoxes { .. }) => "too_few_boxes",
            Self::Boxes(NoAlignment::TooFewMatches { .. }) => "too_few_matches",
            Self::Boxes(NoAlignment::Ambiguous { .. }) => "ambiguous",
            Self::Clouds(NoIcpFit::TooFew { .. }) => "too_few_points",
            Self::Clouds(NoIcpFit::TooLittleOverlap { .. }) => "too_little_overlap",
            Self::Clouds(NoIcpFit::Unconstrained { .. }) => "unconstrained",
            Self::Message => "message",
        }
    }
}

/// Why a comparison ended early.
#[derive(Debug, thiserror::Error)]
pub enum AlignError {
    /// A pose source cannot be set up.
    #[error(transparent)]
    PoseSource(#[from] PoseSourceError),
    /// A frame cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A message cannot be encoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The detector refused.
    #[error(transparent)]
    Detector(#[from] perception::detector::DetectorError),
    /// A recording without true poses.
    #[error("{scenario}, {stem}: agent {cav} has no true pose to compare with")]
    NoTruth {
        /// The scenario.
        scenario: String,
        /// The moment.
        stem: String,
        /// Whose pose is missing.
        cav: protocol::CavId,
    },
}
