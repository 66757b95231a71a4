//! Frames of drives: whether their sweeps agree where the drives meet by their poses.
//!
//! The poses of a drive may have a frame of its own, for example that of its SLAM. A map of drives in several frames is
//! double, and gives poses in either of them.

use dataset::{Problem, Scenario};
use localization::registration::icp::{IcpConfig, IcpSource, IcpTarget, register};
use nalgebra::{Isometry3, Translation3, Vector3};
use support::sampling::evenly_spread;

/// Sweeps of a drive that are compared, evenly spread.
const COMPARED: usize = 5;
/// Fewest of them with the same offset: one may be of a place that has changed.
const LEAST_ALIKE: usize = 2;
/// Sweeps up to this far apart are of one road, metres; and in height, where floors and bridges lie farther apart.
const NEAR_M: f64 = 10.0;
const SAME_LEVEL_M: f64 = 2.0;
/// Shifts along x and y from which a registration starts, metres: it ends at the right pose from 2 m off.
const STARTS_M: [f64; 5] = [0.0, -3.0, 3.0, -6.0, 6.0];
/// Poses and offsets up to this far apart agree, metres: two voxels of a map.
const AGREED_M: f64 = 1.0;
/// Shares of the points above the ground with a partner from which a sweep agrees at rest, and with an offset where it does
/// not. On generated roads, of drives with other traffic, 0.41 to 0.67 in place and 0.24 at most elsewhere.
const AGREED: f64 = 0.25;
const CLEAR: f64 = 0.4;

/// A drive and its sweeps on a map: agent, tick and `world_from_lidar`.
pub(crate) struct MappedDrive {
    pub(crate) scenario: Scenario,
    pub(crate) sweeps: Vec<(usize, usize, Isometry3<f64>)>,
}

/// A problem for each drive whose sweeps agree with an offset only with those of the drive before it that it meets most,
/// and the drives of which too few sweeps agree with any before them.
pub(crate) fn contradictions(drives: &[MappedDrive]) -> (Vec<Problem>, Vec<String>) {
    let (mut problems, mut unchecked) = (Vec::new(), Vec::new());
    for (place, drive) in drives.iter().enumerate().skip(1) {
        let before = drives.iter().take(place);
        let meetings = before.map(|known| (known, drive.pairs(known)));
        let met = meetings.max_by_key(|(_, pairs)| pairs.len());
        let agreed =
            met.and_then(|(known, pairs)| Some((known, drive.usual_offset(known, &pairs)?)));
        match agreed {
            Some((known, (offset_m, counts))) if offset_m.norm() > AGREED_M => {
                problems.push(drive.contradiction(known, &offset_m, counts));
            }
            Some(_) => {}
            None => unchecked.push(drive.name()),
        }
    }
    (problems, unchecked)
}

impl MappedDrive {
    /// Folder of its first sweep, and its scenario.
    fn name(&self) -> String {
        let first = self.sweeps.first();
        let path = first.and_then(|at| self.scenario.points_path(at.0, at.1, None).ok());
        let path = path.unwrap_or_default();
        let folder = path.parent().unwrap_or(&path).display();
        format!("{folder} ({})", self.scenario.name)
    }

    /// Places of its sweeps and of the nearest ones of another drive, where they are of one road.
    fn pairs(&self, known: &Self) -> Vec<[usize; 2]> {
        let pair = |(place, (.., pose)): (usize, &(usize, usize, Isometry3<f64>))| {
            let position_m = &pose.translation.vector;
            let off_m = known
                .sweeps
                .iter()
                .map(|(.., pose)| pose.translation.vector - position_m);
            let near = (off_m.enumerate())
                .filter(|(_, off_m)| off_m.norm() <= NEAR_M && off_m.z.abs() <= SAME_LEVEL_M);
            let nearest = near.min_by(|(_, a), (_, b)| a.norm().total_cmp(&b.norm()));
            nearest.map(|(other, _)| [place, other])
        };
        self.sweeps.iter().enumerate().filter_map(pair).collect()
    }

    /// The offset at which most of the compared sweeps agree with another drive, metres, with the number of these and of all;
    /// `None` if fewer than [`LEAST_ALIKE`] agree at one.
    fn usual_offset(
        &self,
        known: &Self,
        pairs: &[[usize; 2]],
    ) -> Option<(Vector3<f64>, [usize; 2])> {
        let compared = evenly_spread(pairs, COMPARED);
        let offsets_m = compared
            .iter()
            .filter_map(|pair| self.offset_m(known, *pair));
        let offsets_m: Vec<Vector3<f64>> = offsets_m.collect();
        let alike = |one: &Vector3<f64>| {
            let alike = offsets_m
                .iter()
                .filter(|other| (*other - one).norm() <= AGREED_M);
            alike.count()
        };
        let offset_m = offsets_m.iter().max_by_key(|offset_m| alike(offset_m))?;
        let count = alike(offset_m);
        (count >= LEAST_ALIKE).then_some((*offset_m, [count, compared.len()]))
    }

    fn contradiction(&self, known: &Self, offset_m: &Vector3<f64>, counts: [usize; 2]) -> Problem {
        let [path, other] = [self, known].map(Self::name);
        let [x, y, z]: [f64; 3] = (*offset_m).into();
        let [alike, count] = counts;
        let message = format!(
            "{path}: its poses are not in the frame of those of {other}: {alike} of {count} sweeps fit there with an offset of \
             ({x:.1}, {y:.1}, {z:.1}) m, and not without it: a map of both is double"
        );
        Problem {
            path,
            line: None,
            field: Some("world_from_lidar".to_owned()),
            message,
        }
    }

    /// Planes of the sweep at a place and of those before and after it.
    fn planes(&self, place: usize, config: &IcpConfig) -> Option<IcpTarget> {
        let mut target = IcpTarget::new(config);
        let around = self.sweeps.iter().skip(place.saturating_sub(1)).take(3);
        for (agent, tick, pose) in around {
            let cloud = self.scenario.load_points(*agent, *tick, None).ok()?;
            target.add(&cloud.points.xyzi, pose);
        }
        target.fit();
        Some(target)
    }

    /// The offset at which a sweep agrees with those of another drive around it, metres: zero where it does at rest, and
    /// `None` where it agrees nowhere.
    fn offset_m(&self, known: &Self, [place, other]: [usize; 2]) -> Option<Vector3<f64>> {
        let config = IcpConfig::default();
        let target = known.planes(other, &config)?;
        let (agent, tick, stated) = self.sweeps.get(place)?;
        let cloud = self.scenario.load_points(*agent, *tick, None).ok()?;
        let source = IcpSource::of_sweep(&cloud.points.xyzi);
        let (mut best, mut best_m) = (0.0, Vector3::zeros());
        for [x, y] in STARTS_M.into_iter().flat_map(|x| STARTS_M.map(|y| [x, y])) {
            let start = Translation3::new(x, y, 0.0) * stated;
            let Ok(fit) = register(&source, &target, &start, &config) else {
                continue;
            };
            let share = fit.overlap_above_ground;
            let by_m = fit.target_from_source.translation.vector - stated.translation.vector;
            // Mostly the first start, so that no other is tried.
            if share >= AGREED && by_m.norm() <= AGREED_M {
                return Some(Vector3::zeros());
            }
            if share > best {
                (best, best_m) = (share, by_m);
            }
        }
        (best >= CLEAR).then_some(best_m)
    }
}
