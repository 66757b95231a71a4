//! Heat map of a feature map: one level per BEV cell, as drawn on the page.

use protocol::{Bev, BevFeatures, BevGrid, Limits, wire};
use serde_json::json;

/// Quantile of the activations up to which the level is 0: most of a map is empty ground, whose activations are not 0.
const EMPTY: f64 = 0.5;
/// Quantile of the activations that gets the highest level: few cells are far above all others.
const BRIGHTEST: f64 = 0.99;

/// Level of each BEV cell: the mean of the absolute values of its channels.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct HeatMap {
    /// Capture time on the scene's clock, seconds.
    capture_s: f64,
    grid: BevGrid,
    channels: u32,
    /// `[H, W]`, 0..=255; 0: no activation.
    levels: Vec<u8>,
}

impl HeatMap {
    /// The heat map of an encoded message; `None` if it is no valid feature map.
    pub(super) fn of(message: &[u8]) -> Option<Self> {
        let (header, Bev { features, .. }) =
            wire::decode::<Bev>([message], &Limits::DEFAULT).ok()?;
        let features = features.decode(&Limits::DEFAULT).ok()?.features;
        Some(Self {
            capture_s: header.stamp.capture_nanos as f64 / 1e9,
            grid: features.grid,
            channels: features.channels,
            levels: levels(&activations(&features)),
        })
    }

    /// The map as sent to the page: a JSON document after its length (32 bits, little-endian), then one byte per cell,
    /// row by row.
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        let head =
            json!({"capture_s": self.capture_s, "channels": self.channels, "grid": self.grid});
        let head = head.to_string();
        let length = (head.len() as u32).to_le_bytes();
        [&length, head.as_bytes(), &self.levels].concat()
    }
}

/// `[H, W]`: mean of the absolute values over the channels.
fn activations(features: &BevFeatures) -> Vec<f32> {
    let cells = features.grid.cells().max(1);
    let mut sums = vec![0.0_f32; cells];
    // Values are in the order `[C, H, W]`: one plane per channel.
    for plane in features.values.chunks_exact(cells) {
        for (sum, value) in sums.iter_mut().zip(plane) {
            *sum += value.abs();
        }
    }
    let channels = features.channels.max(1) as f32;
    sums.iter_mut().for_each(|sum| *sum /= channels);
    sums
}

/// Activations between those of empty ground and the brightest as 0..=255.
fn levels(activations: &[f32]) -> Vec<u8> {
    let mut sorted = activations.to_vec();
    // Infinite and undefined values would spoil the quantiles.
    sorted.retain(|value| value.is_finite());
    sorted.sort_by(f32::total_cmp);
    let [empty, brightest] = [EMPTY, BRIGHTEST].map(|share| {
        let rank = (share * sorted.len().saturating_sub(1) as f64).round();
        sorted.get(rank as usize).copied().unwrap_or(0.0)
    });
    // Equal quantiles must not lead to a division by 0.
    let range = (brightest - empty).max(f32::MIN_POSITIVE);
    activations
        .iter()
        .map(|value| (255.0 * ((value - empty) / range).clamp(0.0, 1.0)) as u8)
        .collect()
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, CodecConfig, Pose, PoseEstimate, Stamp, encode_features};

    use super::*;

    #[test]
    fn the_strongest_cell_is_the_brightest_and_empty_ground_is_dark() {
        let grid = BevGrid {
            x_min_m: -2.0,
            y_min_m: -1.0,
            cell_m: 1.0,
            width: 4,
            height: 2,
        };
        let mut values = vec![0.5; 16];
        (values[3], values[8 + 3], values[5]) = (4.0, -4.0, 1.5);
        let features = BevFeatures {
            grid,
            channels: 2,
            code_of: None,
            values,
        };
        let features = encode_features(features, &CodecConfig::default(), None).unwrap();
        let stamp = Stamp {
            cav: CavId::new("7").unwrap(),
            epoch: 1,
            sequence: 1,
            capture_nanos: 1_500_000_000,
            publish_nanos: 1,
        };
        let message = Bev {
            pose: PoseEstimate::new(Pose::IDENTITY, 1.0),
            features,
        };
        let message = wire::encode(&stamp, message).unwrap().to_vec();
        let map = HeatMap::of(&message).unwrap();
        assert_eq!((map.capture_s, map.channels, map.grid), (1.5, 2, grid));
        assert_eq!((map.levels[3], map.levels[0]), (255, 0));
        assert!((20..60).contains(&map.levels[5]), "{:?}", map.levels);
        let bytes = map.to_bytes();
        let (length, rest) = bytes.split_at(4);
        let (json, levels) = rest.split_at(u32::from_le_bytes(length.try_into().unwrap()) as usize);
        let json: serde_json::Value = serde_json::from_slice(json).unwrap();
        assert_eq!(
            (&json["grid"]["width"], levels),
            (&4.into(), map.levels.as_slice())
        );
        assert_eq!(HeatMap::of(&message[..message.len() - 1]), None);
    }

    #[test]
    fn values_that_are_not_finite_are_dark_or_bright_and_nothing_fails() {
        assert_eq!(
            levels(&[f32::NAN, f32::INFINITY, 0.0, 0.0, 1.0]),
            [0, 255, 0, 0, 255]
        );
        assert_eq!(levels(&[]), [0_u8; 0]);
        assert_eq!(levels(&[2.0, 2.0]), [0, 0]);
    }
}
