//! FSA, Feature Spatial Alignment: corrects the pose-based alignment of maps by their content.
//!
//! Every map is compared with the ego's newest. The network predicts `(dx, dy, theta)` per map; the map and its tokens
//! are moved by it, and the tokens get the quality of the match. Identity before training.

pub(super) mod area;
pub(super) mod correlation;
pub(super) mod neighbour_maps;
pub(super) mod network;
pub(super) mod pairs;

use protocol::BevGrid;
use tch::{TchError, Tensor, nn};

use self::area::{Area, own_sampling_grid, resample, sampling_grid};
use self::neighbour_maps::NeighbourMaps;
use self::network::AlignmentNetwork;
use self::pairs::Displacements;
use super::coarse_alignment::{CoarseMaps, Origins};
use super::confidence_embedding::Confidences;
use super::config::PastatConfig;
use super::extensions::alignment_search::displacements;
use super::extensions::pooled_history::pooled;
use super::patches::Tokens;
use crate::f64_tensor::picked;
use crate::full_resolution::FullResolutionMap;

/// Feature Spatial Alignment.
#[derive(Debug)]
pub(super) struct SpatialAlignment {
    /// Absent: maps are aligned by their poses only, for the ablation.
    network: Option<AlignmentNetwork>,
    /// Cells along each edge of a cell of earlier maps.
    earlier_cells: i64,
}

/// Finely aligned maps.
pub(super) struct FineMaps {
    /// `[C, H, W]`: the ego's newest map.
    pub(super) own: Tensor,
    /// The newest maps of all others.
    pub(super) neighbours: NeighbourMaps,
    /// `[N - 1, 3]`: corrections of all entries but the ego's newest, metres and radians; absent: none were estimated.
    pub(super) corrections: Option<Tensor>,
}

impl SpatialAlignment {
    /// Its variables are `fsa.*` below `path`.
    pub(super) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Self {
        let (path, size) = (path / "fsa", [config.channels, config.dim]);
        let fsa = config.fsa.as_ref();
        Self {
            network: fsa.map(|fsa| AlignmentNetwork::new(&path, size, fsa)),
            earlier_cells: config.earlier_cells,
        }
    }

    /// Moves all entries but the ego's newest to their best match with that; `is_training`: by the network only. Also
    /// the quality of each map's match, `[N, D]`; absent: not known.
    pub(super) fn align(
        &self,
        coarse: &CoarseMaps,
        tokens: Tokens,
        confidences: &Confidences,
        grid: &BevGrid,
        is_training: bool,
    ) -> Result<(FineMaps, Tokens, Option<Tensor>), TchError> {
        let (own, count) = (coarse.newest.features.f_get(0)?, coarse.newest.count()?);
        let Some(network) = self.network.as_ref().filter(|_| coarse.origins.count() > 1) else {
            let fine = FineMaps {
                own,
                neighbours: NeighbourMaps::still(coarse.newest.only(1, count)?),
                corrections: None,
            };
            return Ok((fine, tokens, None));
        };
        let (_, height, width) = own.size3()?;
        let area = Area::new(grid, [height, width], network.config.radius);
        let Displacements { deltas, fit, .. } =
            self.compare(network, coarse, &confidences.of_maps, &area, is_training)?;
        let tokens = moved_tokens(&tokens, &deltas, &coarse.origins, &area)?;
        let fine = FineMaps {
            own,
            neighbours: moved_maps(coarse, &deltas, &area, grid)?,
            corrections: Some(deltas),
        };
        // The ego's newest, which matches itself, gets nothing.
        Ok((fine, tokens, Some(fit.f_constant_pad_nd([0, 0, 1, 0])?)))
    }

    /// Displacements of all entries from the ego's newest.
    fn compare(
        &self,
        network: &AlignmentNetwork,
        coarse: &CoarseMaps,
        confidences: &Tensor,
        area: &Area,
        is_training: bool,
    ) -> Result<Displacements, TchError> {
        let (newest, agents) = (network.reduced(&coarse.newest)?, coarse.newest.count()?);
        let (origins, poses) = (&coarse.origins, &coarse.origins.ego_from_cav);
        let ego = newest.only(0, 1)?;
        let mut found = Vec::with_capacity(2);
        if agents > 1 {
            let pairs = network.pairs(
                [&ego, &newest.only(1, agents)?],
                &confidences.f_narrow(0, 1, agents - 1)?,
                &poses[1..agents as usize],
                area,
            )?;
            found.push(displacements(network, &pairs, area, None, is_training)?);
        }
        if let Some(earlier) = &coarse.earlier {
            // Means of reduced maps are reduced means of maps.
            let ego = pooled(&ego, self.earlier_cells)?;
            let area = area.with_cells_of(self.earlier_cells);
            let pairs = network.pairs(
                [&ego, &network.reduced(earlier)?],
                &confidences.f_narrow(0, agents, poses.len() as i64 - agents)?,
                &poses[agents as usize..],
                &area,
            )?;
            let known = found
                .first()
                .map(|newest| of_newest(&newest.deltas, &origins.agent, agents as usize))
                .transpose()?;
            let known = known.as_ref();
            found.push(displacements(network, &pairs, &area, known, is_training)?);
        }
        Displacements::all(&found)
    }
}

/// For each entry of `agent` from `newest` on the displacement of the newest map of its agent, given those of all
/// newest maps but the ego's, `deltas` `[newest - 1, 3]`; zeros for the ego's and for an agent without a newest map.
fn of_newest(deltas: &Tensor, agent: &[usize], newest: usize) -> Result<Tensor, TchError> {
    let with_ego = deltas.f_constant_pad_nd([0, 0, 1, 0])?;
    let (newest, earlier) = agent.split_at(newest);
    let entries = earlier
        .iter()
        .map(|agent| newest.iter().position(|of| of == agent).unwrap_or(0) as i64);
    picked(&with_ego, &entries.collect::<Vec<_>>())
}

/// Tokens, all but the first entry's moved by `deltas` `[N - 1, 3]`.
fn moved_tokens(
    Tokens { values, valid }: &Tokens,
    deltas: &Tensor,
    origins: &Origins,
    area: &Area,
) -> Result<Tokens, TchError> {
    let (entries, _, rows, columns) = values.size4()?;
    let places = sampling_grid(deltas, &origins.ego_from_cav[1..], area, [rows, columns])?;
    let (after, after_valid) = resample(
        &values.f_narrow(0, 1, entries - 1)?,
        &valid.f_narrow(0, 1, entries - 1)?.f_unsqueeze(1)?,
        &places,
    )?;
    let after_valid = after_valid.f_squeeze_dim(1)?;
    Ok(Tokens {
        values: Tensor::f_cat(&[values.f_narrow(0, 0, 1)?, after], 0)?,
        valid: Tensor::f_cat(&[valid.f_narrow(0, 0, 1)?, after_valid], 0)?,
    })
}

/// The newest maps of neighbours, resampled from the maps as received by the poses that `deltas` correct.
fn moved_maps(
    coarse: &CoarseMaps,
    deltas: &Tensor,
    area: &Area,
    grid: &BevGrid,
) -> Result<NeighbourMaps, TchError> {
    let count = coarse.newest.count()? - 1;
    if count == 0 {
        return Ok(NeighbourMaps::still(coarse.newest.only(1, 1)?));
    }
    // Maps as received are not padded, unlike the grid onto which they are sampled.
    let own = Area::new(grid, [grid.height, grid.width].map(i64::from), area.radius);
    let poses = &coarse.origins.ego_from_cav[1..=count as usize];
    let places = own_sampling_grid(&deltas.f_narrow(0, 0, count)?, poses, [area, &own])?;
    let cells = FullResolutionMap::shallow_clones(coarse.received_cells.iter().skip(1));
    NeighbourMaps::at(coarse.received.only(1, count + 1)?, cells, places)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn earlier_maps_have_the_displacement_of_their_agents_newest() {
        // Newest maps of the ego, 7 and 4; earlier ones of 4, the ego, 7 and of 9, which has no newest map.
        let deltas = Tensor::from_slice(&[1.0_f32, 2.0, 0.1, 3.0, 4.0, 0.2]).view([2, 3]);
        let found = of_newest(&deltas, &[0, 7, 4, 4, 0, 7, 9], 3).unwrap();
        let expected = [
            3.0_f32, 4.0, 0.2, 0.0, 0.0, 0.0, 1.0, 2.0, 0.1, 0.0, 0.0, 0.0,
        ];
        assert_eq!(found, Tensor::from_slice(&expected).view([4, 3]));
    }
}
