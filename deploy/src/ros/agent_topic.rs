//! A topic of a ROS 2 network that is a sensor of an agent.

use std::str::FromStr;

use protocol::CavId;
use protocol::text::excerpt;
use ros2::RosName;

/// A topic and the vehicle whose sensor publishes it, written `/points=1000`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AgentTopic {
    /// The topic.
    pub topic: RosName,
    /// The vehicle.
    pub cav: CavId,
}

impl FromStr for AgentTopic {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (topic, cav) = text.split_once('=').ok_or_else(|| {
            let shown = excerpt(text, 100);
            format!("{shown:?} is not TOPIC=AGENT, for example /velodyne_points=1000")
        })?;
        Ok(Self {
            topic: RosName::from_str(topic).map_err(|error| error.to_string())?,
            cav: CavId::from_str(cav).map_err(|error| error.to_string())?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_is_a_topic_and_a_vehicle() {
        let source: AgentTopic = "/velodyne/points=1000".parse().unwrap();
        assert_eq!(
            (source.topic.as_str(), source.cav.as_str()),
            ("/velodyne/points", "1000")
        );
        for (text, part) in [
            ("/points", "TOPIC=AGENT"),
            ("points=1000", "ROS 2 name"),
            ("/points=A", "CAV id"),
        ] {
            let error = text.parse::<AgentTopic>().unwrap_err();
            assert!(error.contains(part), "{error}");
        }
    }
}
