//! Scales of the activations of a network, as its weights file stores them.

use std::collections::BTreeMap;

use protocol::text::hex;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::error::QuantiseError;
use super::scale::Quantisation;

/// Metadata key of the scales in a weights file.
pub const SCALES_KEY: &str = "activation_scales";

/// Quantisation of each activation, by name: that of the layer whose output it is, below the prefixes of the weights.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ActivationScales(pub(super) BTreeMap<String, Quantisation>);

impl ActivationScales {
    /// Quantisation of an activation.
    ///
    /// # Errors
    /// [`QuantiseError::Scale`] if it was not observed.
    pub fn get(&self, name: &str) -> Result<Quantisation, QuantiseError> {
        let known = || self.0.keys().cloned().collect();
        let scale = self.0.get(name).copied();
        scale.ok_or_else(|| QuantiseError::Scale(name.to_owned(), known()))
    }

    /// SHA-256 over the scales of the activations whose name is `wanted`.
    pub fn sha256_of(&self, wanted: impl Fn(&str) -> bool) -> String {
        let mut hash = Sha256::new();
        let wanted = self.0.iter().filter(|(name, _)| wanted(name));
        for (name, Quantisation { scale, zero_point }) in wanted {
            hash.update(format!("{name} {} {zero_point}\n", scale.exponent));
        }
        hex(&hash.finalize())
    }

    /// Number of activations.
    pub fn len(&self) -> usize {
        self.0.len()
    }

    /// True if there is none.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
}
