//! Alignment by poses, the method of the paper: every vehicle localises itself, and only poses are exchanged.

use std::collections::BTreeMap;
use std::rc::Rc;

use agent_offline::evaluation::estimate_pose;
use dataset::frame::Frame;
use localization::pose_source::{PoseSource, PoseSourceError};
use protocol::message::Message;
use protocol::{CavId, Pose};

use super::method::{
    AlignError, AlignInput, Alignment, AlignmentMethod, AlignmentSpec, NotAligned, pose_difference,
};

/// Pose of the recording that a source gets as its measurement: that of the GNSS and IMU filter, or the true one for
/// sources that add an error to it. Sources that localise by sweeps ignore it.
pub type GivenPose = fn(&Frame) -> Option<Pose>;

type Build = dyn Fn() -> Result<Box<dyn PoseSource>, PoseSourceError>;

/// Aligns by the difference of both vehicles' poses.
pub struct Poses {
    build: Rc<Build>,
    measured: GivenPose,
    /// A source for each vehicle: some keep the previous pose.
    sources: BTreeMap<CavId, Box<dyn PoseSource>>,
}

impl Poses {
    /// A method over any pose source; `build` makes one for each vehicle of a scene.
    pub fn spec(
        name: impl Into<String>,
        measured: GivenPose,
        build: impl Fn() -> Result<Box<dyn PoseSource>, PoseSourceError> + 'static,
    ) -> AlignmentSpec {
        let build: Rc<Build> = Rc::new(build);
        AlignmentSpec::new(name, false, move || Self {
            build: Rc::clone(&build),
            measured,
            sources: BTreeMap::new(),
        })
    }
}

impl AlignmentMethod for Poses {
    fn prepare(&mut self, vehicle: &AlignInput<'_>) -> Result<Message, AlignError> {
        let frame = vehicle.frame;
        let measured = (self.measured)(frame);
        let source = match self.sources.entry(frame.cav.clone()) {
            std::collections::btree_map::Entry::Occupied(known) => known.into_mut(),
            std::collections::btree_map::Entry::Vacant(place) => place.insert((self.build)()?),
        };
        let estimate = estimate_pose(source.as_mut(), frame, measured.as_ref());
        Ok(Message::Pose(estimate))
    }

    fn align(&self, _: &AlignInput<'_>, own: &Message, received: &Message) -> Alignment {
        match (own, received) {
            (Message::Pose(own), Message::Pose(received)) => pose_difference(own, received),
            _ => Err(NotAligned::Message),
        }
    }
}
