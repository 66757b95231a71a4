//! Misbehaviour reasons: causes for which a vehicle is excluded.

use crate::string_enum::named;

named! {
    /// Evidence against a neighbour.
    pub enum MisbehaviourReason {
        /// Its reported position is wrong, or it detects nothing of the objects around it.
        PositionMismatch = "position_mismatch",
        /// It reports vehicles that do not exist, or with another heading or size than they have.
        GhostObjects = "ghost_objects",
        /// Its message copies that of another vehicle.
        Duplicated = "duplicated",
        /// Its message contradicts its previous one.
        Inconsistent = "inconsistent",
        /// It reports a position that it cannot have reached.
        ImplausibleMotion = "implausible_motion",
        /// Not accepted yet (a new sender of boxes), or not yet again: the average of its evidence is below 0.7 log
        /// odds, the limit of readmission. Below -0.7, the limit of exclusion, the evidence is named instead.
        Probation = "probation",
        /// Its feature map has values that the network does not give.
        ImplausibleValues = "implausible_values",
    }
}
