//! Reasons for which messages are dropped.

use crate::string_enum::named;

named! {
    /// Reason for which a message was not used.
    pub enum DropReason {
        /// Lost on the emulated link.
        LinkLoss = "link_loss",
        /// The queue of the emulated link was full.
        LinkQueue = "link_queue",
        /// Replaced by a newer message before it was used.
        Superseded = "superseded",
        /// Too old on arrival.
        Stale = "stale",
        /// The same message had arrived before.
        Duplicate = "duplicate",
        /// Not a message, or not of this kind.
        Decode = "decode",
        /// Corrupted in transit.
        Checksum = "checksum",
        /// Sizes that do not agree with each other, with the announcement, or with the limits; feature maps of another
        /// network.
        Shape = "shape",
        /// A value that is NaN, infinite or out of bounds.
        NotFinite = "not_finite",
        /// Sender in the header differs from the owner of the key.
        Identity = "identity",
        /// Other wire version.
        Version = "version",
        /// Sender or receiver has no pose.
        NoPose = "no_pose",
        /// Sender is beyond the communication range.
        OutOfRange = "out_of_range",
        /// Sender, receiver or link was offline for a while; the message cannot be accounted for.
        PeerOffline = "peer_offline",
        /// Capture time is in the future.
        Future = "future",
        /// Sender was excluded by misbehaviour detection.
        Misbehaviour = "misbehaviour",
        /// Not computed, so that answers come less often instead of later: the ego has no time for this sweep.
        Paced = "paced",
        /// Exceeds the rate limit of its sender.
        RateLimit = "rate_limit",
        /// Taken by the router and not handed on to this receiver, which took earlier messages too slowly or had lost
        /// its connection.
        Undelivered = "undelivered",
        /// The capture clock of its sender is unsteady or was corrected anew.
        Clock = "clock",
        /// Another message of its sender was used in its place: boxes beside a feature map, or the map where it is late.
        Unneeded = "unneeded",
    }
}

impl DropReason {
    /// True if data were lost that should have been used: not by the emulated link, and not because they were rightly
    /// rejected.
    pub fn is_loss(self) -> bool {
        !matches!(
            self,
            Self::LinkLoss
                | Self::LinkQueue
                | Self::OutOfRange
                | Self::Misbehaviour
                | Self::Unneeded
        )
    }
}
