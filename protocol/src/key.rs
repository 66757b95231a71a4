//! Key grammar of a run: the only place that builds and parses keys.
//!
//! | key | from | to | message |
//! | --- | --- | --- | --- |
//! | `v2v/<run>/<cav>/<stream>` | replay, agent | that vehicle's agent, link | by [`Stream`] |
//! | `v2v/<run>/<cav>/@preview` | replay | viewer | a few points of a sweep |
//! | `v2v/<run>/rx/<ego>/<cav>/<stream>` | link | the ego-fuser of `<ego>` | the same, after the link |
//! | `v2v/<run>/<ego>/detections[/json]` | ego-fuser | anyone | detections |
//! | `v2v/<run>/truth` | replay | scorer | truth |
//! | `v2v/<run>/control/<verb>` | operator, processes | replay, operator | control |
//! | `v2v/<run>/ready/<process>` | every process | owner of the clock | control |
//! | `v2v/<run>/stats/<process>` | every process | operator | stats |
//! | `v2v/<run>/alive/<role>/<cav>` | every process | anyone | none: a liveliness token |
//!
//! A vehicle cannot be called `rx`, `truth`, `control`, `ready`, `stats` or `alive` ([`CavId`] rejects it), so the
//! grammar is unambiguous. A [`Key`] never contains a wildcard; a subscription to several keys is a [`KeyExpr`].

use std::fmt;
use std::str::FromStr;

use crate::text::excerpt;
use crate::{CavId, IdError, ProcessId, Role, RunId, RunScope, Stream, Topic};

/// First chunk of every key.
const KEY_ROOT: &str = "v2v";
/// Chunk of a key that no process ever declares.
pub(crate) const UNDECLARED: &str = "undeclared";
/// Maximum length of a key, bytes; longer texts are rejected.
pub(crate) const MAX_KEY_BYTES: usize = 256;

/// Error of a text that is not a key: of another form, with a wildcard, or with a chunk that is not an identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct KeyError(pub(crate) String);

impl KeyError {
    pub(crate) fn id(text: &str, error: &IdError) -> Self {
        Self(format!("key {:?}: {error}", shown(text)))
    }

    pub(crate) fn unknown(text: &str) -> Self {
        let problem = format!("{:?} is no key of the form", shown(text));
        Self(format!("{problem} {KEY_ROOT}/<run>/..."))
    }
}

/// The beginning of a text, as shown in errors.
pub(crate) fn shown(text: &str) -> String {
    excerpt(text, MAX_KEY_BYTES)
}

/// One key: a run and a topic in it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Key {
    /// The run.
    pub run: RunId,
    /// The rest of the key.
    pub topic: Topic,
}

impl Key {
    /// `v2v/<run>/<cav>/<stream>`.
    pub fn stream(run: &RunId, cav: &CavId, stream: Stream) -> Self {
        Topic::stream(cav, stream).in_run(run)
    }

    /// `v2v/<run>/stats/<process>`.
    pub fn stats(run: &RunId, process: &ProcessId) -> Self {
        Topic::Stats(process.clone()).in_run(run)
    }

    /// `v2v/<run>/alive/<role>/<cav>`.
    pub fn alive(run: &RunId, role: Role, cav: &CavId) -> Self {
        let cav = cav.clone();
        Topic::Alive { role, cav }.in_run(run)
    }
}

impl fmt::Display for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{KEY_ROOT}/{}/{}", self.run, self.topic)
    }
}

impl FromStr for Key {
    type Err = KeyError;

    fn from_str(text: &str) -> Result<Self, KeyError> {
        let mut parts = text.splitn(3, '/');
        let (Some(KEY_ROOT), Some(run), Some(topic)) = (parts.next(), parts.next(), parts.next())
        else {
            return Err(KeyError::unknown(text));
        };
        let topic = topic.parse()?;
        let run = RunId::new(run).map_err(|error| KeyError::id(text, &error))?;
        Ok(Self { run, topic })
    }
}

/// A key expression to subscribe to; never one to publish on.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct KeyExpr(String);

impl KeyExpr {
    /// Keys below the run in some runs.
    pub(crate) fn within(runs: &RunScope, topics: &dyn fmt::Display) -> Self {
        Self(format!("{KEY_ROOT}/{runs}/{topics}"))
    }

    /// Everything of some runs, in two expressions: the wildcard of the first does not match chunks that begin with
    /// `@`.
    pub fn all_of(runs: &RunScope) -> [Self; 2] {
        [
            Self::within(runs, &"**"),
            Self::within(runs, &format_args!("*/{}", Stream::Preview)),
        ]
    }

    /// Everything of a run but previews.
    pub fn run(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/**"))
    }

    /// Key that no process ever declares: `v2v/<run>/undeclared`. A query on it reaches the router only.
    pub fn none(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/{UNDECLARED}"))
    }

    /// One key.
    pub fn one(key: &Key) -> Self {
        Self(key.to_string())
    }

    /// One stream of every vehicle, before the link.
    pub fn stream(run: &RunId, stream: Stream) -> Self {
        Self(format!("{KEY_ROOT}/{run}/*/{stream}"))
    }

    /// The images of all cameras of every vehicle.
    pub fn cameras(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/*/camera/*"))
    }

    /// One stream of every vehicle as it reaches any ego over the link.
    pub fn received_by_anyone(run: &RunId, stream: Stream) -> Self {
        Self(format!("{KEY_ROOT}/{run}/rx/*/*/{stream}"))
    }

    /// The truth.
    pub fn truth(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/truth"))
    }

    /// Every control message.
    pub fn control(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/control/*"))
    }

    /// Readiness of every process: the routes that it has confirmed.
    pub fn ready(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/ready/*"))
    }

    /// The statistics of every process.
    pub fn stats(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/stats/*"))
    }

    /// The liveliness tokens of one role.
    pub fn alive(run: &RunId, role: Role) -> Self {
        Self(format!("{KEY_ROOT}/{run}/alive/{role}/*"))
    }

    /// The liveliness tokens of all processes.
    pub fn everyone_alive(run: &RunId) -> Self {
        Self(format!("{KEY_ROOT}/{run}/alive/*/*"))
    }

    /// True if it covers every key of the other. As in zenoh, wildcards cover no chunk that begins with `@`.
    pub fn includes(&self, other: &Self) -> bool {
        let mut chunks = other.0.split('/');
        for own in self.0.split('/') {
            // Always the last chunk.
            if own == "**" {
                return chunks.all(|chunk| !chunk.starts_with('@'));
            }
            let is_covered = |chunk: &str| {
                own == chunk || own == "*" && chunk != "**" && !chunk.starts_with('@')
            };
            if !chunks.next().is_some_and(is_covered) {
                return false;
            }
        }
        chunks.next().is_none()
    }

    /// The key expression.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for KeyExpr {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::Verb;

    fn cav(text: &str) -> CavId {
        CavId::new(text).unwrap()
    }

    fn every_key() -> Vec<(Key, &'static str)> {
        let run = &RunId::new("r1").unwrap();
        let (ego, other) = (&cav("4279"), &cav("-1"));
        vec![
            (Key::stream(run, ego, Stream::Lidar), "v2v/r1/4279/lidar"),
            (
                Key::stream(run, ego, Stream::Preview),
                "v2v/r1/4279/@preview",
            ),
            (Key::stream(run, ego, Stream::Gnss), "v2v/r1/4279/gnss"),
            (
                Key::stream(run, ego, Stream::Camera(2)),
                "v2v/r1/4279/camera/2",
            ),
            (Key::stream(run, ego, Stream::Radar), "v2v/r1/4279/radar"),
            (Key::stream(run, ego, Stream::Pose), "v2v/r1/4279/pose"),
            (Key::stream(run, ego, Stream::Bev), "v2v/r1/4279/bev"),
            (Key::stream(run, ego, Stream::Boxes), "v2v/r1/4279/boxes"),
            (Key::stream(run, ego, Stream::Points), "v2v/r1/4279/points"),
            (
                Key::stream(run, ego, Stream::Descriptor),
                "v2v/r1/4279/descriptor",
            ),
            (
                Key::stream(run, ego, Stream::Detections),
                "v2v/r1/4279/detections",
            ),
            (
                Key::stream(run, ego, Stream::DetectionsJson),
                "v2v/r1/4279/detections/json",
            ),
            (Key::stream(run, ego, Stream::Tracks), "v2v/r1/4279/tracks"),
            (
                Key::stream(run, ego, Stream::TracksJson),
                "v2v/r1/4279/tracks/json",
            ),
            (
                Topic::Received {
                    ego: ego.clone(),
                    cav: other.clone(),
                    stream: Stream::Bev,
                }
                .in_run(run),
                "v2v/r1/rx/4279/-1/bev",
            ),
            (Topic::Truth.in_run(run), "v2v/r1/truth"),
            (
                Topic::Control(Verb::Start).in_run(run),
                "v2v/r1/control/start",
            ),
            (
                Topic::Ready(ProcessId::new("agent-4279").unwrap()).in_run(run),
                "v2v/r1/ready/agent-4279",
            ),
            (
                Key::stats(run, &ProcessId::new("agent-4279").unwrap()),
                "v2v/r1/stats/agent-4279",
            ),
            (Key::alive(run, Role::Agent, other), "v2v/r1/alive/agent/-1"),
        ]
    }

    #[test]
    fn every_key_is_written_and_read_back() {
        for (key, text) in every_key() {
            assert_eq!(key.to_string(), text);
            assert_eq!(text.parse::<Key>().unwrap(), key);
        }
        for verb in Verb::ALL {
            let key = Topic::Control(verb).in_run(&RunId::new("r").unwrap());
            assert_eq!(key.to_string().parse::<Key>().unwrap(), key);
        }
        for role in Role::ALL {
            let key = Key::alive(&RunId::new("r").unwrap(), role, &cav("1"));
            assert_eq!(key.to_string().parse::<Key>().unwrap(), key);
        }
    }

    #[test]
    fn refuses_wildcards() {
        for text in [
            "v2v/*/4279/bev",
            "v2v/r1/*/bev",
            "v2v/r1/**",
            "v2v/r1/a$*/bev",
            "v2v/r1/4279/camera/*",
        ] {
            assert!(text.parse::<Key>().is_err(), "{text}");
        }
        let error = "v2v/r1/*/bev".parse::<Key>().unwrap_err().to_string();
        assert!(error.ends_with("holds a wildcard"), "{error}");
    }

    #[test]
    fn refuses_what_is_no_key() {
        let long = format!("v2v/r1/{}", "a/".repeat(100_000));
        for text in [
            "",
            "v2v",
            "v2v/r1",
            "v2v/r1/",
            "v2v//4279/bev",
            "v2x/r1/4279/bev",
            "v2v/r1/4279/sonar",
            "v2v/r1/4279/bev/",
            "v2v/r1/4279/camera/007",
            "v2v/r1/4279/camera/256",
            "v2v/r1/4279/camera/+1",
            "v2v/r1/control/explode",
            "v2v/r1/rx/4279/bev",
            "v2v/r1/rx/4279/truth/bev",
            "v2v/r1/alive/agent/@x",
            "V2V/r1/truth",
            &long,
        ] {
            let error = text.parse::<Key>().unwrap_err();
            assert!(error.to_string().len() < 1000);
        }
    }

    #[test]
    fn selectors_name_the_keys_they_are_for() {
        let run = RunId::new("r1").unwrap();
        assert_eq!(KeyExpr::stream(&run, Stream::Bev).as_str(), "v2v/r1/*/bev");
        assert_eq!(
            KeyExpr::received_by_anyone(&run, Stream::Pose).as_str(),
            "v2v/r1/rx/*/*/pose"
        );
        assert_eq!(KeyExpr::truth(&run).as_str(), "v2v/r1/truth");
        assert_eq!(
            KeyExpr::alive(&run, Role::Agent).as_str(),
            "v2v/r1/alive/agent/*"
        );
        assert_eq!(KeyExpr::everyone_alive(&run).as_str(), "v2v/r1/alive/*/*");
        assert_eq!(KeyExpr::control(&run).as_str(), "v2v/r1/control/*");
        assert_eq!(KeyExpr::ready(&run).as_str(), "v2v/r1/ready/*");
        assert_eq!(KeyExpr::stats(&run).as_str(), "v2v/r1/stats/*");
        assert_eq!(KeyExpr::run(&run).as_str(), "v2v/r1/**");
        assert!(KeyExpr::run(&run).as_str().parse::<Key>().is_err());
    }

    #[test]
    fn a_wildcard_includes_the_chunks_that_it_stands_for() {
        let run = RunId::new("r1").unwrap();
        let [camera, preview, own] = [
            KeyExpr::stream(&run, Stream::Camera(3)),
            KeyExpr::stream(&run, Stream::Preview),
            KeyExpr::one(&Key::stream(&run, &cav("1"), Stream::Camera(3))),
        ];
        let (cameras, all) = (KeyExpr::cameras(&run), KeyExpr::run(&run));
        for (wide, narrow) in [(&cameras, &camera), (&camera, &own), (&all, &cameras)] {
            assert!(wide.includes(narrow) && !narrow.includes(wide), "{wide}");
            assert!(wide.includes(wide));
        }
        let other = KeyExpr::stream(&run, Stream::Camera(30));
        assert!(!camera.includes(&other) && !other.includes(&camera));
        assert!(preview.includes(&preview) && !all.includes(&preview));
        assert!(!KeyExpr::stats(&run).includes(&all));
    }

    proptest! {
        #[test]
        fn any_text_is_refused_or_is_its_own_spelling(text in "(v2v/)?[a-z0-9/*_-]{0,40}") {
            if let Ok(key) = text.parse::<Key>() {
                prop_assert_eq!(key.to_string(), text);
            }
        }
    }
}
