//! Small scenes on disk, in the layout of OPV2V, for tests that need files but no realism.

use std::fs;
use std::path::Path;

use dataset::pcd::{Encoding, IntensityField, encode};
use protocol::PointCloud;

/// Step between two ticks in the counter of file names, which counts at 20 Hz: scenes run at 10 Hz.
const STEM_STEP: usize = 2;

/// Writes `<dir>/scene/<agent>/<stem>.{yaml,pcd}` for every agent and tick: vehicles 15 m apart that drive along x at
/// 10 m/s over a flat ground, three cars around each.
///
/// # Panics
/// When a file cannot be written.
pub fn write(dir: &Path, agents: &[&str], ticks: usize) {
    for (place, agent) in agents.iter().enumerate() {
        let folder = dir.join("scene").join(agent);
        fs::create_dir_all(&folder).expect("a folder");
        for tick in 0..ticks {
            let stem = format!("{:06}", 60 + STEM_STEP * tick);
            let (x, y) = (tick as f64, 15.0 * place as f64);
            fs::write(folder.join(format!("{stem}.yaml")), yaml(x, y)).expect("a file");
            let cloud = encode(
                &cloud(place, tick),
                Encoding::Binary,
                IntensityField::Intensity,
            );
            fs::write(folder.join(format!("{stem}.pcd")), cloud).expect("a file");
        }
    }
}

fn yaml(x: f64, y: f64) -> String {
    let pose = format!("[{x}, {y}, 1.9, 0.0, 0.0, 0.0]");
    let mut text =
        format!("lidar_pose: {pose}\ntrue_ego_pos: {pose}\nego_speed: 36.0\nvehicles:\n");
    for (id, ahead) in [(100, 12.0), (101, 20.0), (102, -14.0)] {
        text += &format!(
            "  {id}:\n    angle: [0.0, 0.0, 0.0]\n    center: [0.0, 0.0, 0.8]\n    extent: [2.0, 0.9, 0.8]\n    \
             location: [{}, {}, 0.0]\n    speed: 36.0\n",
            x + ahead,
            y + 3.0
        );
    }
    text
}

/// Some thousand points: a ground that differs a little per vehicle and tick, and the backs of the cars.
fn cloud(place: usize, tick: usize) -> PointCloud {
    let shift = 0.01 * (7 * place + tick) as f32;
    let ground = (0..2500).map(move |k| {
        [
            (k % 50) as f32 - 25.0 + shift,
            (k / 50) as f32 * 0.8 - 20.0,
            -1.9,
            0.1,
        ]
    });
    let cars = [12.0_f32, 20.0, -14.0].into_iter().flat_map(|ahead| {
        (0..200).map(move |k| {
            [
                ahead - 2.0,
                2.1 + (k % 20) as f32 * 0.09,
                -1.8 + (k / 20) as f32 * 0.15,
                0.6,
            ]
        })
    });
    PointCloud {
        xyzi: ground.chain(cars).collect(),
    }
}
