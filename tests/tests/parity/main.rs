//! Parity with the reference implementations: layers, boxes, poses, losses and converted checkpoints.

mod boxes;
mod conversion;
mod detector;
mod ego;
mod fusion_graph;
mod fusion_transformers;
mod poses;
mod registration;
