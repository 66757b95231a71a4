//! Security: certificates, access control, rejected messages, misbehaviour detection, and the log texts of zenoh behind
//! the counters.

mod access_control;
mod adversaries;
mod bad_messages;
mod hosts;
mod misbehaviour;
mod zenoh_texts;
