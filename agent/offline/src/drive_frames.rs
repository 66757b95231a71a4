//! Frames of drives: whether their sweeps agree where the drives meet by their poses, and where one comes back to its path.
//!
//! The poses of a drive may have a frame of its own, for example that of its SLAM, and a SLAM that does not close its loops
//! one for each lap. A map of drives in several frames is double, and gives poses in either of them.

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
/// Distance from a sweep at which a path has left it, metres: beyond both lanes of one road.
const LEFT_M: f64 = 20.0;
/// Laps of a drive that are compared, evenly spread: a second for ten comparisons.
const MOST_LAPS: usize = 8;
/// Shifts along x and y from which a registration starts, metres: it ends at the right pose from 2 m off.
const STARTS_M: [f64; 5] = [0.0, -3.0, 3.0, -6.0, 6.0];
/// Poses and offsets up to this far apart agree, metres: two voxels of a map.
const AGREED_M: f64 = 1.0;
/// Shares of the points above the ground with a partner from which a sweep agrees at rest, and with an offset where it does
/// not. On generated roads, of drives with other traffic, 0.41 to 0.67 in place and 0.24 at most elsewhere.
const AGREED: f64 = 0.25;
const CLEAR: f64 = 0.4;

/// A sweep on a map: agent, tick and `world_from_lidar`.
type MappedSweep = (usize, usize, Isometry3<f64>);

/// A drive and its sweeps on a map.
pub(crate) struct MappedDrive {
    pub(crate) scenario: Scenario,
    pub(crate) sweeps: Vec<MappedSweep>,
}

/// A problem for each drive, and each lap of one, whose sweeps agree with an offset only with those of the drive or lap before
/// it that it meets most, and the drives of which too few sweeps agree with any before them.
pub(crate) fn contradictions(drives: &[MappedDrive]) -> (Vec<Problem>, Vec<String>) {
    let (mut problems, unchecked) = compared(drives);
    for drive in drives {
        // Agents see one place from several sides: each is compared with itself.
        for path in drive.sweeps.chunk_by(|one, next| one.0 == next.0) {
            // Laps that agree nowhere tell nothing: a sensor with a narrow view sees a road anew on the way back.
            problems.extend(compared(&drive.laps(path)).0);
        }
    }
    (problems, unchecked)
}

/// The same of drives alone, or of the laps of one.
fn compared(drives: &[MappedDrive]) -> (Vec<Problem>, Vec<String>) {
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

/// Laps of a path: one ends where the path comes back.
fn laps(path: &[MappedSweep]) -> Vec<Vec<MappedSweep>> {
    let mut laps: Vec<Vec<MappedSweep>> = Vec::new();
    for sweep in path {
        match laps.last_mut().filter(|lap| !is_back(lap, sweep)) {
            Some(lap) => lap.push(*sweep),
            None => laps.push(vec![*sweep]),
        }
    }
    laps
}

/// True if a sweep is within [`NEAR_M`] of one before it, and one between them is more than [`LEFT_M`] away.
fn is_back(before: &[MappedSweep], (.., pose): &MappedSweep) -> bool {
    let place_m = pose.translation.vector;
    let off_m = before.iter().rev();
    let off_m = off_m.map(|(.., known)| (known.translation.vector - place_m).norm());
    let mut since_left_m = off_m.skip_while(|off_m| *off_m <= LEFT_M);
    since_left_m.any(|off_m| off_m <= NEAR_M)
}

impl MappedDrive {
    /// At most [`MOST_LAPS`] laps of a path of this drive, as drives whose names say which of its sweeps they are.
    fn laps(&self, path: &[MappedSweep]) -> Vec<Self> {
        let laps = evenly_spread(&laps(path), MOST_LAPS).into_iter();
        let named = laps.map(|sweeps| {
            let mut scenario = self.scenario.clone();
            let [first, last] = [sweeps.first(), sweeps.last()].map(|at| at.map_or(0, |at| at.1));
            scenario.name = format!("sweeps {first} to {last} of {}", self.scenario.name);
            Self { scenario, sweeps }
        });
        named.collect()
    }

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
        let pair = |(place, (.., pose)): (usize, &MappedSweep)| {
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
            let is_alike = |other: &&Vector3<f64>| (*other - one).norm() <= AGREED_M;
            offsets_m.iter().filter(is_alike).count()
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
            field: Some("world_from_lidar".to_owned()),
            message,
            ..Problem::default()
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use dataset::LoadOptions;

    use super::*;

    /// Sweeps of one agent at these places along x, metres.
    fn path(places_m: &[f64]) -> Vec<MappedSweep> {
        let sweeps = places_m.iter().enumerate();
        sweeps
            .map(|(tick, &x)| (0, tick, Isometry3::translation(x, 0.0, 0.0)))
            .collect()
    }

    #[test]
    fn a_lap_ends_where_a_path_comes_back_to_a_place_that_it_has_left() {
        let cases: [(&[f64], &[usize]); 5] = [
            (&[0.0, 0.0, 1.0, 0.0], &[4]),
            (&[0.0, 12.0, 18.0, 9.0, 0.0], &[5]),
            (&[0.0, 12.0, 24.0, 36.0, 24.0, 12.0, 0.0], &[5, 2]),
            (&[0.0, 15.0, 30.0, 1.0, 16.0, 31.0, 2.0], &[3, 3, 1]),
            (&[], &[]),
        ];
        for (places_m, counts) in cases {
            let found: Vec<usize> = laps(&path(places_m)).iter().map(Vec::len).collect();
            assert_eq!(found, counts, "{places_m:?}");
        }
    }

    /// A drive of two laps through houses at both sides of a road along x, as a KITTI sequence; the second with an offset to
    /// the side in its poses, metres.
    fn two_laps(folder: &Path, offset_m: f64) -> MappedDrive {
        std::fs::create_dir_all(folder.join("velodyne")).unwrap();
        let mut poses = String::new();
        let places = [0_u8, 6, 12, 18, 24, 30, 0, 6, 12, 18, 24, 30];
        for (sweep, place) in places.into_iter().enumerate() {
            let bytes = street(f32::from(place)).into_iter().flatten();
            let bytes: Vec<u8> = bytes.flat_map(f32::to_le_bytes).collect();
            std::fs::write(folder.join(format!("velodyne/{sweep:06}.bin")), bytes).unwrap();
            let y_m = if sweep < 6 { 0.0 } else { offset_m };
            poses += &format!("1 0 0 {place} 0 1 0 {y_m} 0 0 1 0\n");
        }
        std::fs::write(folder.join("calib.txt"), "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        std::fs::write(folder.join("poses.txt"), poses).unwrap();
        let scenario = dataset::open(folder).unwrap().scenarios.swap_remove(0);
        let sweep = |tick| {
            let options = LoadOptions::without_points();
            let frame = scenario.load(0, tick, &options).unwrap();
            (0, tick, frame.world_from_lidar.unwrap().isometry())
        };
        let sweeps = (0..places.len()).map(sweep).collect();
        MappedDrive { scenario, sweeps }
    }

    /// Ground, two walls along a road, and walls across it behind them, seen from a place along the road, metres.
    fn street(place_m: f32) -> Vec<[f32; 4]> {
        let ground = (0..12_000).map(|k| {
            let [x, y] = [(k % 200) as f32 * 0.5 - 35.0, (k / 200) as f32 * 0.5 - 15.0];
            [x, y, -2.0]
        });
        let walls = (0..24_000).map(|k| {
            let (along, up) = ((k % 300) as f32 * 0.3, (k / 300 % 20) as f32 * 0.3 - 2.0);
            match k / 6000 {
                0 => [along - 30.0, 9.0, up],
                1 => [along - 30.0, -7.0, up],
                // Ends of houses, at distances that do not repeat.
                side => {
                    let house = (k % 300 / 20) as f32;
                    let x = house * house * 0.6 - 30.0;
                    let deep = (k % 20) as f32 * 0.3;
                    [x, if side == 2 { 9.0 + deep } else { -7.0 - deep }, up]
                }
            }
        });
        let points = ground.chain(walls);
        points.map(|[x, y, z]| [x - place_m, y, z, 0.1]).collect()
    }

    #[test]
    fn a_drive_whose_second_lap_is_beside_its_first_is_named_and_a_sound_one_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let drives = [("00", 0.0), ("01", 4.0)];
        let [sound, torn] = drives.map(|(name, off_m)| {
            let (problems, unchecked) =
                contradictions(&[two_laps(&folder.path().join(name), off_m)]);
            assert!(unchecked.is_empty(), "{unchecked:?}");
            problems
        });
        assert!(sound.is_empty(), "{sound:?}");
        let [torn] = &torn[..] else {
            panic!("{torn:?}");
        };
        let message = &torn.message;
        assert!(
            message.contains("sweeps 6 to 11 of")
                && message.contains("sweeps 0 to 5 of")
                && message.contains(", -4.0, "),
            "{message}"
        );
    }
}
