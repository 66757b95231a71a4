//! How long, and in which numbers.

use std::time::Duration;

use tch::Kind;

/// In which numbers the products of a training compute.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ComputePrecision {
    /// Single precision throughout.
    F32,
    /// Convolutions and products in bfloat16; parameters, statistics and losses stay single.
    Bf16,
}

impl ComputePrecision {
    /// The tensor library's name for it.
    #[must_use]
    pub fn kind(self) -> Kind {
        match self {
            Self::F32 => Kind::Float,
            Self::Bf16 => Kind::BFloat16,
        }
    }
}

/// Length of a training.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Length {
    /// So many steps.
    Steps(u64),
    /// So many passes over the data.
    Epochs(f64),
    /// As many steps as fit into a time; the learning rate follows the clock. Not repeatable to the bit.
    Time(Duration),
}

impl Length {
    /// The share that is done, 0 at the start, 1 or more at the end.
    #[must_use]
    pub fn share_done(self, step: u64, epoch: f64, seconds: f64) -> f64 {
        match self {
            Self::Steps(steps) => step as f64 / steps.max(1) as f64,
            Self::Epochs(epochs) => epoch / epochs.max(f64::MIN_POSITIVE),
            Self::Time(limit) => seconds / limit.as_secs_f64().max(f64::MIN_POSITIVE),
        }
    }
}
