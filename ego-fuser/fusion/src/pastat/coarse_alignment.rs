//! Coarse alignment (the A of Eq. 2): maps warped onto the ego's grid by the poses of their senders.
//!
//! The warp itself is that of all methods ([`crate::warp`]). Here the entries that reach any cell are selected, so
//! nothing is padded over agents or time, and their grids are padded to multiples of the attention windows and of the
//! parts of FSA.

use perception::tensor_values::tensor;
use protocol::Pose;
use tch::{Kind, TchError, Tensor};

use super::config::PastatConfig;
use crate::f64_tensor::picked;
use crate::full_resolution::FullResolutionMap;
use crate::maps::{AlignedMaps, MapMetadata, reaching};
use crate::padding::Padding;
use crate::warp::WarpedMaps;

/// Coarsely aligned maps: the entries of a sample that reach any cell. A map that reaches none is left out and has no
/// share of the confidence either.
#[derive(Debug)]
pub(super) struct CoarseMaps {
    /// The newest map of each agent, the ego's first, on the padded grid of the ego.
    pub(super) newest: WarpedMaps,
    /// The same in the frames of their senders, not padded; the mask marks the cells that were sent.
    pub(super) received: WarpedMaps,
    /// The same in plain floats; none where a gradient flows.
    pub(super) received_cells: Vec<FullResolutionMap>,
    /// Earlier maps, pooled, on a padded grid of the ego.
    pub(super) earlier: Option<WarpedMaps>,
    /// Indices of these among [`AlignedMaps::earlier`].
    pub(super) earlier_entries: Vec<i64>,
    /// Origins of the newest and of the earlier maps, in this order.
    pub(super) origins: Origins,
    /// Indices of all entries in the input, and the number of entries there.
    places: Vec<i64>,
    all: i64,
}

/// Origins of the entries, by property.
#[derive(Debug)]
pub(super) struct Origins {
    pub(super) agent: Vec<usize>,
    pub(super) ego_from_cav: Vec<Pose>,
    /// Confidence of the sender's pose, 0..1.
    pub(super) confidence: Vec<f64>,
    pub(super) age_secs: Vec<f64>,
    /// Index among the maps of the same agent, 0 for the newest.
    pub(super) steps_back: Vec<usize>,
}

impl CoarseMaps {
    /// The entries of `maps` that reach any cell; the ego's newest is always one.
    pub(super) fn pick(maps: &AlignedMaps, config: &PastatConfig) -> Result<Self, TchError> {
        // Rows and columns are padded to multiples of so many cells.
        let padding_cells = config.padding_cells();
        let (warped, received, earlier) = (&maps.warped, &maps.received, &maps.earlier);
        let newest = reaching(&warped.mask, true)?;
        let sent = match &received.sent {
            Some(sent) => sent.shallow_clone(),
            None => warped.mask.f_ones_like()?,
        };
        let received_maps = WarpedMaps::new(received.maps.shallow_clone(), sent);
        let earlier_entries = match earlier {
            Some(earlier) => reaching(&earlier.warped.mask, false)?,
            None => Vec::new(),
        };
        let first = maps.metadata.len() as i64;
        let mut metadata = maps.metadata.clone();
        metadata.extend(earlier.iter().flat_map(|earlier| &earlier.metadata));
        let of_earlier = earlier_entries.iter().map(|entry| entry + first);
        let places: Vec<i64> = newest.iter().copied().chain(of_earlier).collect();
        let chosen = places.iter().map(|&place| metadata[place as usize]);
        let cells = newest
            .iter()
            .filter_map(|&entry| received.full_resolution.get(entry as usize));
        let earlier = earlier.as_ref().filter(|_| !earlier_entries.is_empty());
        let earlier = earlier.map(|earlier| {
            let entries = rows_of(&earlier.warped, &earlier_entries)?;
            // Both grids cover the same area after padding: tokens of all ages lie in the same places.
            Padding::to_multiples_of(padding_cells / config.earlier_cells, &entries)
        });
        Ok(Self {
            newest: Padding::to_multiples_of(padding_cells, &rows_of(warped, &newest)?)?,
            received: rows_of(&received_maps, &newest)?,
            received_cells: FullResolutionMap::shallow_clones(cells),
            earlier: earlier.transpose()?,
            origins: Origins::of(&chosen.collect::<Vec<_>>()),
            earlier_entries,
            places,
            all: metadata.len() as i64,
        })
    }

    /// `[N - 1, 3]` of all entries of the input but the first, given `corrections` of the selected ones: others have
    /// none.
    pub(super) fn among_all(&self, corrections: &Tensor) -> Result<Tensor, TchError> {
        if self.places.len() as i64 == self.all {
            return Ok(corrections.shallow_clone());
        }
        let options = (corrections.kind(), corrections.device());
        let places: Vec<i64> = self.places[1..].iter().map(|place| place - 1).collect();
        let places = tensor(&places, &[-1], corrections.device())?;
        Tensor::f_zeros([self.all - 1, 3], options)?.f_index_copy(0, &places, corrections)
    }
}

impl Origins {
    pub(super) fn of(metadata: &[MapMetadata]) -> Self {
        let agent: Vec<usize> = metadata.iter().map(|map| map.agent).collect();
        let age_secs: Vec<f64> = metadata.iter().map(|map| map.age_secs).collect();
        Self {
            steps_back: steps_back(&agent, &age_secs),
            ego_from_cav: metadata.iter().map(|map| map.ego_from_cav).collect(),
            confidence: metadata.iter().map(|map| map.confidence).collect(),
            agent,
            age_secs,
        }
    }

    /// Number of entries.
    pub(super) fn count(&self) -> usize {
        self.agent.len()
    }
}

/// Index of every entry among those of its agent, 0 for the newest; of two of one age the first is the newer.
pub(super) fn steps_back(agent: &[usize], age_secs: &[f64]) -> Vec<usize> {
    let steps = (0..agent.len()).map(|entry| {
        (0..agent.len())
            .filter(|&other| agent[other] == agent[entry])
            .filter(|&other| (age_secs[other], other) < (age_secs[entry], entry))
            .count()
    });
    steps.collect()
}

/// Some entries, as floats.
fn rows_of(maps: &WarpedMaps, entries: &[i64]) -> Result<WarpedMaps, TchError> {
    // Selection copies. Entries are distinct, so as many as there are rows are all, in order.
    let is_all = entries.len() as i64 == maps.features.size()[0];
    maps.each(|tensor| match is_all {
        true => tensor.f_to_kind(Kind::Float),
        false => picked(tensor, entries)?.f_to_kind(Kind::Float),
    })
}
