//! Security: certificates, access control, messages refused, misbehaviour, and the texts of zenoh that their counters read.

mod access_control;
mod adversaries;
mod bad_messages;
mod hosts;
mod misbehaviour;
mod zenoh_texts;
