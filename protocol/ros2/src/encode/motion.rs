//! Poses, odometry, transforms and the clock.

use protocol::{CavId, EgoMotion, PlanarCovariance, Pose};

use super::Mount;
use crate::cdr;
use crate::names::{FrameNames, MAP_FRAME};

/// Variance of what is not measured, square metres or square radians: so large that a filter gives it no weight. Zero
/// would claim an exact value.
const UNMEASURED: f64 = 1e6;
/// Variances of a measured speed (0.1 m/s) and yaw rate (0.01 rad/s): usual values of wheels and gyroscopes, as messages
/// have none.
const SPEED_VARIANCE: f64 = 1e-2;
const YAW_RATE_VARIANCE: f64 = 1e-4;

/// `geometry_msgs/PoseWithCovarianceStamped`: a pose in the world, `world_from_lidar` of a vehicle for example.
pub fn pose(nanos: u64, world_from_lidar: &Pose, covariance: Option<&PlanarCovariance>) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, MAP_FRAME);
        cdr::pose(cdr, world_from_lidar);
        cdr::f64s(cdr, pose_covariance(covariance).as_flattened());
    })
}

/// `nav_msgs/Odometry`: the same, with the motion in the LiDAR's frame.
pub(crate) fn odometry(
    nanos: u64,
    lidar_frame: &str,
    world_from_lidar: &Pose,
    covariance: Option<&PlanarCovariance>,
    motion: EgoMotion,
) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr::header(cdr, nanos, MAP_FRAME);
        cdr.write_string(lidar_frame);
        cdr::pose(cdr, world_from_lidar);
        cdr::f64s(cdr, pose_covariance(covariance).as_flattened());
        cdr::f64s(cdr, &[motion.speed_mps.unwrap_or(0.0), 0.0, 0.0]);
        cdr::f64s(cdr, &[0.0, 0.0, motion.yaw_rate_rad_s.unwrap_or(0.0)]);
        cdr::f64s(cdr, twist_covariance(motion).as_flattened());
    })
}

/// Covariance of a pose, rows of x, y, z and of the rotations about them, of which position and yaw in the plane are measured.
pub(super) fn pose_covariance(planar: Option<&PlanarCovariance>) -> [[f64; 6]; 6] {
    // Height, roll and pitch have no variance in a planar covariance.
    let mut rows = diagonal([UNMEASURED; 6]);
    let [x, y, _, _, _, yaw] = &mut rows;
    if let Some(planar) = planar {
        (x[0], x[1]) = (planar.xx_m2.into(), planar.xy_m2.into());
        (y[0], y[1]) = (planar.xy_m2.into(), planar.yy_m2.into());
        yaw[5] = planar.yaw_rad2.into();
    }
    rows
}

/// Covariance of a motion of which speed and yaw rate are measured, or not.
fn twist_covariance(motion: EgoMotion) -> [[f64; 6]; 6] {
    let speed = motion.speed_mps.map_or(UNMEASURED, |_| SPEED_VARIANCE);
    let yaw_rate = motion
        .yaw_rate_rad_s
        .map_or(UNMEASURED, |_| YAW_RATE_VARIANCE);
    diagonal([
        speed, UNMEASURED, UNMEASURED, UNMEASURED, UNMEASURED, yaw_rate,
    ])
}

fn diagonal(variances: [f64; 6]) -> [[f64; 6]; 6] {
    let mut rows = [[0.0; 6]; 6];
    // From one place of the diagonal to the next it is a row and a column.
    let places = rows.as_flattened_mut().iter_mut().step_by(7);
    for (place, variance) in places.zip(variances) {
        *place = variance;
    }
    rows
}

/// A frame in another one: parent, child and `parent_from_child`.
pub type FrameInParent = (String, String, Pose);

/// The body of a vehicle, fixed to its LiDAR. The LiDAR is the parent, as its pose is the one that is estimated.
pub fn body_in_lidar(names: &FrameNames, cav: &CavId, mount: &Mount) -> FrameInParent {
    let lidar_from_base = mount.base_from_lidar.isometry().inverse().into();
    (names.lidar(cav), names.base(cav), lidar_from_base)
}

/// `tf2_msgs/TFMessage` for `/tf_static`: the bodies of vehicles.
pub fn static_transforms<'a>(
    nanos: u64,
    vehicles: impl Iterator<Item = &'a CavId>,
    mount: &Mount,
) -> Vec<u8> {
    let names = FrameNames::default();
    let bodies: Vec<_> = vehicles
        .map(|cav| body_in_lidar(&names, cav, mount))
        .collect();
    transforms(nanos, &bodies)
}

/// `tf2_msgs/TFMessage`.
pub fn transforms(nanos: u64, frames: &[FrameInParent]) -> Vec<u8> {
    cdr::message(|cdr| {
        cdr.write_sequence_length(frames.len());
        for (parent, child, parent_from_child) in frames {
            cdr::header(cdr, nanos, parent);
            cdr.write_string(child);
            cdr::pose(cdr, parent_from_child);
        }
    })
}

/// `rosgraph_msgs/Clock`.
pub fn clock(nanos: u64) -> Vec<u8> {
    cdr::message(|cdr| cdr::time(cdr, nanos))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn f64s(values: &[f64]) -> Vec<u8> {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    }

    #[test]
    fn a_transform_is_laid_out_as_ros_lays_it_out() {
        let cdr = transforms(
            1_000_000_002,
            &[(
                MAP_FRAME.into(),
                "ab".into(),
                Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.0),
            )],
        );
        let mut expected = vec![0, 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0];
        expected.extend(b"\x04\0\0\0map\0\x03\0\0\0ab\0");
        // Numbers are aligned to multiples of their size, counted from the end of the header.
        expected.extend([0; 5]);
        expected.extend(f64s(&[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]));
        assert_eq!(cdr, expected);
    }

    #[test]
    fn a_pose_has_the_covariance_of_the_plane_and_claims_nothing_else() {
        let planar = PlanarCovariance {
            xx_m2: 0.25,
            xy_m2: 0.125,
            yy_m2: 0.5,
            yaw_rad2: 0.0625,
        };
        let cdr = pose(
            3_000_000_004,
            &Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.0),
            Some(&planar),
        );
        let mut expected = vec![0, 1, 0, 0, 3, 0, 0, 0, 4, 0, 0, 0];
        expected.extend(b"\x04\0\0\0map\0");
        expected.extend(f64s(&[1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]));
        let mut covariance = [0.0; 36];
        (covariance[0], covariance[1], covariance[6], covariance[7]) = (0.25, 0.125, 0.125, 0.5);
        covariance[35] = 0.0625;
        [14, 21, 28]
            .into_iter()
            .for_each(|place| covariance[place] = 1e6);
        expected.extend(f64s(&covariance));
        assert_eq!(cdr, expected);
    }

    #[test]
    fn odometry_ends_with_the_motion() {
        let motion = EgoMotion {
            speed_mps: Some(8.0),
            yaw_rate_rad_s: None,
        };
        let cdr = odometry(0, "cav_1/lidar", &Pose::IDENTITY, None, motion);
        let twist = cdr.len() - 8 * (6 + 36);
        assert_eq!(cdr[twist..][..48], f64s(&[8.0, 0.0, 0.0, 0.0, 0.0, 0.0]));
        assert_eq!(
            cdr[twist + 48..][..8],
            f64s(&[1e-2]),
            "the speed is measured"
        );
        assert_eq!(cdr[cdr.len() - 8..], f64s(&[1e6]), "the yaw rate is not");
    }

    #[test]
    fn a_body_hangs_below_its_lidar() {
        let mount = Mount {
            base_from_lidar: Pose::from_xyz_yaw([1.5, 0.0, 1.9], 0.0),
        };
        let cdr = static_transforms(0, [CavId::new("7").unwrap()].iter(), &mount);
        assert!(cdr.windows(11).any(|bytes| bytes == b"cav_7/lidar"));
        assert!(cdr.windows(15).any(|bytes| bytes == b"cav_7/base_link"));
        assert_eq!(cdr[cdr.len() - 56..][..24], f64s(&[-1.5, 0.0, -1.9]));
    }

    #[test]
    fn the_clock_is_two_numbers() {
        assert_eq!(clock(5_000_000_006), [0, 1, 0, 0, 5, 0, 0, 0, 6, 0, 0, 0]);
    }
}
