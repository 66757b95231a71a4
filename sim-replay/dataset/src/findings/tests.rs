use std::fs;

use super::*;
use crate::OpenOptions;

/// Findings in a scene of one agent with 20 boxes around the sensor in each of 60 frames, of which `empty` hold no
/// point.
fn scene_findings(dir: &Path, empty: usize, intensity: f32) -> Vec<String> {
    let folder = dir.join("scene/1");
    fs::create_dir_all(&folder).unwrap();
    let cars: String = (0..20)
        .map(|id| {
            let x = if id < empty { 900 } else { 10 };
            format!(
                "  {id}: {{location: [{x}, {}, 0], angle: [0, 0, 0], extent: [1, 1, 1]}}\n",
                4 * id
            )
        })
        .collect();
    let yaml = format!("lidar_pose: [0, 0, 0, 0, 0, 0]\nvehicles:\n{cars}");
    let points: String = (0..20)
        .map(|id| format!("10 {} 0 {}\n", 4 * id, intensity * id as f32))
        .collect();
    let head = "FIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 20\nDATA ascii\n";
    for frame in 0..60 {
        fs::write(folder.join(format!("{frame:06}.yaml")), &yaml).unwrap();
        fs::write(
            folder.join(format!("{frame:06}.pcd")),
            format!("{head}{points}"),
        )
        .unwrap();
    }
    let dataset = crate::open_with(dir, &OpenOptions::default()).unwrap();
    sampled(&dataset.scenarios, IntensityScale::AUTO)
        .into_iter()
        .map(|finding| finding.message)
        .collect()
}

#[test]
fn a_sample_has_the_findings_of_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    assert!(scene_findings(dir.path(), 10, 0.05).is_empty());
    let found = scene_findings(dir.path(), 11, -1.0);
    assert_eq!(found.len(), 2, "{found:?}");
    assert!(
        found[0].starts_with("scene: agent 1: 440 of 800 boxes (55 %) hold none of its points"),
        "{found:?}"
    );
    assert!(
        found[1].contains("sweeps of agent 1: 760 of 800 intensities are below 0"),
        "{found:?}"
    );
}
