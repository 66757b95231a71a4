//! Training: networks that learn on small scenes, stop and resume, and are evaluated. One at a time: they share a
//! generator.

mod fusion;
mod localization;
mod pastat;
mod sequences;
