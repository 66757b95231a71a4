//! Breakdowns of average precision: parts of the objects by distance and by class.

use std::fmt;

use protocol::{Box3d, Detection};

use crate::frame::ObjectClass;
use crate::ground_truth::GroundTruth;

/// Edges of the bins of distance, metres, as in V2V4Real's tables.
const DISTANCE_EDGES_M: [f64; 4] = [0.0, 30.0, 50.0, 100.0];

/// Part of the objects for which average precision is computed. Detections on objects of other parts count neither way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Breakdown {
    /// Objects whose centre is from the first distance to below the second, metres in the plane from the ego's LiDAR.
    /// Detections on nothing count by the distance of their own centre.
    Distance([f64; 2]),
    /// Objects of one class. Detections have no class, so those on nothing count for every class.
    Class(ObjectClass),
}

/// Objects and unmatched detections of a frame that belong to a part.
pub(super) struct PartMembers {
    /// For each object that counts.
    pub(super) objects: Vec<bool>,
    /// For each detection.
    pub(super) detections: Vec<bool>,
}

impl Breakdown {
    /// All bins and classes.
    pub(super) fn parts() -> impl Iterator<Item = Self> {
        let bins = DISTANCE_EDGES_M.array_windows().copied();
        let classes = ObjectClass::ALL.iter().copied().map(Self::Class);
        bins.map(Self::Distance).chain(classes)
    }

    pub(super) fn selection(self, detections: &[Detection], truth: &GroundTruth) -> PartMembers {
        let (objects, found) = (truth.objects.iter(), detections.iter());
        let objects = objects.map(|one| self.has(&one.box3d, Some(one.class)));
        PartMembers {
            objects: objects.collect(),
            detections: found.map(|one| self.has(&one.box3d, None)).collect(),
        }
    }

    /// True for a box of the part; one without a class is of every class.
    fn has(self, box3d: &Box3d, class: Option<ObjectClass>) -> bool {
        let [x, y, _] = box3d.center_m;
        match self {
            Self::Distance([from_m, to_m]) => (from_m..to_m).contains(&x.hypot(y)),
            Self::Class(own) => class.is_none_or(|class| class == own),
        }
    }
}

impl fmt::Display for Breakdown {
    /// The name in files: `30-50` (metres), `car`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Distance([from_m, to_m]) => write!(f, "{from_m}-{to_m}"),
            Self::Class(class) => f.write_str(class.name()),
        }
    }
}
