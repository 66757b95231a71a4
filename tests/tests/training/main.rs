//! Training: networks that learn on small scenes, stop and resume, and are evaluated. One at a time: all draw from one generator.

mod fusion;
mod localization;
mod pastat;
mod sequences;
