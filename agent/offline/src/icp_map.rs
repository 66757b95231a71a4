//! ICP against a point-cloud map: registers the sweep against the accumulated sweeps of earlier drives.
//!
//! The baseline of pose generators: accurate if the start is near enough, but the point-cloud map has to be stored in
//! the vehicle and a receiver has to give the start.

use crate::Error;
use crate::drive_frames::{self, MappedDrive};
use crate::error::listed;
use crate::sweep_database::{open_drives, posed, present_sweeps};
use std::path::Path;
use std::sync::Arc;

use dataset::{LeftOut, LoadOptions, Problem, Scenario};
use nalgebra::Isometry3;
use protocol::{NoPoseReason, PoseEstimate};
use support::output;

use localization::pose_source::{NO_SOURCE, PoseInput, PoseSource, no_pose};
use localization::registration::icp::{self, IcpConfig, IcpSource, IcpTarget, NoIcpFit};

/// Registers every sweep against a point-cloud map, starting at the measured pose.
#[derive(Debug, Clone)]
pub struct IcpMapPose {
    map: Arc<IcpTarget>,
    config: IcpConfig,
}

impl IcpMapPose {
    /// Source with a point-cloud map that was built with the same settings.
    pub fn new(map: Arc<IcpTarget>, config: IcpConfig) -> Self {
        Self { map, config }
    }
}

impl PoseSource for IcpMapPose {
    /// The confidence is the share of points with a partner.
    fn estimate(&mut self, input: &PoseInput<'_>) -> PoseEstimate {
        let Some(start) = input.measured else {
            return NO_SOURCE;
        };
        let source = IcpSource::of_sweep(&input.cloud.xyzi);
        match icp::register(&source, &self.map, &start.isometry(), &self.config) {
            Ok(fit) => {
                let confidence = fit.overlap.clamp(0.0, 1.0) as f32;
                PoseEstimate::new(fit.target_from_source.into(), confidence)
            }
            Err(NoIcpFit::TooFew { .. }) => no_pose(NoPoseReason::TooFewPoints),
            Err(NoIcpFit::TooLittleOverlap(_) | NoIcpFit::Unconstrained(_)) => {
                no_pose(NoPoseReason::TooFewInliers)
            }
        }
    }
}

/// Checks the distance between two sweeps on a map.
///
/// # Errors
/// [`Error::Input`] when it is negative or not finite.
pub fn check_spacing(spacing_m: f64) -> Result<(), Error> {
    if spacing_m.is_finite() && spacing_m >= 0.0 {
        return Ok(());
    }
    Err(Error::Input(format!(
        "the distance between sweeps on the map is {spacing_m} m, must be 0 or more"
    )))
}

/// Builds a point-cloud map of drives with true poses: of every agent a sweep per `spacing_m` metres of path. Sweeps that
/// cannot be read or have no pose are left out and counted in `left_out`, which also gets the findings about the drives:
/// also that two of them are not in one frame.
///
/// # Errors
/// [`Error`] names the drive that cannot be opened, or all drives if no sweep has a pose or none of them has a plane; or the
/// distance is not valid.
pub fn read_map(
    folders: &[impl AsRef<Path>],
    spacing_m: f64,
    config: &IcpConfig,
    left_out: &mut LeftOut,
) -> Result<IcpTarget, Error> {
    check_spacing(spacing_m)?;
    let mut map = IcpTarget::new(config);
    let mut mapped = Vec::new();
    for folder in folders {
        let drives = open_drives(folder.as_ref(), left_out)?;
        let drives = drives.scenarios.into_iter();
        mapped.extend(drives.map(|drive| add_drive(&mut map, drive, spacing_m, left_out)));
    }
    let sweeps: usize = mapped.iter().map(|drive| drive.sweeps.len()).sum();
    let folders = || Vec::from_iter(folders.iter().map(|folder| folder.as_ref().to_owned()));
    if sweeps == 0 {
        return Err(Error::NoSweeps(folders(), left_out.reasons()));
    }
    mapped.retain(|drive| !drive.sweeps.is_empty());
    let (contradictions, unchecked) = drive_frames::contradictions(&mapped);
    left_out.add_findings(contradictions);
    if !unchecked.is_empty() {
        let unchecked = unchecked.join(", ");
        output::note(format_args!(
            "{unchecked}: nothing that agrees with the drives before: it is not checked whether their poses are in one frame"
        ));
    }
    map.fit();
    match map.planes() {
        0 => Err(Error::Input(format!(
            "{}: the map of {sweeps} sweeps has no plane: their points are too few or too far apart",
            listed(&folders())
        ))),
        _ => Ok(map),
    }
}

/// Adds a sweep per `spacing_m` metres of the path of every agent of a drive.
fn add_drive(
    map: &mut IcpTarget,
    scenario: Scenario,
    spacing_m: f64,
    left_out: &mut LeftOut,
) -> MappedDrive {
    let mut sweeps: Vec<(usize, usize, Isometry3<f64>)> = Vec::new();
    for (agent, tick) in present_sweeps(&scenario) {
        // Only the pose at first: points of sweeps that are not used need not be read.
        let without_points = LoadOptions::without_points();
        let mut load = |options: &LoadOptions| {
            let sweep = posed(&scenario, agent, tick, options);
            sweep
                .map_err(|error| left_out.add_unreadable(agent, Problem::from(&error)))
                .ok()
        };
        let Some((_, pose)) = load(&without_points) else {
            continue;
        };
        let pose = pose.isometry();
        // From the last sweep on the map, not from the one before: short steps add up.
        let last = sweeps.last().filter(|(of, ..)| *of == agent);
        let way_m =
            last.map(|(.., last)| (last.translation.vector - pose.translation.vector).norm());
        if way_m.is_none_or(|way_m| way_m >= spacing_m)
            && let Some((frame, _)) = load(&LoadOptions::default())
        {
            map.add(&frame.points.xyzi, &pose);
            sweeps.push((agent, tick, pose));
        }
    }
    MappedDrive { scenario, sweeps }
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, PointCloud, Pose};
    use simulator::generate::{Subset, SynthOptions, generate};

    use super::*;

    /// Ground and two pairs of walls around the origin, as measured from there.
    fn yard() -> PointCloud {
        let ground = (0..6400).map(|k| {
            [
                (k % 80) as f32 * 0.5 - 20.0,
                (k / 80) as f32 * 0.5 - 20.0,
                -2.0,
                0.1,
            ]
        });
        let wall = (0..4000).map(|k| {
            let (along, up, side) = (
                (k % 100) as f32 * 0.35 - 17.5,
                (k / 100 % 20) as f32 * 0.3 - 2.0,
                k / 2000,
            );
            if side == 0 {
                [along, 12.0, up, 0.1]
            } else {
                [-15.0, along, up, 0.1]
            }
        });
        PointCloud {
            xyzi: ground.chain(wall).collect(),
        }
    }

    #[test]
    fn sweeps_without_a_pose_are_named_and_fail_only_where_there_are_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let [without, with] = ["without", "with"].map(|name| {
            let out = folder.path().join(name);
            let options = SynthOptions {
                frames: 2,
                ..SynthOptions::new(Subset::Town1loc, 11, out.clone())
            };
            generate(&options, &|_| {}).unwrap();
            out
        });
        let scenario = dataset::open(&without).unwrap().scenarios.swap_remove(0);
        for tick in 0..2 {
            let points = scenario.points_path(0, tick, None).unwrap();
            let file = points.with_extension("yaml");
            let text = std::fs::read_to_string(&file).unwrap();
            std::fs::write(&file, text.replace("lidar_pose", "other_pose")).unwrap();
        }
        let config = IcpConfig::default();
        let mut left_out = LeftOut::default();
        let map = read_map(&[&without, &with], 0.0, &config, &mut left_out).unwrap();
        assert!(map.planes() > 0 && left_out.ticks == 2, "{left_out}");
        let problems = left_out.reasons();
        assert!(
            problems.contains("there is no pose for this sweep"),
            "{problems}"
        );
        let none = read_map(&[&without], 0.0, &config, &mut left_out).unwrap_err();
        assert!(matches!(none, Error::NoSweeps(..)), "{none}");
    }

    /// A KITTI sequence of two sweeps of two points each, whose intensities are below 0.
    fn sparse_drive(folder: &Path) {
        std::fs::create_dir_all(folder.join("velodyne")).unwrap();
        let points = [[7.0_f32, 1.0, 0.5, -0.1], [-9.0, 4.0, 1.5, -0.1]];
        let bytes: Vec<u8> = (points.iter().flatten())
            .flat_map(|value| value.to_le_bytes())
            .collect();
        for scan in ["000000", "000001"] {
            let file = folder.join("velodyne").join(scan).with_extension("bin");
            std::fs::write(file, &bytes).unwrap();
        }
        std::fs::write(folder.join("calib.txt"), "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 2 0 1 0 0 0 0 1 0\n";
        std::fs::write(folder.join("poses.txt"), poses).unwrap();
    }

    #[test]
    fn a_map_without_a_plane_is_refused_and_findings_are_kept() {
        let folder = tempfile::tempdir().unwrap();
        let drive = folder.path().join("00");
        sparse_drive(&drive);
        let (config, mut left_out) = (IcpConfig::default(), LeftOut::default());
        let refused = read_map(&[&drive], 0.0, &config, &mut left_out).unwrap_err();
        let message = refused.to_string();
        assert!(
            refused.is_bad_input() && message.contains("the map of 2 sweeps has no plane"),
            "{message}"
        );
        // A finding leaves nothing out.
        assert!(
            left_out.is_nothing() && left_out != LeftOut::default(),
            "{left_out}"
        );
    }

    /// A KITTI sequence through the yard whose poses have an offset, metres.
    fn yard_drive(folder: &Path, offset_m: [f64; 3]) {
        std::fs::create_dir_all(folder.join("velodyne")).unwrap();
        let [x_m, y_m, z_m] = offset_m;
        let mut poses = String::new();
        for sweep in 0..6_u8 {
            let points = yard().xyzi.into_iter();
            let bytes = points.flat_map(|[x, y, z, _]| [x - f32::from(sweep), y, z, 0.1]);
            let bytes: Vec<u8> = bytes.flat_map(f32::to_le_bytes).collect();
            std::fs::write(folder.join(format!("velodyne/{sweep:06}.bin")), bytes).unwrap();
            let along_m = x_m + f64::from(sweep);
            poses += &format!("1 0 0 {along_m} 0 1 0 {y_m} 0 0 1 {z_m}\n");
        }
        std::fs::write(folder.join("calib.txt"), "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap();
        std::fs::write(folder.join("poses.txt"), poses).unwrap();
    }

    #[test]
    fn drives_in_different_frames_are_named_where_they_meet() {
        let folder = tempfile::tempdir().unwrap();
        let drive = |name: &str, offset_m| {
            let drive = folder.path().join(name);
            yard_drive(&drive, offset_m);
            drive
        };
        let first = drive("00", [0.0; 3]);
        let findings = |other: &Path| {
            let mut left_out = LeftOut::default();
            let config = IcpConfig::default();
            read_map(&[first.as_path(), other], 0.0, &config, &mut left_out).unwrap();
            serde_json::to_string(&left_out).unwrap()
        };
        let wrong = "not in the frame of those of";
        let shifted = findings(&drive("01", [4.0, -3.0, 0.0]));
        assert!(
            shifted.contains(wrong) && shifted.contains("(-4.0, 3.0, "),
            "{shifted}"
        );
        // The same frame, another floor, and a drive elsewhere.
        for (name, offset_m) in [
            ("02", [0.0; 3]),
            ("03", [0.0, 0.0, 3.0]),
            ("04", [500.0, 0.0, 0.0]),
        ] {
            let sound = findings(&drive(name, offset_m));
            assert!(!sound.contains(wrong), "{name}: {sound}");
        }
    }

    #[test]
    fn a_vehicle_is_localized_on_the_point_cloud_map() {
        let config = IcpConfig::default();
        let truth = Pose::from_xyz_yaw([1200.0, -340.0, 20.0], 0.8);
        let mut map = IcpTarget::new(&config);
        map.add(&yard().xyzi, &truth.isometry());
        map.fit();
        let mut source = IcpMapPose::new(Arc::new(map), config);
        let (cav, cloud) = (CavId::new("7").unwrap(), yard());
        let measured = Pose::from_xyz_yaw([1200.7, -340.9, 20.3], 0.83);
        let mut input = PoseInput {
            cav: &cav,
            capture_nanos: 0,
            cloud: &cloud,
            levels: None,
            measured: Some(&measured),
            motion: protocol::EgoMotion::default(),
        };
        let estimate = source.estimate(&input);
        let off = truth
            .from_world(estimate.world_from_cav().unwrap())
            .isometry();
        assert!(
            off.translation.vector.norm() < 0.01 && off.rotation.angle() < 1e-3,
            "{off}"
        );
        assert!(estimate.confidence() > 0.9);

        let empty = PointCloud::default();
        input.cloud = &empty;
        assert_eq!(source.estimate(&input), no_pose(NoPoseReason::TooFewPoints));
        let elsewhere = Pose::from_xyz_yaw([5000.0, 0.0, 0.0], 0.0);
        input = PoseInput {
            cloud: &cloud,
            measured: Some(&elsewhere),
            ..input
        };
        assert_eq!(
            source.estimate(&input),
            no_pose(NoPoseReason::TooFewInliers)
        );
        input.measured = None;
        assert_eq!(source.estimate(&input), NO_SOURCE);
    }
}
