//! Alignment method: a message from each vehicle, and from two messages the pose of one in the frame of the other.

use dataset::frame::Frame;
use localization::pose_source::PoseSourceError;
use nalgebra::Isometry3;
use protocol::message::Message;
use protocol::{Box3d, PoseEstimate, WireError};

use super::free_align::NoAlignment;

/// Input of a vehicle for alignment.
#[derive(Debug, Clone, Copy)]
pub struct AlignInput<'a> {
    /// Its frame. The true poses in it are for evaluation, and for sources that are configured to use them.
    pub frame: &'a Frame,
    /// Its boxes in the frame of its LiDAR, the most confident first; empty where no method needs them.
    pub boxes: &'a [Box3d],
}

/// A way to align two vehicles of one scene.
pub trait AlignmentMethod {
    /// The message of a vehicle, from its own data only.
    ///
    /// # Errors
    /// [`AlignError`] when the method cannot continue at all.
    fn prepare(&mut self, vehicle: &AlignInput<'_>) -> Result<Message, AlignError>;

    /// Aligns the ego with a neighbour by the messages of both.
    fn align(&self, ego: &AlignInput<'_>, own: &Message, received: &Message) -> Alignment;
}

/// `ego_from_neighbour`, both in the frames of their LiDARs, or the reason why there is none.
pub type Alignment = Result<Isometry3<f64>, NotAligned>;

/// Difference of the poses of two vehicles.
pub(super) fn pose_difference(own: &PoseEstimate, received: &PoseEstimate) -> Alignment {
    match (own.world_from_cav(), received.world_from_cav()) {
        (Some(own), Some(received)) => Ok(own.from_world(received).isometry()),
        _ => Err(NotAligned::NoPose),
    }
}

/// An alignment method with its settings; each scene has an instance of its own.
pub struct AlignmentSpec {
    /// Name in tables.
    pub name: String,
    /// True if it uses [`AlignInput::boxes`].
    pub needs_boxes: bool,
    /// The method at the beginning of a scene.
    pub(crate) for_scene: Box<dyn Fn() -> Box<dyn AlignmentMethod>>,
}

impl AlignmentSpec {
    /// A method that `construct` makes for each scene.
    pub fn new<M: AlignmentMethod + 'static>(
        name: impl Into<String>,
        needs_boxes: bool,
        construct: impl Fn() -> M + 'static,
    ) -> Self {
        Self {
            name: name.into(),
            needs_boxes,
            for_scene: Box::new(move || Box::new(construct())),
        }
    }
}

/// Reason why a pair was not aligned.
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
    /// A message is not one of this method.
    #[error("a message of another kind")]
    Message,
}

impl NotAligned {
    /// One word for counting.
    pub fn reason(&self) -> &'static str {
        use localization::registration::icp::NoIcpFit;
        match self {
            Self::NoPose => "no_pose",
            Self::Boxes(NoAlignment::TooFewBoxes { .. }) => "too_few_boxes",
            Self::Boxes(NoAlignment::TooFewMatches { .. }) => "too_few_matches",
            Self::Boxes(NoAlignment::Ambiguous { .. }) => "ambiguous",
            Self::Clouds(NoIcpFit::TooFew { .. }) => "too_few_points",
            Self::Clouds(NoIcpFit::TooLittleOverlap(_)) => "too_little_overlap",
            Self::Clouds(NoIcpFit::Unconstrained(_)) => "unconstrained",
            Self::Message => "message",
        }
    }
}

/// Reason why a comparison ended early.
#[derive(Debug, thiserror::Error)]
pub enum AlignError {
    /// A pose source cannot be set up.
    #[error(transparent)]
    PoseSource(#[from] PoseSourceError),
    /// A message cannot be encoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// The detector reported an error.
    #[error(transparent)]
    Detector(#[from] perception::detector::DetectorError),
}
