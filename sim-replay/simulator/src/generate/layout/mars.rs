//! Open MARS, multiagent subset, in the tables of nuScenes: channel names end with the names of vehicles.

use serde_json::{Map, Value, json};

use super::boxes::of_255;
use super::nuscenes::Style;
use super::{SceneAgent, SceneHeader};

/// The style.
#[derive(Debug)]
pub(super) struct Mars;

impl Style for Mars {
    fn version(&self) -> &'static str {
        "v1.0"
    }

    fn channels(&self, scene: &SceneHeader) -> Vec<String> {
        let channel = |agent: &SceneAgent| format!("LIDAR_FRONT_CENTER_{}", agent.id);
        scene.agents.iter().map(channel).collect()
    }

    fn file_name(&self, _: usize, _: usize, micros: u64) -> String {
        format!("{micros}.pcd.bin")
    }

    /// A sensor's bytes, as floats.
    fn intensity(&self, intensity: f32) -> f32 {
        of_255(intensity)
    }

    fn scene_fields(&self, scene: &SceneHeader) -> Map<String, Value> {
        let vehicles: Vec<&str> = scene.agents.iter().map(|agent| agent.id.as_str()).collect();
        Map::from_iter([
            ("vehicle_list".to_owned(), json!(vehicles)),
            ("intersection".to_owned(), json!(0)),
            ("err_max".to_owned(), json!(0.0)),
        ])
    }
}
