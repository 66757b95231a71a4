//! Compute precision: the number format that a training computes products in.

use tch::Kind;

/// Number format of the products of a training.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum ComputePrecision {
    /// Single precision throughout.
    F32,
    /// Convolutions and products in bfloat16, several times faster if the CPU supports it; parameters, statistics and
    /// losses stay single.
    Bf16,
}

impl ComputePrecision {
    /// The corresponding type of the tensor library.
    pub fn kind(self) -> Kind {
        match self {
            Self::F32 => Kind::Float,
            Self::Bf16 => Kind::BFloat16,
        }
    }
}
