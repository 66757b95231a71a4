//! sim-replay
