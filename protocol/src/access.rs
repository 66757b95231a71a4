//! Permissions by role. The router's access-control rules are generated from this table.
//!
//! | principal | publishes | subscribes to |
//! | --- | --- | --- |
//! | `agent-<cav>` | its pose, maps, boxes, points, descriptor | its own sensors |
//! | `ego-<cav>` | its detections | the streams of all agents, directly or behind its link |
//! | `link-<ego>` | `rx/<ego>/...` | the streams of all agents, and their `gnss` poses |
//! | `replay` | sensors of every vehicle and previews of them, the truth, the end of the scene | control, readiness, detections |
//! | `scorer` | control | the truth, detections, poses, statistics |
//! | `recorder` | nothing | everything but previews |
//! | `viewer` | nothing | results, descriptors, previews of sweeps, feature maps, images, statistics |
//! | `ros2` | sweeps, motion and stated poses of every vehicle | sweeps, motion, poses, detections, statistics |
//!
//! In addition every process declares a liveliness token and publishes its readiness and its ledger, each under its own
//! name.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::string_enum::written_as_text;
use crate::{CavId, IdError, KeyExpr, Limits, ProcessId, Role, RunId, Stream, Topic, Verb};

/// Name of a process in its certificate: `agent-4279`, `replay`.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Principal {
    /// Role of the process.
    pub role: Role,
    /// Vehicle of the process; a process without one has the name of its role.
    pub cav: CavId,
}

/// A text that names no principal.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PrincipalError {
    /// The text begins with no role.
    #[error(
        "{0:?} is no principal: agent-<cav>, ego-<cav>, link-<cav>, replay, scorer, recorder, viewer or ros2"
    )]
    Role(String),
    /// The role is not followed by a vehicle.
    #[error(transparent)]
    Cav(#[from] IdError),
}

impl Principal {
    /// A process of a vehicle.
    pub fn new(role: Role, cav: &CavId) -> Self {
        Self {
            role,
            cav: cav.clone(),
        }
    }

    /// A process that belongs to no vehicle.
    ///
    /// # Panics
    /// Never: the names of roles are identifiers.
    pub fn of_role(role: Role) -> Self {
        Self {
            role,
            cav: CavId::new(role.as_str()).expect("the name of a role is an identifier"),
        }
    }

    /// Its name in ledgers, routes and certificates.
    ///
    /// # Panics
    /// Never: both parts are identifiers, and short enough.
    pub fn name(&self) -> ProcessId {
        ProcessId::new(&self.to_string()).expect("two identifiers and a hyphen make one")
    }

    /// All permissions in `runs`.
    pub fn rights(&self, runs: &RunScope) -> Vec<Permission> {
        let keys = |topic: &dyn fmt::Display| KeyExpr::within(runs, topic);
        let own = |stream| {
            keys(&Topic::Stream {
                cav: self.cav.clone(),
                stream,
            })
        };
        let everyones = |stream: &dyn fmt::Display| keys(&format_args!("*/{stream}"));
        let over_link =
            |stream: &dyn fmt::Display| keys(&format_args!("rx/{}/*/{stream}", self.cav));
        let control = |verb| keys(&Topic::Control(verb));
        let (publish, subscribe) = match self.role {
            Role::Agent => {
                let sensors = SENSORS
                    .into_iter()
                    .map(own)
                    .chain([keys(&format_args!("{}/camera/*", self.cav))]);
                (
                    SHARED.map(own).into(),
                    sensors.chain([everyones(&Stream::Pace)]).collect(),
                )
            }
            Role::Ego => {
                let shared = SHARED
                    .iter()
                    .flat_map(|stream| [everyones(stream), over_link(stream)]);
                (DETECTIONS.map(own).into(), shared.collect())
            }
            Role::Link => {
                let shared = SHARED
                    .iter()
                    .chain([&Stream::Gnss])
                    .map(|stream| everyones(stream));
                (
                    SHARED.iter().map(|stream| over_link(stream)).collect(),
                    shared.collect(),
                )
            }
            Role::Replay => {
                let sensors = SENSORS.iter().map(|stream| everyones(stream));
                let previews = everyones(&Stream::Preview);
                let own = [
                    keys(&"*/camera/*"),
                    previews,
                    keys(&Topic::Truth),
                    control(Verb::End),
                ];
                (
                    sensors.chain(own).collect(),
                    vec![
                        keys(&"control/*"),
                        keys(&"ready/*"),
                        everyones(&Stream::Detections),
                    ],
                )
            }
            Role::Scorer => {
                let subscribed = [everyones(&Stream::Detections), everyones(&Stream::Pose)];
                let own = [keys(&Topic::Truth), keys(&"stats/*"), keys(&"control/*")];
                (
                    vec![keys(&"control/*")],
                    own.into_iter().chain(subscribed).collect(),
                )
            }
            Role::Recorder => (Vec::new(), vec![keys(&"**")]),
            Role::Viewer => {
                use Stream::{Bev, Boxes, Descriptor, Detections, Pose, Preview};
                let shown = [Pose, Boxes, Detections, Preview, Descriptor, Bev];
                let shown = shown.iter().map(|stream| everyones(stream));
                let rest = ["*/camera/*", "rx/*/*/pose", "truth", "stats/*", "control/*"]
                    .map(|topic| keys(&topic));
                (Vec::new(), shown.chain(rest).collect::<Vec<_>>())
            }
            Role::Ros2 => {
                let streams = [Stream::Lidar, Stream::Imu, Stream::Pose, Stream::Detections];
                let subscribed = streams
                    .iter()
                    .map(|stream| everyones(stream))
                    .chain([keys(&"stats/*")]);
                (
                    [Stream::Lidar, Stream::Imu, Stream::Gnss]
                        .iter()
                        .map(|stream| everyones(stream))
                        .collect(),
                    subscribed.collect(),
                )
            }
        };
        let right = |act| move |keys: KeyExpr| Permission { act, keys };
        let mut rights: Vec<Permission> =
            publish.into_iter().map(right(Operation::Publish)).collect();
        rights.push(right(Operation::Publish)(keys(&Topic::Ready(self.name()))));
        rights.push(right(Operation::Publish)(keys(&Topic::Stats(self.name()))));
        rights.extend(subscribe.into_iter().map(right(Operation::Subscribe)));
        let own_token = keys(&Topic::Alive {
            role: self.role,
            cav: self.cav.clone(),
        });
        // A process looks for its own token before it declares it: another may have its name.
        rights.push(right(Operation::SubscribeLiveliness)(own_token.clone()));
        rights.push(right(Operation::DeclareLiveliness)(own_token));
        rights.extend(
            self.watched()
                .map(|topic| right(Operation::SubscribeLiveliness)(keys(&topic))),
        );
        rights.push(right(Operation::Query)(keys(&crate::key::UNDECLARED)));
        rights
    }

    /// True if it publishes messages of this topic, as far as the ledger covers them.
    pub(crate) fn publishes(&self, topic: &Topic) -> bool {
        match topic {
            Topic::Stream { cav, stream } => match self.role {
                Role::Agent => *cav == self.cav && SHARED.contains(stream),
                Role::Ego => *cav == self.cav && DETECTIONS.contains(stream),
                Role::Replay | Role::Ros2 => {
                    !SHARED.contains(stream) && !DETECTIONS.contains(stream)
                }
                _ => false,
            },
            Topic::Received { ego, .. } => self.role == Role::Link && *ego == self.cav,
            Topic::Truth => self.role == Role::Replay,
            _ => false,
        }
    }

    /// Liveliness tokens that this role subscribes to, below the run.
    fn watched(&self) -> Option<&'static str> {
        match self.role {
            Role::Ego | Role::Link => Some("alive/agent/*"),
            Role::Scorer | Role::Viewer | Role::Recorder | Role::Ros2 => Some("alive/*/*"),
            Role::Agent | Role::Replay => None,
        }
    }
}

/// Limits of message sizes, bytes, by key, in any run.
pub fn size_limits() -> Vec<(Vec<KeyExpr>, usize)> {
    let small = [
        Stream::Pose,
        Stream::Gnss,
        Stream::Imu,
        Stream::Pace,
        Stream::Preview,
        Stream::Descriptor,
        Stream::Boxes,
        Stream::Detections,
    ];
    let keys = |stream| [format!("*/{stream}"), format!("rx/*/*/{stream}")];
    let selectors = |topics: Vec<String>| {
        topics
            .iter()
            .map(|topics| KeyExpr::within(&RunScope::Any, topics))
            .collect()
    };
    let limit = |stream: Stream| Some((selectors(keys(stream).into()), stream.most_bytes()?));
    let small_messages = ["control/*", "ready/*", "stats/*"]
        .map(str::to_owned)
        .into();
    let small_messages = (
        selectors(small_messages),
        2 * Limits::HARD_METADATA_BYTES as usize,
    );
    small
        .into_iter()
        .filter_map(limit)
        .chain([small_messages])
        .collect()
}

/// Streams that the replay publishes for vehicles, without cameras.
const SENSORS: [Stream; 4] = [Stream::Lidar, Stream::Gnss, Stream::Imu, Stream::Radar];
/// Streams of agents.
const SHARED: [Stream; 5] = [
    Stream::Pose,
    Stream::Bev,
    Stream::Boxes,
    Stream::Points,
    Stream::Descriptor,
];
/// Streams of an ego for all principals.
const DETECTIONS: [Stream; 3] = [Stream::Detections, Stream::DetectionsJson, Stream::Pace];

impl fmt::Display for Principal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.cav.as_str() == self.role.as_str() {
            return f.write_str(self.role.as_str());
        }
        write!(f, "{}-{}", self.role, self.cav)
    }
}

impl FromStr for Principal {
    type Err = PrincipalError;

    fn from_str(text: &str) -> Result<Self, PrincipalError> {
        let (role, cav) = text
            .split_once('-')
            .map_or((text, None), |(role, cav)| (role, Some(cav)));
        let unknown = || PrincipalError::Role(text.chars().take(2 * ProcessId::MAX_LEN).collect());
        let role = Role::ALL
            .into_iter()
            .find(|known| known.as_str() == role)
            .ok_or_else(unknown)?;
        match cav {
            Some(cav) => Ok(Self {
                role,
                cav: CavId::new(cav)?,
            }),
            None => Ok(Self::of_role(role)),
        }
    }
}

written_as_text!(Principal);

/// Runs in which permissions hold.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RunScope {
    /// One run.
    One(RunId),
    /// Any run: for a router that outlives runs.
    Any,
}

impl fmt::Display for RunScope {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::One(run) => run.fmt(f),
            Self::Any => f.write_str("*"),
        }
    }
}

/// Operation of a principal on keys.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Operation {
    /// Put messages.
    Publish,
    /// Subscribe to messages.
    Subscribe,
    /// Declare a liveliness token.
    DeclareLiveliness,
    /// Subscribe to the liveliness tokens of others.
    SubscribeLiveliness,
    /// Send a query; no principal may answer one.
    Query,
}

impl Operation {
    /// Every operation, in order.
    pub const ALL: [Self; 5] = [
        Self::Publish,
        Self::Subscribe,
        Self::DeclareLiveliness,
        Self::SubscribeLiveliness,
        Self::Query,
    ];
}

/// One operation that a principal may carry out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Permission {
    /// Permitted operation.
    pub act: Operation,
    /// Keys on which it is permitted.
    pub keys: KeyExpr,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rights(principal: &str, act: Operation) -> Vec<String> {
        let runs = RunScope::One(RunId::new("r1").unwrap());
        let rights = principal.parse::<Principal>().unwrap().rights(&runs);
        rights
            .iter()
            .filter(|right| right.act == act)
            .map(|right| right.keys.to_string())
            .collect()
    }

    #[test]
    fn principals_are_written_and_read_back() {
        for text in [
            "agent-4279",
            "agent--1",
            "ego-4279",
            "link-4279",
            "replay",
            "scorer",
            "recorder",
            "viewer",
            "ros2",
        ] {
            let principal: Principal = text.parse().unwrap();
            assert_eq!(
                (principal.to_string().as_str(), principal.name().as_str()),
                (text, text)
            );
        }
        for text in [
            "",
            "router",
            "agent-*",
            "agent-truth",
            "agent-4279/bev",
            "driver-1",
        ] {
            assert!(text.parse::<Principal>().is_err(), "{text}");
        }
    }

    #[test]
    fn a_vehicle_publishes_only_under_its_own_name() {
        for principal in ["agent-4279", "ego-4279"] {
            for keys in rights(principal, Operation::Publish) {
                let own = [
                    "v2v/r1/4279/".to_owned(),
                    format!("v2v/r1/stats/{principal}"),
                    format!("v2v/r1/ready/{principal}"),
                ];
                assert!(
                    own.iter().any(|own| keys.starts_with(own)),
                    "{principal}: {keys}"
                );
                assert!(!keys.contains('*'), "{principal}: {keys}");
            }
        }
        assert!(
            rights("link-4279", Operation::Publish).contains(&"v2v/r1/rx/4279/*/bev".to_owned())
        );
        assert_eq!(
            rights("agent-4279", Operation::DeclareLiveliness),
            ["v2v/r1/alive/agent/4279"]
        );
    }

    #[test]
    fn agents_never_subscribe_to_the_truth_or_to_each_other() {
        let others: Vec<String> = rights("agent-4279", Operation::Subscribe)
            .into_iter()
            .filter(|keys| !keys.starts_with("v2v/r1/4279/"))
            .collect();
        assert_eq!(
            others,
            ["v2v/r1/*/pace"],
            "an ego asks every agent for another pace"
        );
        for principal in ["agent-4279", "ego-4279", "link-4279"] {
            assert!(
                !rights(principal, Operation::Subscribe).contains(&"v2v/r1/truth".to_owned()),
                "{principal}"
            );
        }
    }

    #[test]
    fn rights_hold_in_one_run_or_in_any() {
        let agent: Principal = "agent-1".parse().unwrap();
        assert!(
            agent
                .rights(&RunScope::Any)
                .iter()
                .all(|right| right.keys.as_str().starts_with("v2v/*/"))
        );
    }
}
