//! Why a vehicle is not believed.

use crate::string_enum::named;

named! {
    /// What speaks against the words of a neighbour.
    pub enum MisbehaviourReason {
        /// It is not where it says to be, or sees nothing of what is there.
        PositionMismatch = "position_mismatch",
        /// It sees vehicles where there are none.
        GhostObjects = "ghost_objects",
        /// It says what somebody else has said.
        Duplicated = "duplicated",
        /// What it says has nothing to do with what it said just before.
        Inconsistent = "inconsistent",
        /// It stands where it cannot have driven to.
        ImplausibleMotion = "implausible_motion",
        /// Nothing speaks against it, but nothing for it either.
        Probation = "probation",
    }
}
