//! DiffLoc (Li et al. 2024), small: pose regression of a sweep by denoising diffusion, on tokens of PGC's frozen encoder.
//!
//! A transformer describes the tokens of a sweep, and a mask weighs those of static objects twice. The denoiser
//! ([`PoseDenoiser`]) removes the noise from the poses of up to three sweeps by their features, and a pose is found
//! from noise in ten steps ([`NoiseSchedule::denoise`]).
//!
//! Departures from the paper: a transformer of two layers of 128 channels on 64 tokens of PGC's encoder, where the paper
//! has a foundation model of images; a pose is relative to the likeliest of some hundred place classes, the true one in
//! training, and only that is diffused; a map for each token's position in place of the mean of tokens, which would
//! forget where they lie; cosine and sine of the heading in place of a quaternion's logarithm, since vehicles head in
//! all directions and stand upright; the denoiser predicts the velocity instead of the noise, whose errors are
//! amplified twelve times in the pose at the last step, and its loss is the error of the pose; noise is drawn several
//! times for each window, strong noise more often; augmentation turns by whole sectors.

mod denoiser;
mod network;
mod noise_schedule;
mod transformer;

pub use denoiser::PoseDenoiser;
pub use network::{DescribedTokens, DiffLoc, DiffLocLocalizer};
pub use noise_schedule::NoiseSchedule;
