//! Data set reader: the sweeps and objects of every vehicle in the first ticks of each scenario.
//!
//! `read_frames FOLDER`, for a folder in any layout that `sim-replay inspect` knows.

use std::path::PathBuf;

use dataset::LoadOptions;
use dataset::ground_truth::{GroundTruth, GroundTruthRule};

const TICKS: usize = 3;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder: PathBuf = std::env::args_os().nth(1).ok_or("which folder?")?.into();
    let dataset = dataset::open(&folder)?;
    for scenario in &dataset.scenarios {
        println!("{}: {} ticks", scenario.name, scenario.ticks.len());
        for tick in 0..scenario.ticks.len().min(TICKS) {
            // A vehicle without a frame at this tick is left out; the ego, the first, has one.
            let present =
                (0..scenario.agents.len()).filter(|agent| scenario.is_present(*agent, tick));
            let frames = present
                .map(|agent| scenario.load(agent, tick, &LoadOptions::default()))
                .collect::<Result<Vec<_>, _>>()?;
            for frame in &frames {
                let points = frame.points.xyzi.len();
                println!("  tick {tick}, vehicle {}: {points} points", frame.cav);
            }
            // Objects that any vehicle has annotated, in the LiDAR frame of the ego.
            let frames: Vec<_> = frames.iter().collect();
            let truth = GroundTruth::of_tick(&frames, 0, &GroundTruthRule::OPV2V);
            for object in &truth.objects {
                let [x, y, _] = object.box3d.center_m;
                println!("    object {}: x {x:.1} y {y:.1} m", object.id);
            }
        }
    }
    Ok(())
}
