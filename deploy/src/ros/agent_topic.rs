//! A topic of a ROS 2 network that is a sensor of an agent.

use std::str::FromStr;

use protocol::CavId;
use ros2::RosName;

/// A topic and the vehicle whose sensor publishes it, written `/points=1000`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AgentTopic {
    /// The topic.
    pub topic: RosName,
    /// The vehicle.
    pub cav: CavId,
}

/// Error of a text that is no [`AgentTopic`].
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum AgentTopicError {
    /// There is no `=`.
    #[error("{0:?} is not TOPIC=AGENT, for example /velodyne_points=1000")]
    NoSeparator(String),
    /// The topic is no topic.
    #[error(transparent)]
    Topic(#[from] ros2::NameError),
    /// The vehicle is no vehicle.
    #[error(transparent)]
    Cav(#[from] protocol::IdError),
}

impl FromStr for AgentTopic {
    type Err = AgentTopicError;

    fn from_str(text: &str) -> Result<Self, AgentTopicError> {
        let none = || AgentTopicError::NoSeparator(text.chars().take(100).collect());
        let (topic, cav) = text.split_once('=').ok_or_else(none)?;
        Ok(Self {
            topic: topic.parse()?,
            cav: cav.parse()?,
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
        let error = |text: &str| text.parse::<AgentTopic>().unwrap_err().to_string();
        assert!(error("/points").contains("TOPIC=AGENT"));
        assert!(
            error("points=1000").contains("ROS 2 name") && error("/points=A").contains("CAV id")
        );
    }
}
