//! What one CAV measured at one capture time, with what the recording knows to be true about it.
//!
//! Every layout is read into this one frame: right-handed, metres, radians, nanoseconds (see [`protocol`]).

use std::str::FromStr;

use protocol::{CavId, Handedness, PointCloud, Pose};
use serde::{Deserialize, Serialize};

use crate::Problem;

/// What an annotated object is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ObjectClass {
    /// A passenger car; also every object of datasets that do not name types.
    Car,
    /// A van.
    Van,
    /// A truck of any kind.
    Truck,
    /// A bus or tram.
    Bus,
    /// A bicycle, motorcycle or scooter, with or without rider.
    TwoWheeler,
    /// A person on foot or sitting.
    Pedestrian,
    /// Anything else that was annotated.
    Other,
}

impl ObjectClass {
    /// Every class.
    pub const ALL: [Self; 7] =
        [Self::Car, Self::Van, Self::Truck, Self::Bus, Self::TwoWheeler, Self::Pedestrian, Self::Other];
    /// Classes of motor vehicles with at least three wheels: the default targets of detection.
    pub const VEHICLES: [Self; 4] = [Self::Car, Self::Van, Self::Truck, Self::Bus];

    /// True for [`Self::VEHICLES`]. An object of unknown type is no vehicle.
    #[must_use]
    pub fn is_vehicle(self) -> bool {
        Self::VEHICLES.contains(&self)
    }

    /// Its name in files and options: `car`, `two_wheeler`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Car => "car",
            Self::Van => "van",
            Self::Truck => "truck",
            Self::Bus => "bus",
            Self::TwoWheeler => "two_wheeler",
            Self::Pedestrian => "pedestrian",
            Self::Other => "other",
        }
    }
}

impl FromStr for ObjectClass {
    type Err = UnknownClass;

    /// Reads [`ObjectClass::name`].
    fn from_str(text: &str) -> Result<Self, UnknownClass> {
        Self::ALL.into_iter().find(|class| class.name() == text).ok_or_else(|| UnknownClass(text.to_owned()))
    }
}

/// A text that names no class.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0:?} is no class: expected vehicle, car, van, truck, bus, two_wheeler, pedestrian or other")]
pub struct UnknownClass(String);

/// An annotated object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// The same for the same object in the frames of all CAVs of a scenario.
    pub id: i64,
    /// What it is.
    pub class: ObjectClass,
    /// The box: its centre, and x along its length.
    pub world_from_object: Pose,
    /// Full length, width, height in metres.
    pub size_m: [f64; 3],
    /// Speed, metres per second, where recorded.
    pub speed_mps: Option<f64>,
}

/// One sweep of one CAV.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Who measured.
    pub cav: CavId,
    /// When, on the clock of the scene, nanoseconds.
    pub capture_nanos: u64,
    /// The sweep in the LiDAR frame. Without points where [`crate::LoadOptions::points`] was off.
    pub points: PointCloud,
    /// Points of the file that were left out because a coordinate or intensity is not finite.
    pub dropped_points: usize,
    /// The 4D radar's points in the LiDAR frame, where the recording has them; the fourth value as stored.
    pub radar: Option<PointCloud>,
    /// True pose of the LiDAR. `None` where the dataset gives no pose.
    pub world_from_lidar: Option<Pose>,
    /// True pose of the vehicle's own origin (not the LiDAR's), where recorded.
    pub world_from_vehicle: Option<Pose>,
    /// What the vehicle's GNSS and IMU filter believed its origin to be, where recorded.
    pub gnss_world_from_vehicle: Option<Pose>,
    /// Forward speed in metres per second, where recorded. May be slightly negative.
    pub speed_mps: Option<f64>,
    /// What this CAV's annotation lists. A CAV never lists itself.
    pub objects: Vec<Object>,
    /// All objects that the agents of the tick together are expected to find, where the data set has such a list; it stands
    /// on the ego's frame. `None` where the lists of the agents are merged.
    pub cooperative_objects: Option<Vec<Object>>,
    /// Parts of the frame that were left out: an object without a sound box, a field that cannot be read.
    pub problems: Vec<Problem>,
    /// Which way the axes of the recording turned.
    pub source_handedness: Handedness,
}

impl Frame {
    /// A frame with nothing in it.
    #[must_use]
    pub fn empty(cav: CavId, capture_nanos: u64, source_handedness: Handedness) -> Self {
        Self {
            cav,
            capture_nanos,
            points: PointCloud::default(),
            dropped_points: 0,
            radar: None,
            world_from_lidar: None,
            world_from_vehicle: None,
            gnss_world_from_vehicle: None,
            speed_mps: None,
            objects: Vec::new(),
            cooperative_objects: None,
            problems: Vec::new(),
            source_handedness,
        }
    }

    /// The GNSS estimate carried over to the LiDAR by the true mount of the LiDAR on the vehicle.
    #[must_use]
    pub fn gnss_world_from_lidar(&self) -> Option<Pose> {
        let gnss = self.gnss_world_from_vehicle?.isometry();
        let vehicle_from_lidar = self.world_from_vehicle?.isometry().inv_mul(&self.world_from_lidar?.isometry());
        Some((gnss * vehicle_from_lidar).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_classes_are_those_of_files_and_are_read_back() {
        for class in ObjectClass::ALL {
            assert_eq!(class.name().parse(), Ok(class));
            assert_eq!(serde_json::to_value(class).unwrap(), class.name());
        }
        assert!(!ObjectClass::Other.is_vehicle() && !ObjectClass::TwoWheeler.is_vehicle());
    }
}
