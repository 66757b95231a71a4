//! Picture of a run: the frame with the most neighbours, with the points of every fused vehicle.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use dataset::LoadOptions;
use deploy::score::{FrameScores, JudgedFrame};
use protocol::{CavId, Pose};

use crate::fleet::Fleet;
use crate::run::picture::{CavView, Picture};

/// Margin around boxes and vehicles, metres.
const MARGIN_M: f64 = 12.0;

/// Draws that frame of a run. A picture that cannot be drawn is a warning: the run itself is complete.
pub fn draw(fleet: &Fleet, scores: &FrameScores, path: &Path) -> Option<PathBuf> {
    match try_draw(fleet, scores.showpiece()?, path) {
        Ok(()) => Some(path.to_path_buf()),
        Err(error) => {
            tracing::warn!("no picture of the run: {error}");
            None
        }
    }
}

fn try_draw(fleet: &Fleet, frame: &JudgedFrame, path: &Path) -> Result<()> {
    let world_from_ego =
        pose_of(frame, &fleet.ego).context("the truth names no pose of the ego")?;
    let scenario = &fleet.recorded;
    let options = LoadOptions {
        lidar_variant: fleet.scenario.scene.variant.clone(),
        ..LoadOptions::default()
    };
    let fused = frame.result.fused.iter().map(|neighbour| &neighbour.cav);
    let shown = std::iter::once(&fleet.ego).chain(fused);
    let mut loaded = Vec::new();
    for cav in shown {
        let index = scenario.agents.iter().position(|agent| agent == cav);
        let (Some(index), Some(world_from_cav)) = (index, pose_of(frame, cav)) else {
            continue;
        };
        let recorded = scenario.load(index, usize::try_from(frame.tick)?, &options)?;
        // By the true poses, so that the points show no errors of localization.
        let ego_from_cav = world_from_ego.from_world(&world_from_cav);
        loaded.push((cav.to_string(), ego_from_cav, recorded.points.xyzi));
    }
    let rule = fleet.applied_protocol().ground_truth;
    let found = frame.result.detections.iter();
    let detections: Vec<_> = found.map(|found| (found.box3d, found.score)).collect();
    let [x_m, y_m] = [(0, rule.x_m), (1, rule.y_m)].map(|(axis, limit): (usize, [f64; 2])| {
        let found = detections.iter().map(|(found, _)| found);
        let boxes = frame.truth.iter().chain(found);
        let boxes = boxes.map(|shape| shape.center_m[axis]);
        let vehicles = loaded.iter();
        let vehicles = vehicles.map(|(_, ego_from_cav, _)| ego_from_cav.translation_m[axis]);
        around(boxes.chain(vehicles), limit)
    });
    let views = loaded.iter().map(|(name, ego_from_cav, xyzi)| CavView {
        name: name.clone(),
        ego_from_cav: *ego_from_cav,
        xyzi,
    });
    let (method, tick, name) = (fleet.scenario.method, frame.tick, &scenario.name);
    Picture {
        title: format!("{method}  tick {tick} (most neighbours)  {name}"),
        x_m,
        y_m,
        views: views.collect(),
        truth: frame.truth.clone(),
        detections,
    }
    .save(path)?;
    Ok(())
}

/// True pose of a vehicle.
fn pose_of(frame: &JudgedFrame, cav: &CavId) -> Option<Pose> {
    let mut poses = frame.world_from_lidar.iter();
    Some(poses.find(|(known, _)| known == cav)?.1)
}

/// Range of the places and a margin around it, metres, within a limit: the rest of the limit is empty.
fn around(places: impl Iterator<Item = f64>, [low, high]: [f64; 2]) -> [f64; 2] {
    let inside = places.filter(|place| (low..=high).contains(place));
    let ends = inside.map(|place| (place, place));
    match ends.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) {
        Some((first, last)) => [(first - MARGIN_M).max(low), (last + MARGIN_M).min(high)],
        None => [low, high],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_shows_what_is_there_within_the_evaluated_area() {
        assert_eq!(
            around([3.0, -20.0, 500.0, f64::NAN].into_iter(), [-140.0, 140.0]),
            [-32.0, 15.0]
        );
        assert_eq!(
            around([-45.0, 30.0].into_iter(), [-40.0, 40.0]),
            [18.0, 40.0]
        );
        assert_eq!(around([].into_iter(), [-40.0, 40.0]), [-40.0, 40.0]);
    }
}
