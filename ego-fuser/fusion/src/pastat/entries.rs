//! What a sample shows to PASTAT: real maps, and what is told of them.

use protocol::Pose;
use tch::{Kind, TchError, Tensor};

use super::confidence::{shares, steps_back};
use crate::padding::Padding;
use crate::stage::larger_cells;
use crate::{AlignedViews, ViewFacts};

/// Maps on one lattice.
#[derive(Debug)]
pub(super) struct Maps {
    /// `[N, C, H, W]`.
    pub(super) features: Tensor,
    /// `[N, 1, H, W]`, 1 where a map shows something.
    pub(super) mask: Tensor,
}

impl Maps {
    /// Some entries, as floats.
    pub(super) fn picked(features: &Tensor, mask: &Tensor, entries: &[i64]) -> Result<Self, TchError> {
        let index = Tensor::f_from_slice(entries)?.f_to_device(features.device())?;
        let is_all = entries.len() as i64 == features.size()[0];
        let pick = |tensor: &Tensor| match is_all {
            true => tensor.f_to_kind(Kind::Float),
            false => tensor.f_index_select(0, &index)?.f_to_kind(Kind::Float),
        };
        Ok(Self { features: pick(features)?, mask: pick(mask)? })
    }

    /// How many.
    pub(super) fn count(&self) -> Result<i64, TchError> {
        Ok(self.features.size4()?.0)
    }

    /// The entries from `first` up to `end`.
    pub(super) fn only(&self, first: i64, end: i64) -> Result<Self, TchError> {
        let of = |tensor: &Tensor| tensor.f_narrow(0, first, end - first);
        Ok(Self { features: of(&self.features)?, mask: of(&self.mask)? })
    }

    /// With rows below and columns to the right that show nothing, so that both counts are multiples of `cells`.
    pub(super) fn padded(&self, cells: i64) -> Result<Self, TchError> {
        let padded = |maps: &Tensor| Padding::to_multiples_of(cells, maps);
        Ok(Self { features: padded(&self.features)?, mask: padded(&self.mask)? })
    }

    /// With cells of `cells` by `cells`.
    pub(super) fn with_cells_of(&self, cells: i64) -> Result<Self, TchError> {
        Ok(Self { features: larger_cells(&self.features, cells)?, mask: larger_cells(&self.mask, cells)?.f_ceil()? })
    }
}

/// FSA sees earlier maps with larger cells than the newest, and puts one that lies well a few tenths of a metre beside its
/// place: what it puts within this distance of its agent's newest belongs where that does.
const SAME_PLACE_M: f64 = 0.6;

/// What is told of entries, by property.
#[derive(Debug)]
pub(super) struct Told {
    pub(super) agent: Vec<usize>,
    pub(super) ego_from_cav: Vec<Pose>,
    pub(super) age_secs: Vec<f64>,
    /// Their places among those of their agents, 0 for the newest.
    pub(super) steps_back: Vec<usize>,
    /// Eq. 7.
    pub(super) shares: Vec<f32>,
    /// What FSA is told of each entry: its share, its confidence and the ego's. Shares alone do not tell whether all
    /// poses are good or all are bad.
    pub(super) trust: Vec<f32>,
}

impl Told {
    /// Along x and y, metres, and turned by, radians, what FSA says of the entries from `first` on, the earlier ones, given what it
    /// says of all but the very first, `deltas` `[N - 1, 3]`: one that lies about where its agent's newest does lies there.
    pub(super) fn settled(&self, deltas: &Tensor, first: usize) -> Result<Vec<[f64; 3]>, TchError> {
        let deltas = Vec::<f64>::try_from(deltas.f_detach()?.f_to_kind(Kind::Double)?.f_reshape(-1)?)?;
        let all: Vec<[f64; 3]> = std::iter::once([0.0; 3])
            .chain(deltas.chunks_exact(3).map(|found| [found[0], found[1], found[2]]))
            .collect();
        let settle = |entry: usize| {
            let newest = (0..first).find(|&newest| self.agent[newest] == self.agent[entry]).map(|newest| all[newest]);
            let is_same =
                |newest: &[f64; 3]| (newest[0] - all[entry][0]).hypot(newest[1] - all[entry][1]) < SAME_PLACE_M;
            newest.filter(is_same).unwrap_or(all[entry])
        };
        Ok((first..all.len()).map(settle).collect())
    }

    fn new(facts: &[ViewFacts]) -> Self {
        let agent: Vec<usize> = facts.iter().map(|facts| facts.agent).collect();
        let age_secs: Vec<f64> = facts.iter().map(|facts| facts.age_secs).collect();
        let confidence: Vec<f64> = facts.iter().map(|facts| facts.confidence).collect();
        let steps_back = steps_back(&agent, &age_secs);
        let shares = shares(&confidence, &steps_back);
        let of_entry = |(share, &own): (&f32, &f64)| [*share, own as f32, confidence[0] as f32];
        Self {
            trust: shares.iter().zip(&confidence).flat_map(of_entry).collect(),
            ego_from_cav: facts.iter().map(|facts| facts.ego_from_cav).collect(),
            shares,
            agent,
            steps_back,
            age_secs,
        }
    }
}

/// The entries of a sample that show anything: a map that nowhere reaches is no partner, it has no share of the trust
/// either.
#[derive(Debug)]
pub(super) struct Shown {
    /// The newest of each agent, the ego's first.
    pub(super) newest: Maps,
    /// The same where they were made.
    pub(super) own_frame: Maps,
    /// What is older, with larger cells.
    pub(super) earlier: Option<Maps>,
    /// Which of the views' earlier maps those are.
    pub(super) earlier_entries: Vec<usize>,
    /// What is told of both, in this order.
    pub(super) told: Told,
    /// Their places among all entries, and how many those are.
    places: Vec<i64>,
    all: i64,
}

impl Shown {
    pub(super) fn of(views: &AlignedViews<'_>) -> Result<Self, TchError> {
        let newest = reaching(views.mask, true)?;
        let earlier = views.earlier.map(|earlier| reaching(earlier.mask, false)).transpose()?.unwrap_or_default();
        let facts: Vec<ViewFacts> =
            views.facts.iter().chain(views.earlier.iter().flat_map(|earlier| earlier.facts)).copied().collect();
        let before = views.facts.len() as i64;
        let places: Vec<i64> = newest.iter().copied().chain(earlier.iter().map(|entry| entry + before)).collect();
        let told: Vec<ViewFacts> = places.iter().map(|&place| facts[place as usize]).collect();
        Ok(Self {
            earlier_entries: earlier.iter().map(|&entry| entry as usize).collect(),
            own_frame: match views.sent {
                Some(sent) => Maps::picked(views.own_frame, sent, &newest)?,
                None => Maps::picked(views.own_frame, &views.mask.f_ones_like()?, &newest)?,
            },
            newest: Maps::picked(views.features, views.mask, &newest)?,
            earlier: match views.earlier.filter(|_| !earlier.is_empty()) {
                Some(views) => Some(Maps::picked(views.features, views.mask, &earlier)?),
                None => None,
            },
            told: Told::new(&told),
            places,
            all: facts.len() as i64,
        })
    }

    /// `[N - 1, 3]` of all entries but the first, given those of the ones that show anything: the others are not moved.
    pub(super) fn among_all(&self, deltas: &Tensor) -> Result<Tensor, TchError> {
        if self.places.len() as i64 == self.all {
            return Ok(deltas.shallow_clone());
        }
        let all = Tensor::f_zeros([self.all - 1, 3], (deltas.kind(), deltas.device()))?;
        let places: Vec<i64> = self.places[1..].iter().map(|place| place - 1).collect();
        all.f_index_copy(0, &Tensor::f_from_slice(&places)?.f_to_device(deltas.device())?, deltas)
    }
}

/// The entries of `mask` `[N, 1, H, W]` that show anything; the ego's newest is always one.
fn reaching(mask: &Tensor, with_ego: bool) -> Result<Vec<i64>, TchError> {
    let reach: Vec<f32> = Vec::try_from(mask.f_amax([1_i64, 2, 3].as_slice(), false)?.f_to_kind(Kind::Float)?)?;
    let counts = |(entry, reach): &(i64, f32)| (with_ego && *entry == 0) || *reach > 0.0;
    Ok((0..).zip(reach).filter(counts).map(|(entry, _)| entry).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_about_where_its_agents_newest_does_lies_there() {
        let fact = |agent| ViewFacts::fresh(agent, Pose::IDENTITY);
        let told = Told::new(&[fact(0), fact(7), fact(0), fact(7), fact(7), fact(3)]);
        let deltas = [0.5, 0.4, 0.01, 0.3, -0.3, 0.02, 0.9, 0.1, 0.0, 1.5, 0.4, 0.03, 0.1, 0.0, 0.0];
        let deltas = Tensor::from_slice(&deltas).view([5, 3]);
        let settled = told.settled(&deltas, 2).unwrap();
        // The ego's newest is not moved; another of the same vehicle is too far off; of the last there is no newest.
        assert_eq!(settled, [[0.0; 3], [0.5, 0.4, 0.01], [1.5, 0.4, 0.03], [0.1, 0.0, 0.0]]);
    }
}
