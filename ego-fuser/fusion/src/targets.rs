//! Training targets: assigns anchors to objects and encodes the regression of each.
//!
//! The rule of OpenCOOD's label generator: overlap of axis-aligned boxes with one metre added to every side, positive
//! above 0.6 or where an anchor is some object's best, negative below 0.45, the band between unassigned. Overlaps are
//! computed in `f32` in the reference's order of operations, because anchors that lie completely inside an object tie,
//! and rounding decides which of them is its best.

use perception::boxes::anchors::Anchors;
use protocol::Box3d;

/// Numbers of one box that the head predicts: x, y, z, h, w, l, yaw.
pub const BOX_CODE: usize = 7;

/// Overlap above which an anchor is an object.
pub const POSITIVE_IOU: f32 = 0.6;
/// Overlap below which, for every object, an anchor is background.
pub const NEGATIVE_IOU: f32 = 0.45;

/// A positive anchor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Positive {
    /// Flat index of the anchor, in the order row, column, anchor of the cell.
    pub anchor: usize,
    /// Regression target: x, y, z, h, w, l, yaw, encoded relative to the anchor.
    pub code: [f64; BOX_CODE],
}

/// Targets of one sample. Every anchor that is neither positive nor unassigned is background.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Labels {
    /// Number of anchors, `H * W * A`.
    pub anchors: usize,
    /// Objects, by rising anchor index.
    pub positives: Vec<Positive>,
    /// Anchors in the band between the two overlaps, by rising index.
    pub unassigned: Vec<usize>,
}

/// Assigns the objects of a frame to the anchors of a head.
#[derive(Debug, Clone)]
pub struct TargetAssigner {
    anchors: Anchors,
    /// The box around each anchor, in the order of their indices.
    standing: Vec<Standing>,
}

impl TargetAssigner {
    /// Prepares the anchors, whose columns and rows increase.
    pub fn new(anchors: Anchors) -> Self {
        let boxes = (0..anchors.len()).map(|index| anchors.box_at(index));
        Self {
            standing: boxes.map(|anchor| Standing::of(&anchor)).collect(),
            anchors,
        }
    }

    /// Targets of the objects of one frame, boxes in the frame of the anchors.
    pub fn assign(&self, objects: &[Box3d]) -> Labels {
        const FREE: u32 = u32::MAX;
        // Per anchor: the first object it overlaps enough, and whether it may be background.
        let mut owner = vec![FREE; self.anchors.len()];
        let mut near = vec![false; self.anchors.len()];
        let mut best = Vec::with_capacity(objects.len());
        for (object, owner_id) in objects.iter().zip(0u32..) {
            let target = Standing::of(object);
            let mut highest = (0.0f32, None);
            self.for_each_near(object, |index| {
                let iou = self.standing[index].overlap(&target);
                // Strictly larger: of equal overlaps the anchor with the lowest index is the best.
                if iou > highest.0 {
                    highest = (iou, Some(index));
                }
                if iou > POSITIVE_IOU && owner[index] == FREE {
                    owner[index] = owner_id;
                }
                near[index] |= iou >= NEGATIVE_IOU;
            });
            best.push(highest.1);
        }
        // An object's best anchor is positive however small the overlap, unless the anchor is already taken.
        for (best, owner_id) in best.into_iter().zip(0u32..) {
            if let Some(index) = best
                && owner[index] == FREE
            {
                owner[index] = owner_id;
            }
        }
        let mut labels = Labels {
            anchors: self.anchors.len(),
            ..Labels::default()
        };
        for (anchor, (&owner, &near)) in owner.iter().zip(&near).enumerate() {
            if owner != FREE {
                let code = encode(&objects[owner as usize], &self.anchors.box_at(anchor));
                labels.positives.push(Positive { anchor, code });
            } else if near {
                labels.unassigned.push(anchor);
            }
        }
        labels
    }

    /// Visits the anchors that can overlap `object`, by rising index.
    fn for_each_near(&self, object: &Box3d, mut visit: impl FnMut(usize)) {
        let Anchors { x_m, y_m, .. } = &self.anchors;
        let [length_m, width_m, _] = self.anchors.size_lwh_m;
        // The added metre, and a margin for the rounding to f32.
        let reach =
            length_m.hypot(width_m) / 2.0 + object.size_m[0].hypot(object.size_m[1]) / 2.0 + 1.01;
        let [columns, rows] = [(x_m, 0), (y_m, 1)].map(|(centers, axis)| {
            let middle = object.center_m[axis];
            centers.partition_point(|&at| at < middle - reach)
                ..centers.partition_point(|&at| at <= middle + reach)
        });
        let per_cell = self.anchors.yaws_rad.len();
        for row in rows {
            let first = (row * x_m.len() + columns.start) * per_cell;
            (first..first + columns.len() * per_cell).for_each(&mut visit);
        }
    }
}

/// Encoding of `object` at `anchor`: offsets by the anchor's diagonal and height, logarithms of size ratios, plain
/// difference of yaw.
pub fn encode(object: &Box3d, anchor: &Box3d) -> [f64; BOX_CODE] {
    let [l, w, h] = object.size_m;
    let [anchor_l, anchor_w, anchor_h] = anchor.size_m;
    let diagonal = (anchor_w.powi(2) + anchor_l.powi(2)).sqrt();
    [
        (object.center_m[0] - anchor.center_m[0]) / diagonal,
        (object.center_m[1] - anchor.center_m[1]) / diagonal,
        (object.center_m[2] - anchor.center_m[2]) / anchor_h,
        (h / anchor_h).ln(),
        (w / anchor_w).ln(),
        (l / anchor_l).ln(),
        object.heading_rad - anchor.heading_rad,
    ]
}

/// The axis-aligned box around a footprint, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Standing {
    low: [f32; 2],
    high: [f32; 2],
    area: f32,
}

impl Standing {
    fn of(box3d: &Box3d) -> Self {
        // Single precision as the reference: sizes, angle and centre are rounded before they are combined.
        let heading = f64::from(box3d.heading_rad as f32);
        let (sin, cos) = (heading.sin() as f32, heading.cos() as f32);
        let [half_l, half_w] = [box3d.size_m[0] as f32 * 0.5, box3d.size_m[1] as f32 * 0.5];
        let [x, y] = [box3d.center_m[0] as f32, box3d.center_m[1] as f32];
        let mut standing = Self {
            low: [f32::INFINITY; 2],
            high: [f32::NEG_INFINITY; 2],
            area: 0.0,
        };
        for (l, w) in [
            (half_l, -half_w),
            (half_l, half_w),
            (-half_l, half_w),
            (-half_l, -half_w),
        ] {
            let corner = [(l * cos + w * -sin) + x, (l * sin + w * cos) + y];
            for ((low, high), at) in standing.low.iter_mut().zip(&mut standing.high).zip(corner) {
                *low = low.min(at);
                *high = high.max(at);
            }
        }
        standing.area =
            (standing.high[0] - standing.low[0] + 1.0) * (standing.high[1] - standing.low[1] + 1.0);
        standing
    }

    /// Intersection over union with one metre added to every side, as if metres were pixels.
    fn overlap(&self, other: &Self) -> f32 {
        let [x, y] = [0, 1].map(|axis: usize| {
            self.high[axis].min(other.high[axis]) - self.low[axis].max(other.low[axis]) + 1.0
        });
        // The added metre lets boxes overlap that are less than a metre apart.
        if x <= 0.0 || y <= 0.0 {
            return 0.0;
        }
        x * y / (self.area + other.area - x * y)
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use super::*;

    const CAR: [f64; 3] = [3.9, 1.6, 1.56];

    fn assigner() -> TargetAssigner {
        let [x_m, y_m] =
            [30_u32, 20].map(|count| (0..count).map(|place| f64::from(place) * 0.8).collect());
        TargetAssigner::new(Anchors {
            x_m,
            y_m,
            z_m: -1.0,
            size_lwh_m: CAR,
            yaws_rad: vec![0.0, FRAC_PI_2],
        })
    }

    #[test]
    fn an_object_on_an_anchor_has_nothing_to_regress_there() {
        let assigner = assigner();
        let labels = assigner.assign(&[assigner.anchors.box_at(777)]);
        let at = labels
            .positives
            .iter()
            .find(|positive| positive.anchor == 777)
            .unwrap();
        assert!(at.code.iter().all(|value| value.abs() < 1e-12));
        assert!(
            labels
                .positives
                .iter()
                .all(|positive| positive.anchor % 2 == 777 % 2),
            "the other heading overlaps less"
        );
    }

    #[test]
    fn a_truck_that_overlaps_little_still_has_its_best_anchor() {
        let truck = Box3d {
            center_m: [12.0, 8.0, 0.0],
            size_m: [14.0, 3.0, 3.5],
            heading_rad: 0.4,
        };
        let labels = assigner().assign(&[truck]);
        assert_eq!(labels.positives.len(), 1);
        assert!((labels.positives[0].code[3] - (3.5f64 / 1.56).ln()).abs() < 1e-12);
    }

    #[test]
    fn restriction_to_near_anchors_changes_nothing() {
        let objects = [
            Box3d {
                center_m: [3.3, 4.1, -0.8],
                size_m: [4.5, 1.9, 1.6],
                heading_rad: 0.3,
            },
            Box3d {
                center_m: [5.1, 4.9, -0.8],
                size_m: [4.2, 1.8, 1.6],
                heading_rad: 1.3,
            },
        ];
        let assigner = assigner();
        let labels = assigner.assign(&objects);
        let standing: Vec<Standing> = objects.iter().map(Standing::of).collect();
        for index in 0..labels.anchors {
            let anchor = &assigner.standing[index];
            let overlaps = standing.iter().map(|object| anchor.overlap(object));
            let over = overlaps.fold(0.0, f32::max);
            let positive = labels
                .positives
                .iter()
                .any(|positive| positive.anchor == index);
            assert!(positive || over <= 0.6);
            assert_eq!(
                labels.unassigned.contains(&index),
                !positive && over >= 0.45
            );
        }
    }

    #[test]
    fn no_objects_no_targets() {
        let labels = assigner().assign(&[]);
        assert!(labels.positives.is_empty() && labels.unassigned.is_empty());
        let far = Box3d {
            center_m: [1e6, 0.0, 0.0],
            size_m: CAR,
            heading_rad: 0.0,
        };
        assert!(assigner().assign(&[far]).positives.is_empty());
    }
}
