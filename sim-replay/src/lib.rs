//! Scenes as live traffic: reading recorded scenes, generating new ones, streaming both, and the emulated air between
//! vehicles.

pub mod town;
