//! V2X-Sim 2.0 in the tables of nuScenes: agents are numbered in the names of channels, and 0 is the roadside unit.

use serde_json::{Map, json};

use super::nuscenes::TableStyle;

/// The style.
pub(super) static STYLE: TableStyle = TableStyle {
    version: "v1.0-mini",
    channels: |scene| {
        let unit = scene.agents.iter().position(|agent| agent.is_roadside);
        let mut numbers = 1..;
        let channels = (0..scene.agents.len()).map(|agent| {
            let number = match Some(agent) == unit {
                true => 0,
                false => numbers.next().unwrap_or_default(),
            };
            format!("LIDAR_TOP_id_{number}")
        });
        channels.collect()
    },
    file_name: |scene, moment, _| format!("scene_{scene}_{moment:06}.pcd.bin"),
    // CARLA's intensities are 0 to 1.
    intensity: |intensity| intensity,
    scene_fields: |scene| {
        let description = format!("{} agents", scene.agents.len());
        Map::from_iter([("description".to_owned(), json!(description))])
    },
};
