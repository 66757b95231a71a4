//! Reader of a vehicle's motion: speed and yaw rate from the messages of wheel odometry and gyroscopes.
//!
//! Axes are those of REP-103, which are ours: x forward, y left, z up; a turn to the left is positive. The speed is that
//! along x, the yaw rate that about z of the frame that the message names (of `nav_msgs/Odometry` the child frame, which
//! is the body).

use protocol::EgoMotion;

use crate::RosType;
use crate::read::{ReadError, Reader};

/// Variance from which a value counts as not measured: drivers write it, as we do, where they measure nothing.
const UNMEASURED: f64 = 1e6;

/// A message that a motion can be read from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum MotionType {
    /// `nav_msgs/Odometry`: speed and yaw rate.
    Odometry,
    /// `geometry_msgs/TwistStamped`: speed and yaw rate.
    TwistStamped,
    /// `sensor_msgs/Imu`: yaw rate.
    Imu,
}

impl MotionType {
    /// The type of the message.
    pub fn ros_type(self) -> RosType {
        match self {
            Self::Odometry => RosType::Odometry,
            Self::TwistStamped => RosType::TwistStamped,
            Self::Imu => RosType::Imu,
        }
    }

    /// Reads a message in CDR, with its encapsulation header: the capture time, which is the stamp of the header, in
    /// nanoseconds, and speed and yaw rate; absent ones are not measured.
    ///
    /// # Errors
    /// [`ReadError`] names the field and its value.
    pub fn read(self, bytes: &[u8]) -> Result<(u64, EgoMotion), ReadError> {
        let mut message = Reader::of(bytes)?;
        let (capture_nanos, _) = message.header()?;
        let motion = match self {
            Self::Odometry => {
                message.str("child_frame_id")?;
                message.f64s::<7>("pose.pose")?;
                message.f64s::<36>("pose.covariance")?;
                let fields = ["twist.twist.linear.x", "twist.twist.angular.z"];
                let motion = read_twist(&mut message, fields)?;
                let covariance: [f64; 36] = message.f64s("twist.covariance")?;
                measured(motion, &covariance)?
            }
            Self::TwistStamped => read_twist(&mut message, ["twist.linear.x", "twist.angular.z"])?,
            Self::Imu => {
                message.f64s::<4>("orientation")?;
                message.f64s::<9>("orientation_covariance")?;
                let [_, _, z] = message.f64s("angular_velocity")?;
                let [first, ..] = message.f64s::<9>("angular_velocity_covariance")?;
                // REP-145: the first element is -1 where a sensor has no such measurement.
                if first.to_bits() == (-1.0_f64).to_bits() {
                    return Err(unmeasured("angular_velocity_covariance[0]", first));
                }
                let most = EgoMotion::MAX_YAW_RATE_RAD_S;
                EgoMotion {
                    speed_mps: None,
                    yaw_rate_rad_s: Some(within("angular_velocity.z", z, most)?),
                }
            }
        };
        Ok((capture_nanos, motion))
    }
}

/// `geometry_msgs/Twist`; errors name the fields of speed and yaw rate.
fn read_twist(
    message: &mut Reader<'_>,
    [speed_field, yaw_rate_field]: [&'static str; 2],
) -> Result<EgoMotion, ReadError> {
    let [speed_mps, _, _] = message.f64s(speed_field)?;
    let [_, _, z] = message.f64s(yaw_rate_field)?;
    let (max_speed, max_yaw_rate) = (EgoMotion::MAX_SPEED_MPS, EgoMotion::MAX_YAW_RATE_RAD_S);
    Ok(EgoMotion {
        speed_mps: Some(within(speed_field, speed_mps, max_speed)?),
        yaw_rate_rad_s: Some(within(yaw_rate_field, z, max_yaw_rate)?),
    })
}

/// The values of `motion` that are measured by their variances.
fn measured(mut motion: EgoMotion, covariance: &[f64; 36]) -> Result<EgoMotion, ReadError> {
    // Row-major 6 x 6: x is the first variance, the rotation about z the last.
    // NaN is not below the bound.
    let [speed_variance, .., yaw_rate_variance] = covariance;
    motion.speed_mps = motion.speed_mps.filter(|_| *speed_variance < UNMEASURED);
    motion.yaw_rate_rad_s = motion
        .yaw_rate_rad_s
        .filter(|_| *yaw_rate_variance < UNMEASURED);
    if motion.speed_mps.is_none() && motion.yaw_rate_rad_s.is_none() {
        return Err(unmeasured("twist.covariance[0]", *speed_variance));
    }
    Ok(motion)
}

fn within(field: &str, found: f64, limit: f64) -> Result<f64, ReadError> {
    // A value that is no number is within nothing.
    if found.abs() <= limit {
        return Ok(found);
    }
    let problem = format!("{field} is {found}, not from -{limit} to {limit}");
    Err(ReadError(problem))
}

fn unmeasured(field: &str, found: f64) -> ReadError {
    ReadError(format!("{field} is {found}: nothing is measured"))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use re_cdr::{BigEndian, ByteOrder, CdrWriter, LittleEndian};

    use super::*;

    const TYPES: [MotionType; 3] = [
        MotionType::Odometry,
        MotionType::TwistStamped,
        MotionType::Imu,
    ];

    /// The numbers of a message, in the order of ROS.
    #[derive(Debug, Clone, Copy)]
    struct Numbers {
        linear: [f64; 3],
        angular: [f64; 3],
        /// Of x, and of the rotation about z; of an IMU the first is that of its first axis.
        variances: [f64; 2],
    }

    impl Numbers {
        fn of(speed: f64, yaw_rate: f64) -> Self {
            Self {
                linear: [speed, 3.0, 4.0],
                angular: [5.0, 6.0, yaw_rate],
                variances: [0.01, 0.02],
            }
        }
    }

    fn f64s<BO: ByteOrder>(cdr: &mut CdrWriter<'_, BO>, values: &[f64]) {
        values.iter().for_each(|value| cdr.write_f64(*value));
    }

    fn written<BO: ByteOrder>(ty: MotionType, encoding: [u8; 4], numbers: Numbers) -> Vec<u8> {
        let mut bytes = encoding.to_vec();
        let mut cdr = CdrWriter::<BO>::new(&mut bytes);
        cdr.write_i32(7);
        cdr.write_u32(8);
        cdr.write_string("odom");
        match ty {
            MotionType::Odometry => {
                cdr.write_string("base_link");
                f64s(&mut cdr, &[9.0; 7 + 36]);
                f64s(&mut cdr, &numbers.linear);
                f64s(&mut cdr, &numbers.angular);
                let mut covariance = [0.0; 36];
                [covariance[0], covariance[35]] = numbers.variances;
                f64s(&mut cdr, &covariance);
            }
            MotionType::TwistStamped => {
                f64s(&mut cdr, &numbers.linear);
                f64s(&mut cdr, &numbers.angular);
            }
            MotionType::Imu => {
                f64s(&mut cdr, &[9.0; 4 + 9]);
                f64s(&mut cdr, &numbers.angular);
                let mut covariance = [0.0; 9];
                covariance[0] = numbers.variances[0];
                f64s(&mut cdr, &covariance);
                f64s(&mut cdr, &[9.0; 3 + 9]);
            }
        }
        bytes
    }

    fn little(ty: MotionType, numbers: Numbers) -> Vec<u8> {
        written::<LittleEndian>(ty, [0, 1, 0, 0], numbers)
    }

    #[test]
    fn our_own_odometry_is_read_back_with_what_it_measures() {
        let pose = protocol::Pose::from_xyz_yaw([1.0, 2.0, 3.0], 0.5);
        for motion in [
            EgoMotion {
                speed_mps: Some(8.0),
                yaw_rate_rad_s: Some(-0.25),
            },
            EgoMotion {
                speed_mps: None,
                yaw_rate_rad_s: Some(0.5),
            },
            EgoMotion {
                speed_mps: Some(-1.0),
                yaw_rate_rad_s: None,
            },
        ] {
            let bytes =
                crate::encode::odometry(1_700_000_000_000_000_001, "lidar", &pose, None, motion);
            let expected = (1_700_000_000_000_000_001_u64, motion);
            assert_eq!(MotionType::Odometry.read(&bytes), Ok(expected));
        }
        let bytes = crate::encode::odometry(5, "lidar", &pose, None, EgoMotion::default());
        let error = MotionType::Odometry.read(&bytes).unwrap_err().to_string();
        assert_eq!(error, "twist.covariance[0] is 1000000: nothing is measured");
    }

    #[test]
    fn a_wrong_message_is_named_with_field_and_value() {
        let error =
            |ty: MotionType, numbers| ty.read(&little(ty, numbers)).unwrap_err().to_string();
        assert_eq!(
            error(MotionType::Odometry, Numbers::of(f64::NAN, 0.0)),
            "twist.twist.linear.x is NaN, not from -200 to 200"
        );
        assert_eq!(
            error(MotionType::TwistStamped, Numbers::of(1.0, -30.0)),
            "twist.angular.z is -30, not from -20 to 20"
        );
        let unmeasured = Numbers {
            variances: [-1.0, 0.0],
            ..Numbers::of(1.0, 0.5)
        };
        assert!(
            error(MotionType::Imu, unmeasured).contains("angular_velocity_covariance[0] is -1")
        );
        for ty in TYPES {
            let bytes = little(ty, Numbers::of(1.0, 0.5));
            let cut = ty.read(&bytes[..bytes.len() / 2]).unwrap_err().to_string();
            assert!(cut.contains(" at byte "), "{cut}");
            let error = ty.read(&[9; 40]).unwrap_err().to_string();
            assert!(error.starts_with("encoding [9, 9, 9, 9]"), "{error}");
        }
    }

    proptest! {
        #[test]
        fn either_byte_order_gives_the_same_motion(speed in -200.0..200.0, yaw_rate in -20.0..20.0) {
            let numbers = Numbers::of(speed, yaw_rate);
            for ty in TYPES {
                let motion = EgoMotion { speed_mps: (ty != MotionType::Imu).then_some(speed), yaw_rate_rad_s: Some(yaw_rate) };
                let expected = (7_000_000_008_u64, motion);
                prop_assert_eq!(ty.read(&little(ty, numbers)).unwrap(), expected);
                let big = written::<BigEndian>(ty, [0, 0, 0, 0], numbers);
                prop_assert_eq!(ty.read(&big).unwrap(), expected);
            }
        }

        #[test]
        fn changed_bytes_are_refused_or_read_within_the_limits(
            changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
            cut in any::<prop::sample::Index>(),
        ) {
            for ty in TYPES {
                let mut bytes = little(ty, Numbers::of(1.0, 0.5));
                for (place, byte) in &changes {
                    let place = place.index(bytes.len());
                    bytes[place] = *byte;
                }
                for bytes in [&bytes[..], &bytes[..cut.index(bytes.len())]] {
                    if let Ok((_, motion)) = ty.read(bytes) {
                        prop_assert!(motion.speed_mps.is_none_or(|speed| speed.abs() <= EgoMotion::MAX_SPEED_MPS));
                        let rate = motion.yaw_rate_rad_s;
                        prop_assert!(rate.is_none_or(|rate| rate.abs() <= EgoMotion::MAX_YAW_RATE_RAD_S));
                    }
                }
            }
        }
    }
}
