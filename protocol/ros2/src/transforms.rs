//! Reader of poses: where one frame is in another, from the messages of odometry, localization and transforms.

use protocol::Pose;

use crate::read::{ReadError, Reader};

/// More transforms than any robot publishes in one message.
const MAX_TRANSFORMS: u32 = 10_000;

/// A message that poses can be read from; parsed from its type's name, `nav_msgs/msg/Odometry` for example.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, strum::EnumString)]
pub enum PoseType {
    /// `nav_msgs/Odometry`: the child frame in the frame of the header.
    #[strum(serialize = "nav_msgs/msg/Odometry")]
    Odometry,
    /// `geometry_msgs/PoseStamped`: a frame that is not named in the frame of the header.
    #[strum(serialize = "geometry_msgs/msg/PoseStamped")]
    PoseStamped,
    /// `geometry_msgs/PoseWithCovarianceStamped`: as [`Self::PoseStamped`].
    #[strum(serialize = "geometry_msgs/msg/PoseWithCovarianceStamped")]
    PoseWithCovarianceStamped,
    /// `tf2_msgs/TFMessage`: any number of child frames, each in the frame of its own header.
    #[strum(serialize = "tf2_msgs/msg/TFMessage")]
    TfMessage,
}

/// A frame in another one, at one time.
#[derive(Debug, Clone, PartialEq)]
pub struct Transform {
    /// Stamp of the header, nanoseconds; 0 where the publisher sets none.
    pub nanos: u64,
    /// Frame of the header.
    pub parent: String,
    /// Child frame; `None` where the message names none.
    pub child: Option<String>,
    /// `parent_from_child` as published, metres; rotations of any length. See [`Pose::validate`].
    pub parent_from_child: Pose,
}

impl PoseType {
    /// Reads a message in CDR, with its encapsulation header. Leading slashes of frames, as ROS 1 has them, are left out.
    ///
    /// # Errors
    /// [`ReadError`] names the field.
    pub fn read(self, bytes: &[u8]) -> Result<Vec<Transform>, ReadError> {
        let mut message = Reader::of(bytes)?;
        let count = match self {
            Self::TfMessage => message.u32("length of transforms")?.min(MAX_TRANSFORMS),
            _ => 1,
        };
        // A count that is too large ends with the message: nothing is allocated for it.
        (0..count).map(|_| self.read_one(&mut message)).collect()
    }

    fn read_one(self, message: &mut Reader<'_>) -> Result<Transform, ReadError> {
        let (nanos, parent) = message.header()?;
        let child = match self {
            Self::Odometry | Self::TfMessage => frame(message.str("child_frame_id")?),
            Self::PoseStamped | Self::PoseWithCovarianceStamped => String::new(),
        };
        let parent_from_child = message.pose(match self {
            Self::TfMessage => "transform",
            _ => "pose",
        })?;
        Ok(Transform {
            nanos,
            parent: frame(parent),
            child: Some(child).filter(|child| !child.is_empty()),
            parent_from_child,
        })
    }
}

/// Stamp (nanoseconds) and frame of a message that begins with a `std_msgs/Header`, in CDR.
///
/// # Errors
/// [`ReadError`] names the field.
pub fn read_header(bytes: &[u8]) -> Result<(u64, String), ReadError> {
    let (nanos, frame_id) = Reader::of(bytes)?.header()?;
    Ok((nanos, frame(frame_id)))
}

fn frame(name: &str) -> String {
    name.trim_start_matches('/').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cdr;

    const POSE: Pose = Pose {
        translation_m: [1.0, 2.0, 3.0],
        rotation_wxyz: [0.5, 0.1, 0.2, 0.3],
    };

    fn message(child: Option<&str>) -> Vec<u8> {
        cdr::message(|cdr| {
            cdr::header(cdr, 5_000_000_006, "/odom");
            if let Some(child) = child {
                cdr.write_string(child);
            }
            cdr::pose(cdr, &POSE);
            cdr::f64s(cdr, &[0.0; 36]);
        })
    }

    fn expected(child: Option<&str>) -> Transform {
        Transform {
            nanos: 5_000_000_006,
            parent: "odom".into(),
            child: child.map(str::to_owned),
            parent_from_child: POSE,
        }
    }

    fn read_as(name: &str, bytes: &[u8]) -> Result<Vec<Transform>, ReadError> {
        name.parse::<PoseType>().unwrap().read(bytes)
    }

    #[test]
    fn poses_are_read_with_their_frames() {
        let odometry = message(Some("base_link"));
        assert_eq!(
            read_as("nav_msgs/msg/Odometry", &odometry).unwrap(),
            [expected(Some("base_link"))]
        );
        for name in [
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
        ] {
            assert_eq!(read_as(name, &message(None)).unwrap(), [expected(None)]);
        }
        assert_eq!(
            read_as("nav_msgs/msg/Odometry", &message(Some(""))).unwrap(),
            [expected(None)]
        );
        assert_eq!(read_header(&odometry), Ok((5_000_000_006, "odom".into())));
        assert!("sensor_msgs/msg/Imu".parse::<PoseType>().is_err());
    }

    #[test]
    fn a_message_of_transforms_has_any_number() {
        let bytes = cdr::message(|cdr| {
            cdr.write_sequence_length(2);
            for child in ["a", "b"] {
                cdr::header(cdr, 5_000_000_006, "odom");
                cdr.write_string(child);
                cdr::pose(cdr, &POSE);
            }
        });
        let read = PoseType::TfMessage.read(&bytes).unwrap();
        assert_eq!(read, [expected(Some("a")), expected(Some("b"))]);
    }

    #[test]
    fn a_message_that_ends_early_is_named_by_its_field() {
        let whole = message(Some("base_link"));
        let error = PoseType::Odometry.read(&whole[..60]).unwrap_err();
        assert!(error.to_string().starts_with("pose at byte"), "{error}");
        // A wrong length allocates nothing.
        let error = PoseType::TfMessage
            .read(&[0, 1, 0, 0, 255, 255, 255, 255])
            .unwrap_err();
        assert!(
            error.to_string().starts_with("header.stamp.sec at byte"),
            "{error}"
        );
    }
}
