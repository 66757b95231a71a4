//! Check of a new head on held-out sweeps, and examples of right and wrong poses for its confidence.
//!
//! Wrong poses come from mirrored sweeps: a street with left and right exchanged is another place, seen by the same LiDAR.

use std::time::Instant;

use protocol::{PointCloud, Pose};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::evaluation::EvaluatedSweep;
use crate::training::{SweepList, thin_and_turn, yaw};
use localization::pgc::confidence::{BAD_M, Labelled};
use localization::pgc::{Localize, Localizer, LocalizerError, LocalizerInput};

/// Fewest examples of either kind; of fewer sweeps there are rotated and subsampled copies.
pub(super) const LEAST_CHECKED: usize = 45;
/// Largest rotation of a copy, radians.
const TURN_RAD: f64 = 0.17;
/// Smallest share of points in a copy.
const KEEP: f64 = 0.7;

/// Results on held-out sweeps.
#[derive(Debug, Default)]
pub(super) struct Check {
    /// The sweeps as they are.
    pub(super) sweeps: Vec<EvaluatedSweep>,
    /// Their copies.
    pub(super) copies: Vec<EvaluatedSweep>,
    /// Poses of these, of copies and of mirrored sweeps, with their errors.
    pub(super) labelled: Vec<Labelled>,
}

/// Localizes the sweeps of `list` and their mirror images, then copies of both until `deadline`; `progress` gets the
/// number done and of all. Sweeps that cannot be read are left out and counted in `list`.
pub(super) fn check(
    localizer: &mut Localizer,
    list: &SweepList,
    seed: u64,
    deadline: Instant,
    progress: &mut dyn FnMut(usize, usize),
) -> Result<Check, LocalizerError> {
    let copies = LEAST_CHECKED.div_ceil(list.len().max(1));
    let mut check = Check::default();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    for number in 0..copies * list.len() {
        let (copy, index) = (number / list.len(), number % list.len());
        // Every sweep is checked as it is, however late; only copies depend on the time.
        if copy > 0 && Instant::now() > deadline {
            break;
        }
        progress(number, copies * list.len());
        let Some((frame, scenario, stem)) = list.frame(index) else {
            continue;
        };
        let Some(truth) = frame.world_from_lidar else {
            continue;
        };
        let (mut cloud, truth) = match copy {
            0 => (frame.points, truth),
            _ => turned(&frame.points, &truth, &mut rng),
        };
        let sweep = EvaluatedSweep {
            scenario,
            cav: frame.cav,
            stem,
            truth,
            is_covered: None,
            localization: localizer.localize(LocalizerInput::of(&cloud))?,
        };
        check.labelled.extend(sweep.labelled());
        cloud.mirror();
        let mirrored = EvaluatedSweep {
            localization: localizer.localize(LocalizerInput::of(&cloud))?,
            ..sweep.clone()
        };
        // A straight street is its own mirror image: a pose near the true one is no example of a wrong pose.
        let wrong = mirrored.labelled();
        let wrong = wrong.filter(|labelled| labelled.error_m > BAD_M);
        check.labelled.extend(wrong);
        match copy {
            0 => check.sweeps.push(sweep),
            _ => check.copies.push(sweep),
        }
    }
    Ok(check)
}

/// The sweep of a sensor that is rotated about the vertical by a random angle, with a part of the points.
fn turned(cloud: &PointCloud, world_from_sensor: &Pose, rng: &mut impl Rng) -> (PointCloud, Pose) {
    let turned_from_sensor = yaw(rng.random_range(-TURN_RAD..TURN_RAD));
    let keep = rng.random_range(KEEP..1.0);
    let mut xyzi = cloud.xyzi.clone();
    thin_and_turn(&mut xyzi, &turned_from_sensor, keep, rng);
    let world_from_turned = world_from_sensor.isometry() * turned_from_sensor.inverse();
    (PointCloud { xyzi }, world_from_turned.into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_point_keeps_its_place_in_the_world_when_the_sensor_is_turned() {
        let cloud = PointCloud {
            xyzi: vec![[10.0, -3.0, 1.0, 0.5]; 200],
        };
        let pose = Pose::from_xyz_yaw([5.0, 6.0, 2.0], 0.7);
        let (copy, turned_pose) = turned(&cloud, &pose, &mut ChaCha8Rng::seed_from_u64(3));
        assert!((100..200).contains(&copy.len()));
        let [before, after] =
            [(&pose, cloud.xyzi[0]), (&turned_pose, copy.xyzi[0])].map(|(pose, [x, y, z, _])| {
                pose.isometry() * nalgebra::Point3::new(x, y, z).cast::<f64>()
            });
        let moved = before - after;
        assert!(moved.norm() < 1e-5, "{moved}");
        let mut mirrored = cloud;
        mirrored.mirror();
        assert_eq!(mirrored.xyzi[0], [10.0, 3.0, 1.0, 0.5]);
    }
}
