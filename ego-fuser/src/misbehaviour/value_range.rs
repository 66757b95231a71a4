//! Value range of feature maps: what the network's own maps have had so far, by channel.

/// Values above this multiple of the largest that the own maps have had are none of the network.
const ANY: f32 = 4.0;
/// Values above this multiple of the largest of their channel are counted; a neighbour that is not attacked has few of
/// them even while the range is that of a single map.
const CHANNEL: f32 = 1.5;
/// Share of such values that no honest map has: what only one of the two vehicles has around it fills few cells.
const SHARE: f64 = 0.05;

/// Largest absolute value of each channel.
#[derive(Debug, Default)]
pub(super) struct ValueRange(Vec<f32>);

impl ValueRange {
    /// Of the `channels` of a map `[C, H, W]`.
    pub(super) fn of(map: &[f32], channels: usize) -> Self {
        let mut range = Self(vec![0.0; channels]);
        range.widen(map);
        range
    }

    /// Adds a map.
    pub(super) fn widen(&mut self, map: &[f32]) {
        let cells = self.cells(map);
        for (largest, channel) in self.0.iter_mut().zip(map.chunks(cells)) {
            let sizes = channel.iter().map(|value| value.abs());
            *largest = sizes.fold(*largest, f32::max);
        }
    }

    /// True if the map has values that the network does not give.
    pub(super) fn is_left_by(&self, map: &[f32]) -> bool {
        let cells = self.cells(map);
        let limit = ANY * self.0.iter().copied().fold(0.0, f32::max);
        let mut above = 0;
        for (largest, channel) in self.0.iter().zip(map.chunks(cells)) {
            if channel.iter().any(|value| value.abs() > limit) {
                return true;
            }
            let most = CHANNEL * largest;
            above += channel.iter().filter(|value| value.abs() > most).count();
        }
        above as f64 > SHARE * map.len() as f64
    }

    /// Cells of a channel; 1 for maps of no channel.
    fn cells(&self, map: &[f32]) -> usize {
        (map.len() / self.0.len().max(1)).max(1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two channels of 100 cells, with values up to these.
    fn map(largest: [f32; 2]) -> Vec<f32> {
        largest
            .into_iter()
            .flat_map(|largest| (0..100).map(move |cell| largest * cell as f32 / 99.0))
            .collect()
    }

    #[test]
    fn maps_of_the_network_stay_within_and_constant_ones_do_not() {
        let mut range = ValueRange::of(&map([0.5, 2.0]), 2);
        range.widen(&map([1.0, 10.0]));
        range.widen(&map([0.1, 0.1]));
        assert!(!range.is_left_by(&map([1.4, 14.0])), "an honest neighbour");
        let mut objects = map([1.0, 10.0]);
        objects[..5].fill(8.0);
        assert!(
            !range.is_left_by(&objects),
            "what the ego has not had around it"
        );
        objects[..20].fill(8.0);
        assert!(range.is_left_by(&objects), "a tenth of the map");
        for constant in [50.0, 9.0, 2.0, -50.0] {
            assert!(range.is_left_by(&[constant; 200]), "{constant}");
        }
        objects = map([1.0, 10.0]);
        objects[150] = 41.0;
        assert!(range.is_left_by(&objects), "a single value of no map");
        assert!(
            range.is_left_by(&[f32::INFINITY]),
            "what no head can interpret"
        );
        assert!(!ValueRange::default().is_left_by(&[]));
    }
}
