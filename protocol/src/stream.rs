//! Streams of one vehicle, the last chunks of its keys: one row per stream. Keys, permissions, accounting and the
//! limits of routers follow from it.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::string_enum::written_as_text;
use crate::{KeyError, Kind, Role};

/// A row: what holds for the messages of a stream.
#[derive(Debug, Clone, Copy)]
pub(crate) struct StreamRow {
    /// Their kind, which is in their headers; `None`: JSON, without a header.
    pub kind: Option<Kind>,
    /// Process that publishes them: the vehicle's agent or ego, or the replay. [`crate::access`] derives the receivers.
    pub sender: Role,
    /// True if the ledger covers them: not previews, nor messages that are repeated for late joiners, whose number of
    /// receptions is undefined.
    pub is_counted: bool,
    /// Limit of their size at a router, which does not read them, bytes; `None`: limited by the transport only.
    pub most_bytes: Option<usize>,
}

/// A table of streams.
pub(crate) trait StreamTable: Copy + fmt::Display + 'static {
    /// One stream of each row.
    const ROWS: &'static [Self];

    /// The row of the stream.
    fn row(self) -> StreamRow;

    /// Last chunks of the keys of its row, with a wildcard in place of a number.
    fn selector(self) -> String;
}

/// Rows `Variant = "chunks": kind, sender, is it counted, most bytes at a router`, each with its documentation. A row
/// of several numbered streams names the number: `Variant(index: u8) = "chunks/{index}"`.
macro_rules! streams {
    ($(
        $(#[$doc:meta])*
        $variant:ident $(($index:ident: $number:ty))? = $name:literal:
            $kind:expr, $sender:ident, $is_counted:expr, $most_bytes:expr;
    )+) => {
        /// A stream of one vehicle.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        #[cfg_attr(feature = "config", derive(schemars::JsonSchema))]
        pub enum Stream {
            $($(#[$doc])* $variant $(($number))?,)+
        }

        impl StreamTable for Stream {
            const ROWS: &'static [Self] = &[$(Self::$variant $((<$number>::MIN))?),+];

            fn row(self) -> StreamRow {
                let (kind, sender, is_counted, most_bytes) = match self {
                    $(Self::$variant { .. } => ($kind, Role::$sender, $is_counted, $most_bytes),)+
                };
                StreamRow { kind, sender, is_counted, most_bytes }
            }

            fn selector(self) -> String {
                match self {
                    $(Self::$variant { .. } => {
                        $(let $index = "*";)?
                        format_args!($name).to_string()
                    })+
                }
            }
        }

        impl Stream {
            /// Reads the chunks of a key that name a stream.
            pub(crate) fn from_chunks(chunks: &[&str]) -> Option<Self> {
                $(if is_named(chunks, $name) {
                    return Some(Self::$variant $((number::<$number>(chunks)?))?);
                })+
                None
            }
        }

        impl fmt::Display for Stream {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                match self {
                    $(Self::$variant $(($index))? => write!(f, $name),)+
                }
            }
        }

        impl FromStr for Stream {
            type Err = KeyError;

            fn from_str(text: &str) -> Result<Self, KeyError> {
                let chunks: Vec<&str> = text.splitn(3, '/').collect();
                Self::from_chunks(&chunks).ok_or_else(|| KeyError::unknown(text))
            }
        }

        written_as_text!(Stream);
    };
}

streams! {
    /// `lidar`: sweeps.
    Lidar = "lidar": Some(Kind::Lidar), Replay, true, None;
    /// `@preview`: a few points of every sweep, for viewers. A subscription to all keys does not match a chunk that
    /// begins with `@`: a recording has whole sweeps.
    Preview = "@preview": Some(Kind::Lidar), Replay, false, Some(64 << 10);
    /// `gnss`: recorded or GNSS poses.
    Gnss = "gnss": Some(Kind::Gnss), Replay, true, Some(16 << 10);
    /// `imu`: speed and yaw rate that the vehicle measures itself.
    Imu = "imu": Some(Kind::Imu), Replay, true, Some(16 << 10);
    /// `camera/<k>`: images of camera `k`.
    Camera(index: u8) = "camera/{index}": Some(Kind::Camera), Replay, true, None;
    /// `radar`: radar sweeps.
    Radar = "radar": Some(Kind::Radar), Replay, true, None;
    /// `pose`: pose estimates.
    Pose = "pose": Some(Kind::Pose), Agent, true, Some(16 << 10);
    /// `bev`: feature maps.
    Bev = "bev": Some(Kind::Bev), Agent, true, None;
    /// `boxes`: detections of one vehicle from its own sensors.
    Boxes = "boxes": Some(Kind::Boxes), Agent, true, Some(4 << 20);
    /// `points`: raw points, for the early-fusion baseline only.
    Points = "points": Some(Kind::Points), Agent, true, None;
    /// `pace`: the sweeps that an ego has time for.
    Pace = "pace": Some(Kind::Pace), Ego, false, Some(16 << 10);
    /// `descriptor`: model and streams of the vehicle.
    Descriptor = "descriptor": Some(Kind::Descriptor), Agent, false, Some(4 << 20);
    /// `detections`: detections of an ego.
    Detections = "detections": Some(Kind::Detections), Ego, true, Some(4 << 20);
    /// `detections/json`: the same as JSON.
    DetectionsJson = "detections/json": None, Ego, true, None;
    /// `tracks`: tracks of an ego.
    Tracks = "tracks": Some(Kind::Tracks), Ego, true, Some(4 << 20);
    /// `tracks/json`: the same as JSON.
    TracksJson = "tracks/json": None, Ego, true, None;
}

impl Stream {
    /// The kind of the messages on this stream; `None` if they do not have this wire format.
    pub fn kind(self) -> Option<Kind> {
        self.row().kind
    }

    /// Role of the process that publishes them: the vehicle's agent or ego, or the replay.
    pub fn sender(self) -> Role {
        self.row().sender
    }
}

/// True if the chunks are those of a name, whose number may be any text.
fn is_named(chunks: &[&str], name: &str) -> bool {
    let names = name.split('/');
    let mut pairs = names.clone().zip(chunks);
    names.count() == chunks.len()
        && pairs.all(|(name, chunk)| name == *chunk || name.starts_with('{'))
}

/// The number in the last chunk. One stream has one spelling: no sign, no leading zero.
fn number<N: FromStr + ToString>(chunks: &[&str]) -> Option<N> {
    let text = chunks.last()?;
    let number: N = text.parse().ok()?;
    (number.to_string() == *text).then_some(number)
}

#[cfg(test)]
mod tests {
    /// A table of its own, with streams that the protocol does not have.
    #[allow(unreachable_pub)]
    mod dummy {
        use std::fmt;
        use std::str::FromStr;

        use serde::{Deserialize, Serialize};

        use super::super::{StreamRow, StreamTable, is_named, number};
        use crate::string_enum::written_as_text;
        use crate::{KeyError, Kind, Role};

        streams! {
            /// Sound.
            Sonar = "sonar": Some(Kind::Radar), Replay, true, None;
            /// Sound at each microphone of an agent.
            Echo(ear: u8) = "echo/{ear}": Some(Kind::Boxes), Agent, true, Some(1 << 10);
            /// Volume that an ego asks for.
            Volume = "volume": Some(Kind::Pace), Ego, false, Some(1 << 9);
        }
    }

    use dummy::Stream;

    use super::StreamTable;
    use crate::access::size_limits_of;
    use crate::{Kind, Principal, RunId, RunScope};

    /// Keys of a run, by principal: those on which it publishes, and those to which it subscribes.
    fn keys(principal: &str) -> [Vec<String>; 2] {
        let runs = RunScope::One(RunId::new("r").unwrap());
        let principal: Principal = principal.parse().unwrap();
        let [publish, subscribe] = principal.streams::<Stream>(&runs);
        [publish, subscribe].map(|keys| keys.iter().map(ToString::to_string).collect())
    }

    #[test]
    fn a_new_stream_is_one_row() {
        for (text, stream) in [
            ("sonar", Stream::Sonar),
            ("echo/2", Stream::Echo(2)),
            ("volume", Stream::Volume),
        ] {
            assert_eq!(stream.to_string(), text);
            assert_eq!(text.parse(), Ok(stream));
            assert_eq!(String::from(stream), text);
        }
        for text in ["echo", "echo/02", "echo/256", "echo/2/2", "sonar/1", ""] {
            assert!(text.parse::<Stream>().is_err(), "{text}");
        }
        assert_eq!(Stream::Echo(1).row().kind, Some(Kind::Boxes));
        assert!(Stream::Sonar.row().is_counted && !Stream::Volume.row().is_counted);

        assert_eq!(
            keys("agent-1"),
            [
                vec!["v2v/r/1/echo/*"],
                vec!["v2v/r/1/sonar", "v2v/r/*/volume"]
            ]
        );
        assert_eq!(
            keys("ego-2"),
            [
                vec!["v2v/r/2/volume"],
                vec!["v2v/r/*/echo/*", "v2v/r/rx/2/*/echo/*"]
            ]
        );
        assert_eq!(
            keys("link-2"),
            [vec!["v2v/r/rx/2/*/echo/*"], vec!["v2v/r/*/echo/*"]]
        );
        assert_eq!(keys("replay"), [vec!["v2v/r/*/sonar"], vec![]]);

        let limits = size_limits_of::<Stream>().map(|(keys, most_bytes)| {
            let keys: Vec<String> = keys.iter().map(ToString::to_string).collect();
            (keys.join(" "), most_bytes)
        });
        let expected = [
            ("v2v/*/*/volume v2v/*/rx/*/*/volume", 512),
            ("v2v/*/*/echo/* v2v/*/rx/*/*/echo/*", 1024),
        ];
        assert_eq!(
            limits.collect::<Vec<_>>(),
            expected.map(|(keys, most_bytes)| (keys.to_owned(), most_bytes))
        );
    }
}
