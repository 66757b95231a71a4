//! Ground truth of a tick: poses and annotated objects.

use serde::{Deserialize, Serialize};

use super::{check_count, check_pose, check_text, check_within, metadata_only};
use crate::{Box3d, CavId, Limits, Pose, WireError};

/// Ground truth of one tick: replay to scorer, on a key of its own, so that no pipeline can use it by accident.
///
/// Objects are kept as each agent annotates them; the scorer selects those that count for an ego.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Tick of the scene, counted from 0.
    pub tick: u64,
    /// Every vehicle of the scene, in the scene's order.
    pub agents: Vec<AgentTruth>,
}

/// Ground truth of one vehicle, and its annotations.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AgentTruth {
    /// Id of the vehicle.
    pub cav: CavId,
    /// True pose of its LiDAR.
    pub world_from_lidar: Pose,
    /// Objects that it annotates.
    pub objects: Vec<TrueObject>,
}

/// One annotated object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrueObject {
    /// The data set's id, the same for all agents of a scene.
    pub id: i64,
    /// Class, as `sim-replay` names it.
    pub class: String,
    /// Pose of the box's centre.
    pub world_from_object: Pose,
    /// Full length, width and height, metres, from 0.
    pub size_m: [f64; 3],
    /// Speed, metres per second, where the data set has it.
    pub speed_mps: Option<f64>,
}

impl Truth {
    fn check_values(&self, limits: &Limits) -> Result<(), WireError> {
        check_count("agents", self.agents.len(), limits.max_entries)?;
        let objects = self.agents.iter().map(|agent| agent.objects.len()).sum();
        check_count("objects", objects, limits.max_boxes)?;
        for agent in &self.agents {
            check_pose("world_from_lidar", &agent.world_from_lidar)?;
            let mut objects = agent.objects.iter();
            objects.try_for_each(TrueObject::check_values)?;
        }
        Ok(())
    }
}

impl TrueObject {
    /// Its upright box in the world.
    pub fn box3d(&self) -> Box3d {
        Box3d {
            center_m: self.world_from_object.translation_m,
            size_m: self.size_m,
            heading_rad: self.world_from_object.yaw_rad(),
        }
    }

    fn check_values(&self) -> Result<(), WireError> {
        check_text("class", &self.class)?;
        check_pose("world_from_object", &self.world_from_object)?;
        // Data sets have objects without length, width or height: one of them must not reject the whole message.
        self.box3d().check_from(0.0)?;
        check_within("speed_mps", self.speed_mps.unwrap_or(0.0), -1e3, 1e3)
    }
}

metadata_only!(Truth, Truth);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Stamp;
    use crate::wire;

    fn encoded(size_m: [f64; 3]) -> Result<Vec<u8>, WireError> {
        let cav = CavId::new("4279").unwrap();
        let object = TrueObject {
            id: 1,
            class: "car".into(),
            world_from_object: Pose::IDENTITY,
            size_m,
            speed_mps: None,
        };
        let agent = AgentTruth {
            cav: cav.clone(),
            world_from_lidar: Pose::IDENTITY,
            objects: vec![object],
        };
        let stamp = Stamp {
            cav,
            epoch: 1,
            sequence: 0,
            capture_nanos: 5,
            publish_nanos: 7,
        };
        wire::encode(
            &stamp,
            Truth {
                tick: 0,
                agents: vec![agent],
            },
        )
        .map(|encoded| encoded.to_vec())
    }

    #[test]
    fn an_object_may_have_no_height_but_no_size_beyond_all_bounds() {
        for size_m in [[4.0, 1.8, 0.0], [0.0; 3], [1e3; 3]] {
            let bytes = encoded(size_m).unwrap();
            let (_, truth) = wire::decode::<Truth>([bytes.as_slice()], &Limits::DEFAULT).unwrap();
            assert_eq!(truth.agents[0].objects[0].size_m, size_m);
        }
        for size in [-1e-9, 1001.0, f64::NAN, f64::INFINITY] {
            assert!(
                matches!(
                    encoded([4.0, size, 1.5]),
                    Err(WireError::Value {
                        what: "box size_m",
                        ..
                    })
                ),
                "{size}"
            );
        }
    }
}
