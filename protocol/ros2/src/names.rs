//! ROS names: topics, frames and namespaces that ROS 2 accepts, and those of a vehicle.

use std::fmt;
use std::str::FromStr;

use protocol::CavId;

/// Longest topic name that ROS 2 accepts, bytes.
const MAX_BYTES: usize = 247;

/// Frame of the world.
pub const MAP_FRAME: &str = "map";

/// Error of a text that is no absolute ROS 2 name; holds its beginning.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "{0:?} is no ROS 2 name: at most {MAX_BYTES} bytes, '/' before each part, each part of a-z, A-Z, 0-9 and '_', not \
     beginning with a digit"
)]
pub struct NameError(String);

/// An absolute name of ROS 2, for example `/velodyne/points`; a topic or a namespace.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct RosName(Box<str>);

impl RosName {
    /// A name that is made of valid parts.
    pub(crate) fn known(text: &str) -> Self {
        Self(text.into())
    }

    /// The name, with its leading slash.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

fn is_token(token: &str) -> bool {
    let (first, mut bytes) = (token.bytes().next(), token.bytes());
    // An empty part has no first byte and is refused.
    first.is_some_and(|first| !first.is_ascii_digit())
        && bytes.all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
}

impl fmt::Display for RosName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl FromStr for RosName {
    type Err = NameError;

    /// Checks `text` by the rules of ROS 2 for absolute topic names.
    fn from_str(text: &str) -> Result<Self, NameError> {
        match text.strip_prefix('/') {
            Some(tokens) if text.len() <= MAX_BYTES && tokens.split('/').all(is_token) => {
                Ok(Self(text.into()))
            }
            _ => Err(NameError(text.chars().take(MAX_BYTES).collect())),
        }
    }
}

/// Name of a vehicle in topics and frames: `cav_1000`. A part of a ROS name begins with no digit, has no hyphen and no
/// two underscores in a row: `-` becomes `M` (`-1` is `cav_M1`), an underscore after another one `U`. Ids have no
/// capitals, so different vehicles have different names.
pub fn vehicle(cav: &CavId) -> String {
    let mut name = String::from("cav_");
    for letter in cav.as_str().chars() {
        name.push(match letter {
            '-' => 'M',
            '_' if name.ends_with('_') => 'U',
            other => other,
        });
    }
    name
}

/// Frames of the vehicles of one node: `cav_1000/lidar`, in a namespace `fleet/cav_1000/lidar`, so that two nodes in one
/// ROS 2 network, which has one tree of frames, never name the same one.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct FrameNames {
    /// Empty, or the namespace and a slash.
    prefix: String,
}

impl FrameNames {
    /// Frames of a node in `namespace`.
    pub fn within(namespace: Option<&RosName>) -> Self {
        // Unlike topics, frames begin with no slash.
        let prefix = namespace.map(|name| format!("{}/", &name.as_str().trim_start_matches('/')));
        let prefix = prefix.unwrap_or_default();
        Self { prefix }
    }

    /// Frame of a vehicle's LiDAR, at its estimated pose.
    pub fn lidar(&self, cav: &CavId) -> String {
        self.of(cav, "lidar")
    }

    /// Optical frame of a vehicle's camera: z ahead, x right, y down.
    pub fn camera(&self, cav: &CavId, number: u8) -> String {
        self.of(cav, &format!("camera_{number}"))
    }

    /// Frame of a vehicle's body, fixed to its LiDAR.
    pub fn base(&self, cav: &CavId) -> String {
        self.of(cav, "base_link")
    }

    /// Frame of a vehicle's LiDAR at its true pose.
    pub fn truth(&self, cav: &CavId) -> String {
        self.of(cav, "truth")
    }

    fn of(&self, cav: &CavId, frame: &str) -> String {
        format!("{}{}/{frame}", self.prefix, vehicle(cav))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn vehicle_of(id: &str) -> String {
        vehicle(&CavId::new(id).unwrap())
    }

    #[test]
    fn vehicles_have_names_that_ros_accepts() {
        assert_eq!(vehicle_of("1000"), "cav_1000");
        assert_eq!(vehicle_of("-1"), "cav_M1");
        assert_eq!(vehicle_of("_a__b"), "cav_Ua_Ub");
    }

    #[test]
    fn frames_are_in_the_namespace_of_their_node() {
        let (cav, fleet) = (
            CavId::new("-1").unwrap(),
            "/a/fleet".parse::<RosName>().unwrap(),
        );
        assert_eq!(FrameNames::default().lidar(&cav), "cav_M1/lidar");
        assert_eq!(
            FrameNames::within(Some(&fleet)).camera(&cav, 2),
            "a/fleet/cav_M1/camera_2"
        );
    }

    #[test]
    fn names_are_checked_as_ros_does() {
        for text in ["/points", "/cav_1000/points", "/a/b/c", "/_x"] {
            assert_eq!(text.parse::<RosName>().unwrap().as_str(), text);
        }
        let long = format!("/{}", "a".repeat(MAX_BYTES));
        for text in [
            "",
            "/",
            "points",
            "/1000/points",
            "/a//b",
            "/a/",
            "/a-b",
            "/a*",
            "/a%b",
            "/@a",
            "~/a",
            &long,
        ] {
            let error = text.parse::<RosName>().unwrap_err().to_string();
            assert!(error.len() < 600 && error.contains("ROS 2 name"), "{error}");
        }
    }

    proptest! {
        #[test]
        fn different_vehicles_have_different_valid_names(ids in prop::array::uniform2("[a-z0-9_-]{1,6}")) {
            let [first, second] = ids.each_ref().map(|id| CavId::new(id));
            prop_assume!(first.is_ok() && second.is_ok());
            let names = ids.each_ref().map(|id| vehicle_of(id));
            for name in &names {
                prop_assert!(format!("/{name}/points").parse::<RosName>().is_ok() && !name.contains("__"), "{}", name);
            }
            prop_assert_eq!(ids[0] == ids[1], names[0] == names[1]);
        }
    }
}
