//! Reasons for which messages are dropped.

use crate::string_enum::named;

named! {
    /// Reason for which a message was not used.
    pub enum DropReason {
        /// Lost on the emulated link.
        LinkLoss = "link_loss",
        /// The queue of the emulated link was full, or kept the newest message only.
        LinkQueue = "link_queue",
        /// Replaced by a newer message before it was used.
        Superseded = "superseded",
        /// Too old on arrival, or held by the emulated link for too long when the run ended.
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
    /// True if data were lost that should have been used: not by the emulated link, not because they were rightly
    /// rejected, and not a copy of what had arrived.
    pub fn is_loss(self) -> bool {
        !matches!(
            self,
            Self::LinkLoss
                | Self::LinkQueue
                | Self::Duplicate
                | Self::OutOfRange
                | Self::Misbehaviour
                | Self::Unneeded
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_emulated_link_does_is_no_loss() {
        let of_link = [
            DropReason::LinkLoss,
            DropReason::LinkQueue,
            DropReason::Duplicate,
        ];
        assert!(!of_link.into_iter().any(DropReason::is_loss));
        assert!(DropReason::Superseded.is_loss() && DropReason::Stale.is_loss());
    }
}
