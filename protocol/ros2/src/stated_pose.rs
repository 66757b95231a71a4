//! Stated pose: reader of the pose that a person draws in RViz or a program sends, with its covariance.

use protocol::Pose;

use crate::names::MAP_FRAME;
use crate::read::{ReadError, Reader};

/// Standard deviations are kept within these bounds, metres and radians: a stated pose is neither exact nor unknown.
const STD: [f64; 2] = [0.01, 10.0];

/// A pose of a body in the map, `geometry_msgs/PoseWithCovarianceStamped`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StatedPose {
    /// Pose of the body.
    pub world_from_base: Pose,
    /// Larger standard deviation of x and y, metres.
    pub position_std_m: f64,
    /// Standard deviation of the yaw, radians.
    pub yaw_std_rad: f64,
}

impl StatedPose {
    /// Reads a message in CDR, with its encapsulation header.
    ///
    /// # Errors
    /// [`ReadError`] names the field and its value.
    pub fn read(bytes: &[u8]) -> Result<Self, ReadError> {
        let mut message = Reader::of(bytes)?;
        let (_, frame_id) = message.header()?;
        if frame_id.trim_start_matches('/') != MAP_FRAME {
            let problem = format!("header.frame_id is {frame_id:?}, not {MAP_FRAME:?}");
            return Err(ReadError(problem));
        }
        let world_from_base = message.pose("pose")?;
        let valid = world_from_base.validate();
        valid.map_err(|error| ReadError(format!("pose: {error}")))?;
        let covariance: [f64; 36] = message.f64s("covariance")?;
        // Row-major 6 x 6: variances of x, y and yaw are at 0, 7 and 35.
        let [xx, .., yaw] = covariance;
        let [_, _, _, _, _, _, _, yy, ..] = covariance;
        Ok(Self {
            world_from_base,
            position_std_m: std(0, xx)?.max(std(7, yy)?),
            yaw_std_rad: std(35, yaw)?,
        })
    }
}

fn std(index: usize, variance: f64) -> Result<f64, ReadError> {
    let [least, most] = STD;
    if variance >= 0.0 {
        return Ok(variance.sqrt().clamp(least, most));
    }
    // NaN is no variance.
    let problem = format!("covariance[{index}] is {variance}, not a variance");
    Err(ReadError(problem))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr;

    fn message(frame: &str, variances: [f64; 3]) -> Vec<u8> {
        let mut covariance = [[0.0; 6]; 6];
        (covariance[0][0], covariance[1][1], covariance[5][5]) =
            (variances[0], variances[1], variances[2]);
        cdr::message(|cdr| {
            cdr::header(cdr, 7, frame);
            cdr::pose(cdr, &Pose::from_xyz_yaw([1.0, 2.0, 0.0], 0.5));
            cdr::f64s(cdr, covariance.as_flattened());
        })
    }

    #[test]
    fn a_drawn_pose_is_read_with_its_standard_deviations() {
        let stated = StatedPose::read(&message("map", [0.25, 0.09, 0.04])).unwrap();
        let StatedPose {
            world_from_base,
            position_std_m,
            yaw_std_rad,
        } = stated;
        assert_eq!(world_from_base, Pose::from_xyz_yaw([1.0, 2.0, 0.0], 0.5));
        assert_eq!((position_std_m, yaw_std_rad), (0.5, 0.2));
        let exact = StatedPose::read(&message("/map", [0.0; 3])).unwrap();
        assert_eq!(exact.position_std_m, 0.01, "no person is exact");
    }

    #[test]
    fn a_pose_in_another_frame_or_without_a_variance_is_named() {
        let odom = StatedPose::read(&message("odom", [0.25; 3])).unwrap_err();
        assert_eq!(odom.to_string(), "header.frame_id is \"odom\", not \"map\"");
        let nan = StatedPose::read(&message("map", [0.25, f64::NAN, 0.1])).unwrap_err();
        assert_eq!(nan.to_string(), "covariance[7] is NaN, not a variance");
        let cut = StatedPose::read(&message("map", [0.25; 3])[..60]).unwrap_err();
        assert!(cut.to_string().starts_with("pose at byte"), "{cut}");
    }
}
