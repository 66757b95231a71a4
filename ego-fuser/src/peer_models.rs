//! Peer models: detects agents whose maps come from another network than the ego's, by their descriptors.
//!
//! Maps on another grid are rejected one by one in any case. Maps on the same grid from other weights are not: they are
//! valid and have another meaning.

use std::collections::BTreeMap;

use perception::detector::Detector;
use protocol::message::{Descriptor, ModelHash};
use protocol::{BevGrid, CavId, EncodedFeatures, WireError};

/// The ego's network, and the agents known to run another one. Agents without a descriptor are not among them.
pub(crate) struct PeerModels {
    grid: BevGrid,
    /// Channels as transmitted.
    channels: u32,
    code_of: Option<u32>,
    model_hash: ModelHash,
    /// The field that differs, and both values.
    others: BTreeMap<CavId, String>,
}

impl PeerModels {
    /// Starts with no known agents.
    pub(crate) fn new(own: &Detector) -> Self {
        Self {
            grid: own.grid(),
            channels: u32::try_from(own.sent_shape()[0]).unwrap_or(u32::MAX),
            code_of: own.code_of(),
            model_hash: own.model_hash(),
            others: BTreeMap::new(),
        }
    }

    /// Checks that a map has the grid and the channels of the ego's network.
    ///
    /// # Errors
    /// [`WireError`] names what differs.
    pub(crate) fn check(&self, map: &EncodedFeatures) -> Result<(), WireError> {
        map.check_shape(&self.grid, self.channels, self.code_of)
    }

    /// Processes an agent's descriptor; returns the difference of its network when it is new.
    pub(crate) fn update(&mut self, cav: &CavId, descriptor: &Descriptor) -> Option<String> {
        let Some(other) = self.difference(descriptor) else {
            if self.others.remove(cav).is_some() {
                tracing::info!(%cav, "its maps are of the ego's network now");
            }
            return None;
        };
        let before = self.others.insert(cav.clone(), other.clone());
        (before.as_ref() != Some(&other)).then_some(other)
    }

    /// The difference between the networks, with both values, of an agent whose descriptor names another network than the
    /// ego's; `None` for the same network.
    pub(crate) fn other(&self, cav: &CavId) -> Option<&String> {
        self.others.get(cav)
    }

    /// Removes an agent that has left.
    pub(crate) fn forget(&mut self, cav: &CavId) {
        self.others.remove(cav);
    }

    fn difference(&self, descriptor: &Descriptor) -> Option<String> {
        // Its streams and numeric type are not part of the network.
        let (found, own) = (descriptor.grid, self.grid);
        if found != own {
            return Some(format!("grid is {found}, the ego's is {own}"));
        }
        let (found, own) = (descriptor.channels, self.channels);
        if found != own {
            return Some(format!("channels are {found}, the ego's are {own}"));
        }
        let (found, own) = (descriptor.model_hash, self.model_hash);
        (found != own).then(|| format!("model_hash is {found}, the ego's is {own}"))
    }
}

#[cfg(test)]
mod tests {
    use protocol::{Dtype, Stream};

    use super::*;

    #[test]
    fn another_network_is_reported_once_until_it_is_the_egos() {
        let grid = BevGrid {
            x_min_m: -51.2,
            y_min_m: -38.4,
            cell_m: 0.8,
            width: 128,
            height: 96,
        };
        let own = ModelHash([7; 32]);
        let mut models = PeerModels {
            grid,
            channels: 64,
            code_of: None,
            model_hash: own,
            others: BTreeMap::new(),
        };
        let cav = CavId::new("20").unwrap();
        let same = Descriptor {
            model_hash: own,
            grid,
            channels: 64,
            dtype: Dtype::I8,
            streams: vec![Stream::Bev],
            sweeps: vec![],
        };
        assert_eq!(models.update(&cav, &same), None);
        assert_eq!(models.other(&cav), None);

        let hash = Descriptor {
            model_hash: ModelHash([8; 32]),
            ..same.clone()
        };
        let text = models.update(&cav, &hash).unwrap();
        assert!(
            text.contains("model_hash")
                && text.contains(&"07".repeat(32))
                && text.contains(&"08".repeat(32))
        );
        assert_eq!(models.update(&cav, &hash), None, "reported once");
        assert_eq!(models.other(&cav), Some(&text));
        let narrow = Descriptor {
            channels: 32,
            ..hash
        };
        assert_eq!(
            models.update(&cav, &narrow),
            Some("channels are 32, the ego's are 64".to_owned())
        );
        let wide = Descriptor {
            grid: BevGrid { width: 256, ..grid },
            ..narrow
        };
        assert!(models.update(&cav, &wide).unwrap().starts_with("grid is "));

        assert_eq!(models.update(&cav, &same), None);
        assert_eq!(models.other(&cav), None);
        models.update(&cav, &wide);
        models.forget(&cav);
        assert_eq!(models.other(&cav), None);
    }
}
