//! Range image: a sweep as rows of equal elevation and columns of equal azimuth.

use std::f32::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

/// Channels of an image: range, x, y, z, intensity.
pub const CHANNELS: usize = 5;
/// Unit of each channel: metres, and 1 for intensity. Empty pixels are 0 in all channels.
pub const UNITS: [f32; CHANNELS] = [20.0, 20.0, 20.0, 2.0, 1.0];

/// Shortest range, metres: closer returns are of the vehicle itself.
const LEAST_RANGE_M: f32 = 0.5;

/// Size and field of view of a range image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RangeImageConfig {
    /// Rows, from the highest elevation down.
    pub rows: usize,
    /// Columns, from the rear counter-clockwise.
    pub columns: usize,
    /// Elevations of the lower edge of the last row and the upper edge of the first one, degrees.
    pub elevations_deg: [f32; 2],
}

impl Default for RangeImageConfig {
    /// 16 x 256; each row holds four of 64 channels from -25 to 2 degrees, the LiDAR of the generated scenes and of
    /// OPV2V.
    fn default() -> Self {
        Self {
            rows: 16,
            columns: 256,
            elevations_deg: [-25.214, 2.214],
        }
    }
}

impl RangeImageConfig {
    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.rows * self.columns
    }

    /// Index of the pixel of a point in metres in the sensor frame, and its range; `None` outside of the image.
    pub fn pixel(&self, [x, y, z]: [f32; 3]) -> Option<(usize, f32)> {
        let range_m = (x * x + y * y + z * z).sqrt();
        if !range_m.is_finite() || range_m < LEAST_RANGE_M {
            return None;
        }
        let [low, high] = self.elevations_deg.map(f32::to_radians);
        let elevation = z.atan2(x.hypot(y));
        let row = ((high - elevation) / (high - low) * self.rows as f32).floor();
        if !(0.0..self.rows as f32).contains(&row) {
            return None;
        }
        let turn = (y.atan2(x) + PI) / TAU;
        let column = ((turn * self.columns as f32) as usize) % self.columns;
        Some((row as usize * self.columns + column, range_m))
    }

    /// The image `[CHANNELS, rows, columns]` of points x, y, z in metres in the sensor frame and intensity, in
    /// [`UNITS`]. The closest point of a pixel counts; points outside of the field of view are left out.
    pub fn image(&self, xyzi: &[[f32; 4]]) -> Vec<f32> {
        let pixels = self.pixels();
        let mut closest = vec![(f32::INFINITY, 0); pixels];
        for (index, &[x, y, z, _]) in xyzi.iter().enumerate() {
            if let Some((pixel, range_m)) = self.pixel([x, y, z])
                && range_m < closest[pixel].0
            {
                closest[pixel] = (range_m, index);
            }
        }
        let mut image = vec![0.0; CHANNELS * pixels];
        for (pixel, &(range_m, index)) in closest
            .iter()
            .enumerate()
            .filter(|(_, (range_m, _))| range_m.is_finite())
        {
            let [x, y, z, intensity] = xyzi[index];
            let intensity = if intensity.is_finite() {
                intensity.clamp(0.0, 1.0)
            } else {
                0.0
            };
            for (channel, value) in [range_m, x, y, z, intensity].into_iter().enumerate() {
                image[channel * pixels + pixel] = value / UNITS[channel];
            }
        }
        image
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: RangeImageConfig = RangeImageConfig {
        rows: 4,
        columns: 8,
        elevations_deg: [-40.0, 40.0],
    };

    fn occupied(image: &[f32]) -> Vec<(usize, f32)> {
        let ranges = image[..SMALL.pixels()].iter().copied().enumerate();
        ranges
            .filter(|(_, range)| *range > 0.0)
            .map(|(pixel, range)| (pixel, range * UNITS[0]))
            .collect()
    }

    #[test]
    fn the_closest_point_of_a_pixel_counts_and_others_are_left_out() {
        // Ahead is the middle column; 10 degrees down is the third row of four.
        let ahead = [10.0, 0.1, -2.0, 0.5];
        let cloud = [
            [20.0, 0.2, -4.0, 0.9],
            ahead,
            [0.0, 0.0, 9.0, 0.5],      // above
            [0.1, 0.0, 0.0, 0.5],      // of the vehicle
            [f32::NAN, 0.0, 0.0, 0.5], // no point
            [-5.0, 0.01, 1.0, 0.3],    // behind, where counter-clockwise ends
        ];
        let image = SMALL.image(&cloud);
        let found = occupied(&image);
        assert_eq!(
            found.iter().map(|(pixel, _)| *pixel).collect::<Vec<_>>(),
            [8 + 7, 2 * 8 + 4]
        );
        let (pixel, range_m) = found[1];
        assert!((range_m - (100.0f32 + 0.01 + 4.0).sqrt()).abs() < 1e-4);
        let values: Vec<f32> = (1..CHANNELS)
            .map(|channel| image[channel * SMALL.pixels() + pixel] * UNITS[channel])
            .collect();
        assert!(
            values
                .iter()
                .zip(ahead)
                .all(|(value, wanted)| (value - wanted).abs() < 1e-5),
            "{values:?}"
        );
    }

    #[test]
    fn four_channels_of_the_generated_lidar_share_a_row() {
        let config = RangeImageConfig::default();
        let row = |channel: usize| {
            let elevation = (-25.0 + 27.0 / 63.0 * channel as f32).to_radians();
            config
                .pixel([10.0 * elevation.cos(), 0.0, 10.0 * elevation.sin()])
                .map(|(pixel, _)| pixel / config.columns)
        };
        assert!(
            (0..64).all(|channel| row(channel) == Some(15 - channel / 4)),
            "{:?}",
            (0..64).map(row).collect::<Vec<_>>()
        );
    }
}
