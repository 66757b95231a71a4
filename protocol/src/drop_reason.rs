//! Why messages are lost.

use crate::string_enum::named;

named! {
    /// Why a message was not used.
    pub enum DropReason {
        /// Lost on the emulated air.
        LinkLoss = "link_loss",
        /// The emulated air's queue was full.
        LinkQueue = "link_queue",
        /// A newer one took its place before it was used.
        Superseded = "superseded",
        /// Too old when it came.
        Stale = "stale",
        /// The same one had come before.
        Duplicate = "duplicate",
        /// Not a message, or not of this kind.
        Decode = "decode",
        /// Changed on the way.
        Checksum = "checksum",
        /// Sizes that do not agree with each other, with what was announced, or with the limits; maps of another
        /// network.
        Shape = "shape",
        /// A value that is NaN, infinite or out of bounds.
        NotFinite = "not_finite",
        /// Sent under another's name.
        Identity = "identity",
        /// Of another wire version.
        Version = "version",
        /// Sender or receiver does not know where it is.
        NoPose = "no_pose",
        /// From a vehicle farther away than vehicles talk to each other.
        OutOfRange = "out_of_range",
        /// Who sent it, was to have it or carried it was away for a while, and nobody can tell what became of it.
        PeerOffline = "peer_offline",
        /// Of a time that has not come yet.
        Future = "future",
        /// From a vehicle whose words do not fit what the ego sees itself.
        Distrusted = "distrusted",
        /// More than its sender may send in that time.
        RateLimit = "rate_limit",
    }
}

impl DropReason {
    /// Whether data were lost that should have been used: not by what the air does to them, and not for being rightly
    /// left out.
    #[must_use]
    pub fn is_loss(self) -> bool {
        !matches!(self, Self::LinkLoss | Self::LinkQueue | Self::OutOfRange | Self::Distrusted)
    }
}
