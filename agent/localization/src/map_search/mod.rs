//! Global localization in a surfel map, without a trained head and without an initial pose.
//!
//! Correlative scan matching by branch and bound over position and heading (Hess et al. 2016): the score of a pose is the
//! number of the sweep's upright planes that lie on a plane of the map of the same direction. The candidates with the highest
//! scores are registered (ICP). The share of the sweep's planes that agree with the map selects one, and accepts or rejects it.

mod branch_and_bound;
mod grid;
mod ground;

use std::collections::HashSet;
use std::path::Path;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use perception::weights::FileError;
use protocol::NoPoseReason;
use protocol::config::within;
use support::file_error::AtFile;
use support::sampling::evenly_spread;

use self::branch_and_bound::{BranchAndBound, PoseCandidate};
use self::grid::{CELL_M, RANGE_M, UprightGrid, UprightPlane, direction_bit};
use self::ground::{LevelSums, PlaceGround};
use crate::map_registration::{AGREED, SweepOnMap, found_pose};
use crate::pgc::localization::{SOLVE, VOXELISE};
use crate::pgc::{Localization, Localize, LocalizerError, LocalizerInput, stopwatch};
use crate::registration::icp::surfel_map::SurfelMap;
use crate::registration::icp::{IcpFit, MIN_POINTS, Plane};

/// Least and largest side of the voxels of a map that is searched, metres: planes of a sweep have those of half a metre.
const VOXELS_M: [f64; 2] = [0.3, 1.0];
/// Registered poses that are nearer to each other count as the same pose, metres.
const DISTINCT_M: f64 = 0.5;
/// Height of a sensor above ground that it does not see, metres: that of a LiDAR on a roof.
const USUAL_HEIGHT_M: f64 = 2.0;
/// Largest number of planes of a sweep that are matched.
const MAX_PLANES: usize = 160;
/// Largest number of candidates that are registered.
const MAX_CANDIDATES: usize = 12;
/// Once a pose is confirmed: smallest score of another candidate that is registered too, as a share of that of the first.
const RIVAL_SCORE: f64 = 0.85;
/// Smallest agreement of an accepted pose, and smallest difference to the agreement of any other candidate. Chosen on
/// validation drives.
const MIN_AGREEMENT: f64 = 0.35;
const MIN_MARGIN: f64 = 0.1;
/// Agreement by chance: the largest of the best poses of a town's sweeps on the map of another town.
const CHANCE: f64 = 0.2;
/// Planes that agree or disagree together: a wall's are fitted to the points of nine voxels.
const TOGETHER: f64 = 9.0;
/// Standard deviations that an accepted pose is above chance, and above any other candidate. The first was chosen on tuning
/// drives: of sweeps cropped to 8 to 20 m, 36 of 39 wrong poses are below it and 14 of 80 right ones; those of 30 m, of a
/// quarter of the lasers, of 90 degrees, in fog and in snow are at 8 and above.
const ABOVE_CHANCE_STD: f64 = 7.0;
const ABOVE_RIVAL_STD: f64 = 2.0;

/// Global localization in a surfel map.
#[derive(Debug)]
pub struct MapSearch {
    map: SurfelMap,
    grid: UprightGrid,
    ground: PlaceGround,
    /// Poses of less confidence are rejected.
    pub(crate) min_confidence: f64,
}

impl MapSearch {
    /// The search of the surfel map in a file; `None` of a file of another kind.
    ///
    /// # Errors
    /// [`FileError`] as [`SurfelMap::load`], and of a map that is empty, too large or too coarse.
    pub fn of_file(path: &Path) -> Result<Option<Self>, FileError> {
        if !SurfelMap::is_in(path) {
            return Ok(None);
        }
        let map = SurfelMap::load(path)?;
        let [least_m, most_m] = VOXELS_M;
        within("voxel_m of a searched map", map.voxel_m(), least_m, most_m).at(path)?;
        let planes: Vec<Plane> = map.target().finest_planes().collect();
        let problem = "global localization needs a map with planes, of at most 8 square kilometres";
        Ok(Some(Self {
            grid: UprightGrid::of(&planes).ok_or_else(|| FileError::new(path, problem))?,
            ground: PlaceGround::of(&planes),
            map,
            min_confidence: 0.0,
        }))
    }

    /// The registered pose with the largest agreement, the share of the sweep's planes that agree with the map. The flag is
    /// true if the pose is unambiguous: the agreement is significantly larger than that of any other pose and of a random
    /// one, and the search was complete. `None` where no candidate can be registered.
    fn best_pose(&self, sweep: &SweepOnMap<'_>) -> Option<(IcpFit, f64, bool)> {
        let (ground, _) = sweep.level_planes();
        let below = LevelSums::of(&ground);
        let levelled = below.levelled();
        let height_m = -below.height_m().unwrap_or(-USUAL_HEIGHT_M);
        let planes = planes_to_match(sweep.planes(), &levelled);
        let mut search = BranchAndBound::new(&self.grid, &planes);
        let mut fits: Vec<(IcpFit, f64, usize)> = Vec::new();
        let mut least = 1;
        for _ in 0..MAX_CANDIDATES {
            let Some(pose) = search.next(least) else {
                break;
            };
            let start = self.start(&pose, &levelled, height_m);
            let Some(fit) = start.and_then(|start| sweep.fit(&self.map, &start)) else {
                continue;
            };
            let (agreed, planes) = sweep.agreement(&self.map, &fit);
            fits.push((fit, agreed, planes));
            if agreed >= AGREED {
                least = least.max((RIVAL_SCORE * pose.matched as f64) as usize);
            }
        }
        let (fit, agreement, planes) = *fits.iter().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let others = fits
            .iter()
            .filter(|(other, ..)| distance_m(other, &fit) > DISTINCT_M);
        let rival = others.map(|(_, agreed, _)| *agreed).fold(0.0, f64::max);
        // A search that was cut short may have missed a better pose.
        let stands_out = stands_out(agreement, rival, planes) && !search.is_exhausted();
        Some((fit, agreement, stands_out))
    }

    /// A pose in the plane as one in the world, on the ground there; `None` where the map has no ground.
    fn start(
        &self,
        pose: &PoseCandidate,
        levelled: &UnitQuaternion<f64>,
        height_m: f64,
    ) -> Option<Isometry3<f64>> {
        let at_m = self.grid.centre_m(pose.position);
        let (ground_m, tilt) = self.ground.at(&at_m)?;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), pose.heading_rad);
        let position = Translation3::new(at_m.x, at_m.y, ground_m + height_m);
        Some(Isometry3::from_parts(position, tilt * turn * levelled))
    }
}

/// True if the agreement of as many planes is neither that of chance nor nearly that of a rival: of few planes, three in four
/// agree at a wrong pose, too. The lower confidence limit (Wilson 1927) is above chance.
fn stands_out(agreement: f64, rival: f64, planes: usize) -> bool {
    let std = |share: f64| (share * (1.0 - share) * TOGETHER / planes.max(1) as f64).sqrt();
    let margin = MIN_MARGIN.max(ABOVE_RIVAL_STD * std(agreement).hypot(std(rival)));
    agreement - CHANCE >= ABOVE_CHANCE_STD * std(CHANCE) && agreement - rival >= margin
}

fn distance_m(a: &IcpFit, b: &IcpFit) -> f64 {
    let [a, b] = [a, b].map(|fit| fit.target_from_source.translation.vector);
    (a - b).norm()
}

/// At most [`MAX_PLANES`] upright planes of a sweep, one per cell and direction, seen from above.
fn planes_to_match(planes: &[Plane], levelled: &UnitQuaternion<f64>) -> Vec<UprightPlane> {
    let turned = planes.iter().map(|plane| Plane {
        centre_m: levelled * plane.centre_m,
        normal: levelled * plane.normal,
    });
    let mut taken = HashSet::new();
    let planes: Vec<UprightPlane> = turned
        .filter_map(|plane| UprightPlane::of(&plane))
        .filter(|plane| plane.at_m.norm() < RANGE_M)
        .filter(|plane| {
            let cell: [i32; 2] = (plane.at_m / CELL_M).map(|at| at.floor() as i32).into();
            taken.insert((cell, direction_bit(plane.normal_rad)))
        })
        .collect();
    evenly_spread(&planes, MAX_PLANES)
}

impl Localize for MapSearch {
    /// The confidence is that of the registration; a pose at which too few planes agree is rejected.
    fn localize(&mut self, sweep: LocalizerInput<'_>) -> Result<Localization, LocalizerError> {
        let mut times = stopwatch();
        let on_map = SweepOnMap::new(sweep.cloud);
        if let Some(near) = on_map.near_prediction(&self.map, sweep.predicted, &mut times) {
            return Ok(near);
        }
        let enough = on_map.planes().len() >= MIN_POINTS;
        times.lap(VOXELISE);
        if !enough {
            return Ok(Localization::no_pose(NoPoseReason::TooFewPoints, times));
        }
        // The tracker asks from time to time without a prediction: only then the whole map is searched.
        if sweep.predicted.is_some() {
            return Ok(Localization::no_pose(NoPoseReason::TooFewInliers, times));
        }
        let best = self.best_pose(&on_map);
        times.lap(SOLVE);
        let Some((fit, agreement, stands_out)) = best else {
            return Ok(Localization::no_pose(NoPoseReason::TooFewInliers, times));
        };
        let mut found = found_pose(&fit, self.map.covariance_scale);
        found.evidence.inlier_ratio = agreement;
        let is_confirmed = agreement >= MIN_AGREEMENT
            && on_map.stands_on(&self.map, &found.world_from_sensor)
            && on_map.confirms(&self.map, &fit);
        found.is_rejected = !is_confirmed || !stands_out || found.sigma < self.min_confidence;
        Ok(Localization::new(&Ok(found), times))
    }

    fn place(&self) -> Option<&str> {
        Some(self.map.place.as_str()).filter(|place| !place.is_empty())
    }
}

#[cfg(test)]
mod tests {
    use std::path::PathBuf;

    use protocol::{PointCloud, PoseEstimate};

    use super::*;
    use crate::registration::icp::IcpTarget;

    /// Ground of 120 m by 120 m, 2 m below the origin, and houses of four walls that differ by the seed.
    fn town(seed: u32) -> Vec<[f32; 4]> {
        let ground = (0..160_000).map(|k| {
            [
                (k % 400) as f32 * 0.3 - 60.0,
                (k / 400) as f32 * 0.3 - 60.0,
                -2.0,
                0.1,
            ]
        });
        let houses = (0..24_u32).flat_map(|house| {
            let number = (house + 24 * seed).wrapping_mul(2_654_435_769);
            let [x, y, length] = [24, 16, 8].map(|shift| (number >> shift & 255) as f32 / 255.0);
            let length_m = 4.0 + 8.0 * length;
            let (sin, cos) = (house as f32 * 0.9).sin_cos();
            (0..4000).map(move |k: u32| {
                let along = ((k % 100) as f32 / 100.0 - 0.5) * length_m;
                let up = (k / 100 % 10) as f32 * 0.5 - 2.0;
                let [u, v] = match k / 1000 {
                    0 => [along, -0.5 * length_m],
                    1 => [along, 0.5 * length_m],
                    2 => [-0.5 * length_m, along],
                    _ => [0.5 * length_m, along],
                };
                let [x, y] = [x, y].map(|at| 100.0 * at - 50.0);
                [x + u * cos - v * sin, y + u * sin + v * cos, up, 0.1]
            })
        });
        ground.chain(houses).collect()
    }

    /// The town as a sensor sees it.
    fn seen_from(town: &[[f32; 4]], town_from_sensor: &Isometry3<f64>) -> PointCloud {
        let points = town.iter().map(|&[x, y, z, intensity]| {
            let at = town_from_sensor.inverse_transform_point(&[x, y, z].map(f64::from).into());
            let [x, y, z] = at.coords.cast::<f32>().into();
            [x, y, z, intensity]
        });
        PointCloud {
            xyzi: points.filter(|[x, y, ..]| x.hypot(*y) < 40.0).collect(),
        }
    }

    /// The map of a town in a file.
    fn stored() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("surfels.safetensors");
        let mut target = IcpTarget::new(&SurfelMap::building(0.5));
        target.add(&town(1), &Isometry3::identity());
        target.fit();
        SurfelMap::write(&path, "town", &target).unwrap();
        (folder, path)
    }

    #[test]
    fn a_sweep_is_found_wherever_it_was_taken_and_one_of_another_town_is_not() {
        let (_folder, path) = stored();
        let mut search = MapSearch::of_file(&path).unwrap().unwrap();
        for (x, y, heading_rad) in [(0.0, 0.0, 0.0), (17.3, -8.6, 2.1), (-21.8, 14.1, -1.3)] {
            let truth = Isometry3::new(Vector3::new(x, y, 0.1), Vector3::z() * heading_rad);
            let found = search
                .localize(LocalizerInput::of(&seen_from(&town(1), &truth)))
                .unwrap();
            let pose = found.estimate.world_from_cav().unwrap().isometry();
            let off = truth.inv_mul(&pose);
            assert!(
                off.translation.vector.norm() < 0.05 && off.rotation.angle() < 5e-3,
                "{off}"
            );
            assert!(found.inlier_ratio > 0.8, "{found:?}");
        }
        let elsewhere = seen_from(&town(2), &Isometry3::identity());
        let lost = search.localize(LocalizerInput::of(&elsewhere)).unwrap();
        assert!(
            matches!(lost.estimate, PoseEstimate::NoPose { .. }),
            "{lost:?}"
        );
        let empty = search
            .localize(LocalizerInput::of(&PointCloud::default()))
            .unwrap();
        assert!(matches!(empty.estimate, PoseEstimate::NoPose { .. }));
        assert_eq!(search.place(), Some("town"));
    }

    #[test]
    fn a_share_of_few_planes_is_not_taken_for_that_of_many() {
        // Of measured wrong poses, at 8 to 20 m of range.
        for (agreement, planes) in [(0.985, 66), (0.716, 162), (0.607, 201), (0.495, 311)] {
            assert!(
                !stands_out(agreement, 0.1, planes),
                "{agreement} of {planes}"
            );
        }
        // Of measured right ones: full sweeps, in fog, of a quarter of the lasers, at 30 m of range.
        for (agreement, planes) in [(0.780, 1910), (0.675, 765), (0.724, 351), (0.624, 672)] {
            assert!(
                stands_out(agreement, 0.1, planes),
                "{agreement} of {planes}"
            );
        }
        // Of many planes the least agreement decides, and the least margin.
        assert!(stands_out(MIN_AGREEMENT, 0.1, 4000));
        assert!(stands_out(0.8, 0.69, 2000) && !stands_out(0.8, 0.71, 2000));
        assert!(!stands_out(0.8, 0.69, 300), "a difference of chance");
        assert!(!stands_out(0.0, 0.0, 0));
    }

    #[test]
    fn a_pose_near_a_prediction_is_found_without_a_search_and_one_of_little_confidence_is_rejected()
    {
        let (_folder, path) = stored();
        let truth = Isometry3::new(Vector3::new(5.0, -3.0, 0.0), Vector3::z() * 0.4);
        let cloud = seen_from(&town(1), &truth);
        let near = LocalizerInput {
            predicted: Some(truth * Isometry3::translation(0.3, -0.2, 0.0)),
            ..LocalizerInput::of(&cloud)
        };
        let mut search = MapSearch::of_file(&path).unwrap().unwrap();
        let found = search.localize(near).unwrap();
        assert_eq!(found.inlier_ratio, 0.0, "the map was not searched");
        assert!(found.estimate.world_from_cav().is_some());
        let mut strict = MapSearch::of_file(&path).unwrap().unwrap();
        strict.min_confidence = 1.0;
        let rejected = strict.localize(LocalizerInput::of(&cloud));
        assert!(rejected.unwrap().found.unwrap().is_rejected);
    }

    #[test]
    fn a_file_of_another_kind_is_no_map() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("head.safetensors");
        std::fs::write(&file, "no map").unwrap();
        assert!(MapSearch::of_file(&file).unwrap().is_none());
    }
}
