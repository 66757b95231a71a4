//! Message table: one row per message. Kinds, the enum of all messages and their dispatch are generated from it.

use serde::{Deserialize, Serialize};

use super::{
    Bev, Boxes, Camera, Control, Descriptor, Detections, EgoMotion, Gnss, Lidar, Pace, Payload,
    Points, PoseEstimate, Radar, Stats, Tracks, Truth,
};
use crate::WireError;

/// Operation on a message of any kind.
pub(crate) trait MessageVisitor {
    /// Result of the operation.
    type Output;

    /// Operates on a message.
    fn visit<M: Payload>(self, message: M) -> Self::Output;
}

/// Source of one message whose kind is known.
pub(crate) trait MessageSource {
    /// Decodes the message.
    fn read<M: Payload>(self) -> Result<M, WireError>;
}

/// Rows `number => Variant(Type) = "name"`, each with its documentation.
macro_rules! messages {
    ($($(#[$doc:meta])* $number:literal => $variant:ident($payload:ty) = $name:literal,)+) => {
        /// Kind of a message. The numbers are on the wire: never reuse one.
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, strum::Display,
            strum::EnumString,
        )]
        #[serde(rename_all = "snake_case")]
        #[repr(u8)]
        pub enum Kind {
            $($(#[$doc])* #[strum(serialize = $name)] $variant = $number,)+
        }

        impl Kind {
            /// Every kind, by number.
            pub const ALL: [Self; [$($number),+].len()] = [$(Self::$variant),+];

            /// Kind of a number on the wire.
            pub(crate) fn from_wire(found: u8) -> Result<Self, WireError> {
                Self::ALL.into_iter().find(|kind| *kind as u8 == found).ok_or(WireError::UnknownKind(found))
            }
        }

        /// Message of any kind, for receivers of all kinds: recorder, link, tests.
        #[derive(Debug, Clone, PartialEq)]
        pub enum Message {
            $($(#[$doc])* $variant($payload),)+
        }

        impl Message {
            /// Kind of the message.
            pub fn kind(&self) -> Kind {
                match self {
                    $(Self::$variant(_) => Kind::$variant,)+
                }
            }

            /// Applies an operation to the message.
            pub(crate) fn visit<V: MessageVisitor>(self, visitor: V) -> V::Output {
                match self {
                    $(Self::$variant(message) => visitor.visit(message),)+
                }
            }

            /// Reads a message of a kind.
            pub(crate) fn read<S: MessageSource>(kind: Kind, source: S) -> Result<Self, WireError> {
                match kind {
                    $(Kind::$variant => source.read().map(Self::$variant),)+
                }
            }
        }
    };
}

messages! {
    /// LiDAR sweep, replay to agent.
    1 => Lidar(Lidar) = "lidar",
    /// Radar sweep, replay to agent.
    2 => Radar(Radar) = "radar",
    /// Recorded or GNSS pose, replay to agent.
    3 => Gnss(Gnss) = "gnss",
    /// Pose estimate, agent to ego.
    4 => Pose(PoseEstimate) = "pose",
    /// BEV feature map, agent to ego (intermediate fusion).
    5 => Bev(Bev) = "bev",
    /// Detections of one agent, agent to ego (late fusion).
    6 => Boxes(Boxes) = "boxes",
    /// Points of one agent, agent to ego (early fusion).
    7 => Points(Points) = "points",
    /// Announcement of the messages that an agent is going to send, agent to ego.
    8 => Descriptor(Descriptor) = "descriptor",
    /// Detections of the ego, ego to any subscriber.
    9 => Detections(Detections) = "detections",
    /// Ground-truth poses and objects, replay to scorer.
    10 => Truth(Truth) = "truth",
    /// Start, stop, readiness, operator to all.
    11 => Control(Control) = "control",
    /// Message counters and stage timings, any process to the operator.
    12 => Stats(Stats) = "stats",
    /// Speed and yaw rate that a vehicle measures itself, replay to agent.
    13 => Imu(EgoMotion) = "imu",
    /// Sweeps that an ego has time for, ego to agents.
    14 => Pace(Pace) = "pace",
    /// Image of a camera, replay to viewers and recorders.
    15 => Camera(Camera) = "camera",
    /// Tracks of the ego, ego to any subscriber.
    16 => Tracks(Tracks) = "tracks",
}

#[cfg(test)]
mod tests {
    /// A table of its own, with one message that the protocol does not have.
    #[allow(unreachable_pub)]
    mod dummy {
        use serde::{Deserialize, Serialize};

        use super::super::{MessageSource, MessageVisitor, Payload};
        use crate::{Body, BodyShape, Limits, WireError};

        #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
        pub(crate) struct Ping {
            pub count: u32,
        }

        impl crate::message::private::Sealed for Ping {}

        impl Payload for Ping {
            const KIND: crate::Kind = crate::Kind::Control;
            type Metadata = Self;

            fn into_parts(self) -> (Self, Body) {
                (self, Body::Empty)
            }

            fn check(_: &Self, _: &Limits) -> Result<BodyShape, WireError> {
                Ok(BodyShape::Empty)
            }

            fn from_parts(metadata: Self, _: Body) -> Result<Self, WireError> {
                Ok(metadata)
            }
        }

        messages! {
            /// Round trip.
            200 => Ping(Ping) = "ping",
        }
    }

    use dummy::{Kind, Message, Ping};

    use super::{MessageSource, MessageVisitor, Payload};
    use crate::WireError;

    struct MetadataBytes;

    impl MessageVisitor for MetadataBytes {
        type Output = Vec<u8>;

        fn visit<M: Payload>(self, message: M) -> Vec<u8> {
            serde_json::to_vec(&message.into_parts().0).unwrap()
        }
    }

    struct FromBytes(Vec<u8>);

    impl MessageSource for FromBytes {
        fn read<M: Payload>(self) -> Result<M, WireError> {
            M::from_parts(serde_json::from_slice(&self.0).unwrap(), crate::Body::Empty)
        }
    }

    #[test]
    fn a_new_message_is_one_row() {
        let ping = Message::Ping(Ping { count: 7 });
        assert_eq!(
            (
                ping.kind(),
                Kind::ALL.len(),
                Kind::Ping.to_string().as_str()
            ),
            (Kind::Ping, 1, "ping")
        );
        assert_eq!(Kind::from_wire(200).unwrap(), Kind::Ping);
        assert!(matches!(Kind::from_wire(1), Err(WireError::UnknownKind(1))));
        let bytes = ping.clone().visit(MetadataBytes);
        assert_eq!(Message::read(Kind::Ping, FromBytes(bytes)).unwrap(), ping);
    }
}
