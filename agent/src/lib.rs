//! What one connected vehicle does with its sweep: where am I, what do I see, what do I tell the others.

#![warn(clippy::print_stdout, clippy::print_stderr)]

pub mod agent;
pub mod agent_attention;
pub mod anchors;
pub mod attack;
pub mod backbone;
pub mod canvas;
pub mod chart;
pub mod chart_svg;
pub mod convolution;
pub mod crop;
pub mod decode;
pub mod detector;
pub mod head;
pub mod localizer;
pub mod model_config;
pub mod nms;
pub mod node;
pub mod pillar_batch;
pub mod pillar_encoder;
pub mod pillar_projection;
pub mod pillars;
pub mod point_pillars;
pub mod pose_error;
pub mod pose_source;
pub mod postprocess;
pub mod process;
pub mod rate;
pub mod registration;
pub mod residual;
pub mod shrink;
pub mod sparse;
pub mod statistics;
pub mod sweep_log;
pub mod sweep_pairing;
pub mod training;
pub mod weights;
