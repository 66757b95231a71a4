//! Permissions by role. The router's access-control rules are generated from this table.
//!
//! | principal | publishes | subscribes to |
//! | --- | --- | --- |
//! | `agent-<cav>` | its pose, maps, boxes, points, descriptor | its own sensors |
//! | `ego-<cav>` | its detections and tracks | the streams of all agents, directly or behind its link |
//! | `link-<ego>` | `rx/<ego>/...` | the streams of all agents, and their `gnss` poses |
//! | `replay` | sensors of every vehicle and previews of them, the truth, the end of the scene | control, readiness, detections |
//! | `scorer` | control | the truth, detections, tracks, poses, statistics |
//! | `recorder` | nothing | everything but previews |
//! | `viewer` | nothing | results, descriptors, previews of sweeps, feature maps, images, statistics |
//! | `ros2` | sweeps, motion and stated poses of every vehicle | sweeps, motion, poses, detections, tracks, statistics |
//! | `ros2-<cav>` | sweeps, motion and stated poses of its vehicle | as `ros2` |
//!
//! In addition every process declares a liveliness token and publishes its readiness and its ledger, each under its own
//! name.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::stream::StreamTable;
use crate::string_enum::written_as_text;
use crate::text::excerpt;
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

/// Forms of the text of a principal.
const FORMS: &str =
    "agent-<cav>, ego-<cav>, link-<cav>, replay, scorer, recorder, viewer, ros2 or ros2-<cav>";

impl Principal {
    /// A process of a vehicle.
    pub fn new(role: Role, cav: &CavId) -> Self {
        let cav = cav.clone();
        Self { role, cav }
    }

    /// A process that belongs to no vehicle.
    ///
    /// # Panics
    /// Never: the names of roles are identifiers.
    pub fn of_role(role: Role) -> Self {
        let cav = CavId::new(role.as_str()).expect("the name of a role is an identifier");
        Self { role, cav }
    }

    /// Its name in ledgers, routes and certificates.
    ///
    /// # Panics
    /// Never: both parts are identifiers, and short enough.
    pub fn name(&self) -> ProcessId {
        ProcessId::new(&self.to_string()).expect("two identifiers and a hyphen make one")
    }

    /// False for the only process of a role in a run.
    fn is_of_vehicle(&self) -> bool {
        self.cav.as_str() != self.role.as_str()
    }

    /// All permissions in `runs`.
    pub fn rights(&self, runs: &RunScope) -> Vec<Permission> {
        let [mut publish, mut subscribe] = self.streams::<Stream>(runs);
        match self.role {
            Role::Agent | Role::Ego => {}
            Role::Link => subscribe.extend(streams_of(runs, &["*"], [Stream::Gnss])),
            Role::Replay => {
                publish.extend(keys_of(runs, [Topic::Truth, Topic::Control(Verb::End)]));
                subscribe.extend(keys_of(runs, ["control/*", "ready/*"]));
                subscribe.extend(streams_of(runs, &["*"], [Stream::Detections]));
            }
            Role::Scorer => {
                let streams = [Stream::Detections, Stream::Tracks, Stream::Pose];
                publish.extend(keys_of(runs, ["control/*"]));
                subscribe.extend(keys_of(runs, ["truth", "stats/*", "control/*"]));
                subscribe.extend(streams_of(runs, &["*"], streams));
            }
            Role::Recorder => subscribe.extend(keys_of(runs, ["**"])),
            Role::Viewer => {
                use Stream::{Bev, Boxes, Camera, Descriptor, Detections, Pose, Preview, Tracks};
                let shown = [
                    Pose,
                    Boxes,
                    Detections,
                    Tracks,
                    Preview,
                    Descriptor,
                    Bev,
                    Camera(0),
                ];
                subscribe.extend(streams_of(runs, &["*"], shown));
                let rest = ["rx/*/*/pose", "truth", "stats/*", "control/*"];
                subscribe.extend(keys_of(runs, rest));
            }
            Role::Ros2 => {
                use Stream::{Detections, Gnss, Imu, Lidar, Pose, Tracks};
                let streams = [Lidar, Imu, Pose, Detections, Tracks];
                let own = Some(self.cav.as_str()).filter(|_| self.is_of_vehicle());
                let robot = own.unwrap_or("*");
                publish.extend(streams_of(runs, &[robot], [Lidar, Imu, Gnss]));
                subscribe.extend(streams_of(runs, &["*"], streams));
                subscribe.extend(keys_of(runs, ["stats/*"]));
            }
        }
        let own = [Topic::Ready(self.name()), Topic::Stats(self.name())];
        publish.extend(keys_of(runs, own));
        let (role, cav) = (self.role, self.cav.clone());
        let own_token = KeyExpr::within(runs, &Topic::Alive { role, cav });
        // A process looks for its own token before it declares it: another may have its name.
        let watched = self.watched().into_iter();
        let watched = watched.map(|topic| KeyExpr::within(runs, &topic));
        let undeclared = KeyExpr::within(runs, &crate::key::UNDECLARED);
        let operations = [
            (Operation::Publish, publish),
            (Operation::Subscribe, subscribe),
            (Operation::SubscribeLiveliness, vec![own_token.clone()]),
            (Operation::DeclareLiveliness, vec![own_token]),
            (Operation::SubscribeLiveliness, watched.collect()),
            (Operation::Query, vec![undeclared]),
        ];
        let permissions = operations
            .into_iter()
            .flat_map(|(act, keys)| keys.into_iter().map(move |keys| Permission { act, keys }));
        permissions.collect()
    }

    /// Keys of streams on which it publishes, and those to which it subscribes, as far as they follow from the senders:
    /// sensors go to the vehicle's own agent, streams of agents to egos and links, and what egos repeat to all agents.
    pub(crate) fn streams<S: StreamTable>(&self, runs: &RunScope) -> [Vec<KeyExpr>; 2] {
        let (own, over_link) = (self.cav.as_str(), format!("rx/{}/*", self.cav));
        let [agents, egos, sensors] = [Role::Agent, Role::Ego, Role::Replay].map(sent_by::<S>);
        match self.role {
            Role::Agent => {
                // Sensor streams that the ledger does not cover are previews, which are for viewers.
                let sensors = sensors.into_iter().filter(|stream| stream.row().is_counted);
                let repeated = egos.into_iter().filter(|stream| !stream.row().is_counted);
                let mut subscribed = streams_of(runs, &[own], sensors);
                subscribed.extend(streams_of(runs, &["*"], repeated));
                [streams_of(runs, &[own], agents), subscribed]
            }
            Role::Ego => [
                streams_of(runs, &[own], egos),
                streams_of(runs, &["*", over_link.as_str()], agents),
            ],
            Role::Link => [
                streams_of(runs, &[over_link.as_str()], agents.iter().copied()),
                streams_of(runs, &["*"], agents),
            ],
            Role::Replay => [streams_of(runs, &["*"], sensors), Vec::new()],
            Role::Scorer | Role::Recorder | Role::Viewer | Role::Ros2 => Default::default(),
        }
    }

    /// True if it publishes messages of this topic, as far as the ledger covers them.
    pub(crate) fn publishes(&self, topic: &Topic) -> bool {
        match topic {
            Topic::Stream { cav, stream } => match (self.role, stream.row().sender) {
                (Role::Ros2, Role::Replay) if self.is_of_vehicle() => *cav == self.cav,
                (Role::Replay | Role::Ros2, sender) => sender == Role::Replay,
                (role, sender) => role == sender && *cav == self.cav,
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

/// Streams that a role sends: those that the ledger covers first, numbered ones last.
fn sent_by<S: StreamTable>(sender: Role) -> Vec<S> {
    let mut streams = S::ROWS.to_vec();
    streams.retain(|stream| stream.row().sender == sender);
    streams.sort_by_key(|stream| (!stream.row().is_counted, stream.selector().contains('*')));
    streams
}

fn keys_of<const N: usize>(runs: &RunScope, topics: [impl fmt::Display; N]) -> [KeyExpr; N] {
    topics.map(|topic| KeyExpr::within(runs, &topic))
}

/// Keys of each stream below some vehicles; `*`: of every vehicle, before the link.
fn streams_of<S: StreamTable>(
    runs: &RunScope,
    vehicles: &[&str],
    streams: impl IntoIterator<Item = S>,
) -> Vec<KeyExpr> {
    let mut keys = Vec::new();
    for stream in streams {
        for vehicle in vehicles {
            let topic = format!("{vehicle}/{}", stream.selector());
            keys.push(KeyExpr::within(runs, &topic));
        }
    }
    keys
}

/// Limits of message sizes, bytes, by key, in any run.
pub fn size_limits() -> Vec<(Vec<KeyExpr>, usize)> {
    let keys = keys_of(&RunScope::Any, ["control/*", "ready/*", "stats/*"]);
    let metadata_only = (keys.into(), 2 * Limits::HARD_METADATA_BYTES as usize);
    size_limits_of::<Stream>().chain([metadata_only]).collect()
}

/// Limits of the streams of a table, lowest first.
pub(crate) fn size_limits_of<S: StreamTable>() -> impl Iterator<Item = (Vec<KeyExpr>, usize)> {
    let mut limited: Vec<S> = S::ROWS.to_vec();
    limited.sort_by_key(|stream| {
        let row = stream.row();
        let is_of_ego = row.sender == Role::Ego;
        (row.most_bytes, is_of_ego, row.sender, row.is_counted)
    });
    limited.into_iter().filter_map(|stream| {
        let keys = streams_of(&RunScope::Any, &["*", "rx/*/*"], [stream]);
        Some((keys, stream.row().most_bytes?))
    })
}

impl fmt::Display for Principal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_of_vehicle() {
            return write!(f, "{}-{}", self.role, self.cav);
        }
        f.write_str(self.role.as_str())
    }
}

impl FromStr for Principal {
    type Err = IdError;

    fn from_str(text: &str) -> Result<Self, IdError> {
        // At the first hyphen: no role has one, and an id may begin with one (`agent--1`).
        let (role, cav) = text
            .split_once('-')
            .map_or((text, None), |(role, cav)| (role, Some(cav)));
        let role: Role = role.parse().map_err(|_| {
            let text = excerpt(text, 2 * ProcessId::MAX_LEN);
            IdError(format!("{text:?} is no principal: {FORMS}"))
        })?;
        match cav {
            Some(cav) => Ok(Self::new(role, &CavId::new(cav)?)),
            None => Ok(Self::of_role(role)),
        }
    }
}

written_as_text!(Principal);

/// Runs in which permissions hold.
#[derive(Debug, Clone, PartialEq, Eq, strum::Display)]
pub enum RunScope {
    /// One run.
    #[strum(transparent)]
    One(RunId),
    /// Any run: for a router that outlives runs.
    #[strum(to_string = "*")]
    Any,
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
            "ros2-4279",
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
        for principal in ["agent-4279", "ego-4279", "ros2-4279"] {
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

    /// Every permission of every principal, and the limits of routers: a change of a line is a change of access.
    #[test]
    fn permissions_and_limits_are_these() {
        let runs = RunScope::One(RunId::new("r1").unwrap());
        let mut text = String::new();
        for name in [
            "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
        ] {
            let principal: Principal = name.parse().unwrap();
            for Permission { act, keys } in principal.rights(&runs) {
                text += &format!("{name} {act:?} {keys}\n");
            }
        }
        for (keys, most_bytes) in size_limits() {
            let keys: Vec<&str> = keys.iter().map(KeyExpr::as_str).collect();
            text += &format!("{most_bytes} bytes {}\n", keys.join(" "));
        }
        assert_eq!(text, include_str!("../tests/access.txt"));
    }
}
