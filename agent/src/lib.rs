//! What one connected vehicle does with its sweep: where am I, what do I see, what do I tell the others.

pub mod agent_attention;
pub mod backbone;
pub mod convolution;
pub mod head;
pub mod model_config;
pub mod pillar_batch;
pub mod pillar_encoder;
pub mod pillars;
pub mod point_pillars;
pub mod shrink;
pub mod weights;
