//! Helpers of the test programs: buses, fleets, fixtures, locks and small scenes.

pub mod bus;
pub mod faults;
pub mod fixtures;
pub mod fleet;
pub mod hosts;
pub mod keys;
pub mod localizer;
pub mod locks;
pub mod machine;
pub mod mutation;
pub mod networks;
pub mod opencood;
pub mod scene;
pub mod sequences;
pub mod tensors;
pub mod training;
