//! DiffLoc (Li et al. 2024), small: pose regression of a sweep by denoising diffusion, on features of its range image.
//!
//! A range image ([`RangeImageConfig`]) becomes tokens, a transformer describes them, and a mask weighs the tokens of
//! static objects twice ([`SweepEncoder`]). The denoiser ([`PoseDenoiser`]) removes the noise from the poses of up
//! to three sweeps by their features, and a pose is found from noise in ten steps ([`NoiseSchedule::denoise`]).
//!
//! Departures from the paper: a transformer of four layers of 128 channels with random weights at the start, where the
//! paper has a foundation model of 21 million parameters; a denoiser of three layers; cosine and sine of the heading in
//! place of a quaternion's logarithm, since vehicles head in all directions and stand upright; batch norm of the pooled
//! features, which are nearly the same for all sweeps otherwise; the denoiser predicts the velocity instead of the
//! noise, whose errors are amplified twelve times in the pose at the last step, and its loss is the error of the pose;
//! noise is drawn sixteen times for each window, strong noise more often; place classification as an auxiliary loss;
//! augmentation by turns of 20 degrees and shifts of 1 m instead of 45 degrees and up to 5 m.

mod config;
mod context_stem;
mod denoiser;
mod localizer;
mod network;
mod noise_schedule;
mod range_image;
mod sweep_encoder;
mod transformer;

pub use config::DiffLocConfig;
pub use denoiser::{PoseDenoiser, Windows};
pub use localizer::DiffLocLocalizer;
pub use network::DiffLoc;
pub use noise_schedule::NoiseSchedule;
pub use range_image::{CHANNELS, RangeImageConfig, UNITS};
pub use sweep_encoder::{EncodedSweeps, SweepEncoder};
