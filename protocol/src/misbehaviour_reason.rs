//! Why a vehicle is not believed.

use crate::string_enum::named;

named! {
    /// What speaks against the words of a neighbour.
    pub enum Doubt {
        /// It is not where it says to be, or sees nothing of what is there.
        Elsewhere = "elsewhere",
        /// It sees vehicles where there are none.
        Invented = "invented",
        /// It says what somebody else has said.
        Copied = "copied",
        /// What it says has nothing to do with what it said just before.
        Inconsistent = "inconsistent",
        /// It stands where it cannot have driven to.
        Jumped = "jumped",
        /// Nothing speaks against it, but nothing for it either.
        Unproven = "unproven",
    }
}
