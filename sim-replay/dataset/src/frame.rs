//! Frame: data of one CAV at one capture time, with the recording's ground truth.
//!
//! Every layout is read into this one frame: right-handed, metres, radians, nanoseconds (see [`protocol`]).

use protocol::{
    AgentTruth, Camera, CavId, EgoMotion, Gnss, GnssSource, Handedness, PointCloud, Pose,
    TrueObject,
};
use serde::{Deserialize, Serialize};
use strum::{EnumString, IntoStaticStr, VariantArray};

use crate::{Problem, Result};

/// Class of an annotated object.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
#[derive(EnumString, IntoStaticStr, VariantArray)]
#[strum(serialize_all = "snake_case", parse_err_ty = String, parse_err_fn = unknown_class)]
pub enum ObjectClass {
    /// A passenger car; also every object of data sets without types.
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
    pub const ALL: &'static [Self] = Self::VARIANTS;
    /// Classes of motor vehicles with at least three wheels: the default targets of detection. An object of unknown type
    /// is not a vehicle.
    pub const VEHICLES: [Self; 4] = [Self::Car, Self::Van, Self::Truck, Self::Bus];

    /// Its name in files and options: `car`, `two_wheeler`.
    pub fn name(self) -> &'static str {
        self.into()
    }
}

/// The fault of a text that names no class.
fn unknown_class(text: &str) -> String {
    let known = "vehicle, car, van, truck, bus, two_wheeler, pedestrian or other";
    format!("{text:?} is no class: expected {known}")
}

/// An annotated object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// Identical for the same object in the frames of all CAVs of a scenario.
    pub id: i64,
    /// Class of the object.
    pub class: ObjectClass,
    /// The box: its centre, and x along its length.
    pub world_from_object: Pose,
    /// Full length, width, height in metres.
    pub size_m: [f64; 3],
    /// Speed, metres per second, if recorded.
    pub speed_mps: Option<f64>,
}

impl Object {
    /// An object whose speed is not recorded.
    pub(crate) fn new(id: i64, class: ObjectClass, pose: Pose, size_m: [f64; 3]) -> Self {
        Self {
            id,
            class,
            world_from_object: pose,
            size_m,
            speed_mps: None,
        }
    }
}

impl From<&TrueObject> for Object {
    /// An object of a message; a class of another version is [`ObjectClass::Other`].
    fn from(object: &TrueObject) -> Self {
        let class = object.class.parse().unwrap_or(ObjectClass::Other);
        Self {
            speed_mps: object.speed_mps,
            ..Self::new(object.id, class, object.world_from_object, object.size_m)
        }
    }
}

/// One sweep of one CAV.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// Id of the CAV.
    pub cav: CavId,
    /// Capture time on the clock of the scene, nanoseconds.
    pub capture_nanos: u64,
    /// The sweep in the LiDAR frame. Empty if [`crate::LoadOptions::points`] is off.
    pub points: PointCloud,
    /// Points of the file that were left out because a coordinate or intensity is not finite.
    pub dropped_points: usize,
    /// The 4D radar's points in the LiDAR frame, if recorded; the fourth value as stored.
    pub radar: Option<PointCloud>,
    /// Images of the cameras, by number. Empty unless [`crate::LoadOptions::cameras`] is on.
    pub cameras: Vec<(u8, Camera)>,
    /// True pose of the LiDAR. `None` if the data set gives no pose.
    pub world_from_lidar: Option<Pose>,
    /// True pose of the vehicle's own origin (not the LiDAR's), if recorded.
    pub world_from_vehicle: Option<Pose>,
    /// Pose of the vehicle's origin estimated by its GNSS and IMU filter, if recorded.
    pub gnss_world_from_vehicle: Option<Pose>,
    /// Forward speed in metres per second, if recorded. May be slightly negative.
    pub speed_mps: Option<f64>,
    /// Yaw rate in radians per second, counter-clockwise, if recorded.
    pub yaw_rate_rad_s: Option<f64>,
    /// Objects in this CAV's annotation. A CAV never lists itself.
    pub objects: Vec<Object>,
    /// Number of annotated objects within 20 m that no point of the sweep hits and `objects` lacks for that reason, where
    /// the lists of agents are made from all annotations.
    pub missed_objects: usize,
    /// All objects that the agents of the tick together are expected to find, if the data set has such a list; it is
    /// stored in the ego's frame. `None` if the lists of the agents are merged.
    pub cooperative_objects: Option<Vec<Object>>,
    /// Parts of the frame that were left out: an object without a valid box, a field that cannot be read.
    pub problems: Vec<Problem>,
    /// Handedness of the axes of the recording.
    pub source_handedness: Handedness,
}

impl Frame {
    /// Motion of the vehicle, as far as it is recorded.
    pub fn motion(&self) -> EgoMotion {
        EgoMotion {
            speed_mps: self.speed_mps,
            yaw_rate_rad_s: self.yaw_rate_rad_s,
        }
    }

    /// Its pose as a measurement, where one is recorded.
    pub fn gnss(&self) -> Option<Gnss> {
        self.world_from_lidar.map(|world_from_lidar| Gnss {
            world_from_lidar,
            position_std_m: 0.0,
            heading_std_rad: 0.0,
            source: GnssSource::Recorded,
        })
    }

    /// An empty frame.
    pub fn empty(cav: CavId, capture_nanos: u64, source_handedness: Handedness) -> Self {
        Self {
            cav,
            capture_nanos,
            points: PointCloud::default(),
            dropped_points: 0,
            radar: None,
            cameras: Vec::new(),
            world_from_lidar: None,
            world_from_vehicle: None,
            gnss_world_from_vehicle: None,
            speed_mps: None,
            yaw_rate_rad_s: None,
            objects: Vec::new(),
            missed_objects: 0,
            cooperative_objects: None,
            problems: Vec::new(),
            source_handedness,
        }
    }

    /// Adds the image of a camera, or the reason why there is none.
    pub(crate) fn add_camera(&mut self, number: u8, image: Result<Camera>) {
        match image {
            Ok(image) => self.cameras.push((number, image)),
            Err(error) => self.problems.push(Problem::from(&error)),
        }
    }

    /// Pose and objects of a message of the ground truth.
    pub fn of_truth(truth: &AgentTruth) -> Self {
        Self {
            world_from_lidar: Some(truth.world_from_lidar),
            objects: truth.objects.iter().map(Object::from).collect(),
            ..Self::empty(truth.cav.clone(), 0, Handedness::Right)
        }
    }

    /// The GNSS estimate carried over to the LiDAR by the true mount of the LiDAR on the vehicle.
    pub fn gnss_world_from_lidar(&self) -> Option<Pose> {
        let gnss = self.gnss_world_from_vehicle?.isometry();
        let vehicle = self.world_from_vehicle?.isometry();
        let vehicle_from_lidar = vehicle.inv_mul(&self.world_from_lidar?.isometry());
        Some((gnss * vehicle_from_lidar).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_classes_are_those_of_files_and_are_read_back() {
        for class in ObjectClass::ALL.iter().copied() {
            assert_eq!(class.name().parse(), Ok(class));
            assert_eq!(serde_json::to_value(class).unwrap(), class.name());
        }
    }
}
