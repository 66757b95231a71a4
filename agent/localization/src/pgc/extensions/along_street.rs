//! Search along the street, an extension: refinements that start before and behind a pose that few cells confirm.
//!
//! Poles, trees and parked vehicles stand in rows, and a pose one place further along the street fits almost as well.
//! Measured gain: none apart; the figures of [`super::other_parts`] include it.

use nalgebra::Translation3;
use support::stage_times::StageTimes;

use crate::pgc::pose_search::{Attempt, PoseSearch};
use crate::pgc::scene_coordinates::SceneCoordinates;

/// Starts of the refinements along the heading of the pose, metres.
const AHEAD_M: [f64; 4] = [-5.0, 5.0, -10.0, 10.0];

/// The better of `best`, which was found with `coordinates`, and the poses along its heading.
pub(crate) fn search(
    search: &PoseSearch<'_>,
    mut best: Attempt,
    coordinates: &SceneCoordinates,
    times: &mut StageTimes,
) -> tch::Result<Attempt> {
    let Ok(found) = &best.solved else {
        return Ok(best);
    };
    let origin = Translation3::from(coordinates.origin_m);
    let origin_from_sensor = origin.inverse() * found.world_from_sensor;
    for ahead_m in AHEAD_M {
        if best.is_sufficient() {
            break;
        }
        // On the right: along the vehicle's own x axis, which is its heading.
        let start = origin_from_sensor * Translation3::new(ahead_m, 0.0, 0.0);
        let start = search.solver.registration_at(coordinates, start);
        best = best.or_better(search.refined(coordinates, &start, true, times)?);
    }
    Ok(best)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use dataset::LoadOptions;
    use nalgebra::{Isometry3, Vector3};
    use perception::inference::Inference;
    use protocol::PointCloud;
    use simulator::generate::{Subset, SynthOptions, generate};

    use super::*;
    use crate::pgc::localization::stopwatch;
    use crate::pgc::localizer::CELLS;
    use crate::pgc::{Localizer, LocalizerInput};

    /// A sweep of town 1 and its pose.
    fn town1_sweep() -> (PointCloud, Isometry3<f64>) {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("scene");
        generate(
            &SynthOptions {
                frames: 1,
                ..SynthOptions::new(Subset::Town1loc, 450, out.clone())
            },
            &|_| (),
        )
        .unwrap();
        let frame = dataset::open(&out).unwrap().scenarios[0]
            .load(0, 0, &LoadOptions::default())
            .unwrap();
        (frame.points, frame.world_from_lidar.unwrap().isometry())
    }

    fn released(name: &str) -> std::path::PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR"))
            .join("../../deploy/weights")
            .join(name)
    }

    #[test]
    fn a_pose_further_along_the_street_is_mended() {
        tch::set_num_threads(1);
        let files = ["pgc-encoder.safetensors", "pgc-town1.safetensors"].map(released);
        let localizer = Localizer::load(&files[0], &files[1], Inference::default()).unwrap();
        let (cloud, truth) = town1_sweep();
        let mut times = stopwatch();
        let encoded = localizer
            .encode(LocalizerInput::of(&cloud), &mut times)
            .unwrap()
            .unwrap();
        let logits = localizer.classify(&encoded).unwrap();
        let coordinates = localizer
            .regress(&encoded, CELLS, &logits, &mut times)
            .unwrap();
        let search = localizer.search(&encoded);
        let solver = search.solver;
        let mut origin_from_sensor = truth;
        origin_from_sensor.translation.vector -= Vector3::from(coordinates.origin_m);
        for (ahead_m, is_mended) in [(-8.0, true), (9.0, true), (40.0, false)] {
            let wrong = solver.registration_at(
                &coordinates,
                origin_from_sensor * Translation3::new(ahead_m, 0.0, 0.0),
            );
            let inlier_ratio = wrong.inlier_ratio;
            let solved = Ok(solver.judge(&coordinates, &wrong, None));
            let wrong = Attempt {
                solved,
                inlier_ratio,
            };
            let found = super::search(&search, wrong, &coordinates, &mut times).unwrap();
            assert_eq!(
                found.is_sufficient(),
                is_mended,
                "{ahead_m} m ahead: {}",
                found.inlier_ratio
            );
            let pose = found.solved.unwrap().world_from_sensor;
            let off_m = (pose.translation.vector - truth.translation.vector).norm();
            assert_eq!(off_m < 0.3, is_mended, "{ahead_m} m ahead: {off_m} m");
        }
    }
}
