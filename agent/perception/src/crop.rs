//! Crop: selects the points of a sweep that enter the detector.

use protocol::PointCloud;

use crate::model_config::DetectorConfig;

/// Keeps the points inside the detector's area and outside the vehicle's own body.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Crop {
    low_m: [f32; 3],
    high_m: [f32; 3],
    /// x, y of the lower, then of the upper corner, metres.
    own_body_m: Option<[f32; 4]>,
}

impl Crop {
    /// The crop of a detector.
    pub fn for_detector(config: &DetectorConfig) -> Self {
        Self {
            low_m: std::array::from_fn(|axis| config.lidar_range_m[axis] as f32),
            high_m: std::array::from_fn(|axis| config.lidar_range_m[axis + 3] as f32),
            own_body_m: config.own_body_m.map(|edges| edges.map(|edge| edge as f32)),
        }
    }

    /// Appends the points to keep to `kept`, in their order.
    ///
    /// The area is open: a point on its edge is removed, as in the reference. Points that are not finite are removed.
    pub fn keep(&self, points: &[[f32; 4]], kept: &mut Vec<[f32; 4]>) {
        kept.extend(points.iter().filter(|point| self.is_kept(point)));
    }

    /// The sweep without the points on the vehicle's own body, at any distance: the input of early fusion at other
    /// vehicles. Points that are not finite are removed as well.
    pub fn without_own_body(&self, cloud: &PointCloud) -> PointCloud {
        let anywhere = Self {
            low_m: [f32::NEG_INFINITY; 3],
            high_m: [f32::INFINITY; 3],
            ..*self
        };
        let mut kept = PointCloud::default();
        anywhere.keep(&cloud.xyzi, &mut kept.xyzi);
        kept
    }

    /// The same area, the own body included.
    pub fn range_only(&self) -> Self {
        Self {
            own_body_m: None,
            ..*self
        }
    }

    fn is_kept(&self, &[x, y, z, intensity]: &[f32; 4]) -> bool {
        let inside =
            |axis: usize, value: f32| value > self.low_m[axis] && value < self.high_m[axis];
        // Without an own body the box begins at infinity and holds no finite point.
        let [x_low, y_low, x_high, y_high] = self.own_body_m.unwrap_or([f32::INFINITY; 4]);
        let own = x >= x_low && x <= x_high && y >= y_low && y <= y_high;
        // The comparisons exclude NaN and infinity in x, y and z, but intensity has no bounds.
        inside(0, x) && inside(1, y) && inside(2, z) && !own && intensity.is_finite()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_body_edges_and_non_finite_points_are_removed() {
        let crop = Crop::for_detector(&DetectorConfig::lean());
        let keep = [5.0, 0.0, -1.0, 0.5];
        let drop = [
            [0.0, 0.0, 0.0, 0.5],
            [51.2, 0.0, 0.0, 0.5],
            [5.0, 0.0, 1.5, 0.5],
            [f32::NAN, 0.0, 0.0, 0.5],
            [5.0, 0.0, 0.0, f32::NAN],
        ];
        let mut kept = Vec::new();
        crop.keep(
            &[drop[0], keep, drop[1], drop[2], drop[3], drop[4]],
            &mut kept,
        );
        assert_eq!(kept, [keep]);
        let whole = Crop::for_detector(&DetectorConfig {
            own_body_m: None,
            ..DetectorConfig::lean()
        });
        whole.keep(&drop, &mut kept);
        assert_eq!(kept, [keep, drop[0]]);
        assert_eq!(crop.range_only(), whole);
        let sent = crop.without_own_body(&PointCloud {
            xyzi: vec![drop[0], keep, drop[1], drop[3], drop[4]],
        });
        assert_eq!(sent.xyzi, [keep, drop[1]]);
    }
}
