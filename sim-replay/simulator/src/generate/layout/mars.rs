//! Open MARS, multiagent subset, in the tables of nuScenes: channel names end with the names of vehicles.

use serde_json::{Map, json};

use super::boxes::of_255;
use super::nuscenes::TableStyle;

/// The style.
pub(super) static STYLE: TableStyle = TableStyle {
    version: "v1.0",
    channels: |scene| {
        let agents = scene.agents.iter();
        let channels = agents.map(|agent| format!("LIDAR_FRONT_CENTER_{}", agent.id));
        channels.collect()
    },
    file_name: |_, _, micros| format!("{micros}.pcd.bin"),
    // A sensor's bytes, as floats.
    intensity: of_255,
    scene_fields: |scene| {
        let vehicles: Vec<&str> = scene.agents.iter().map(|agent| agent.id.as_str()).collect();
        Map::from_iter([
            ("vehicle_list".to_owned(), json!(vehicles)),
            ("intersection".to_owned(), json!(0)),
            ("err_max".to_owned(), json!(0.0)),
        ])
    },
};
