//! Lanes and the links between them.

use std::f64::consts::PI;

/// A lane by its index in [`LaneGraph::lanes`].
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct LaneId(pub u32);

/// All driving lanes of a map.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LaneGraph {
    /// The lanes; `lanes[i].id == LaneId(i)`.
    pub lanes: Vec<Lane>,
}

/// A stretch of driving lane without branches inside.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Lane {
    /// Its own index in the graph.
    pub id: LaneId,
    /// Middle of the lane, in driving direction, at even steps of about 1 m (at least two points), metres in the world
    /// frame.
    pub centerline: Vec<[f64; 3]>,
    /// Length of the centre line in the plane, metres.
    pub length_m: f64,
    /// Width at each point of the centre line, metres.
    pub widths_m: Vec<f64>,
    /// Slope across the lane at each point of the centre line as an angle, radians; positive where the left side in
    /// driving direction is higher. Empty where the road is level.
    pub banks_rad: Vec<f64>,
    /// Median width, metres.
    pub width_m: f64,
    /// Speed limit, metres per second.
    pub speed_limit_mps: f64,
    /// Lanes that begin where this one ends.
    pub successors: Vec<LaneId>,
    /// Lanes that end where this one begins.
    pub predecessors: Vec<LaneId>,
    /// Neighbour to the left that leads the same way.
    pub left: Option<LaneId>,
    /// Neighbour to the right that leads the same way.
    pub right: Option<LaneId>,
    /// The junction it lies in, by its place in the network.
    pub junction: Option<usize>,
    /// Lanes of the same junction that cross it or end where it ends (not those that begin together with it); give way
    /// by these.
    pub conflicts: Vec<LaneId>,
}

impl Lane {
    /// Place on the centre line at `s_m` metres from its start (clamped to the lane), and the heading there in radians.
    pub fn at(&self, s_m: f64) -> ([f64; 3], f64) {
        let last = self.centerline.len() - 1;
        let step = (s_m / self.length_m * last as f64).clamp(0.0, last as f64);
        let index = (step as usize).min(last - 1);
        let share = step - index as f64;
        let (from, to) = (self.centerline[index], self.centerline[index + 1]);
        let point = std::array::from_fn(|axis| from[axis] + share * (to[axis] - from[axis]));
        // Headings belong to the middles of the steps; between them they turn evenly, so that a vehicle does not jerk.
        let neighbour = if share < 0.5 {
            index.saturating_sub(1)
        } else {
            (index + 1).min(last - 1)
        };
        let own = self.step_heading_rad(index);
        let turn = wrap_angle(self.step_heading_rad(neighbour) - own);
        (point, wrap_angle(own + turn * (share - 0.5).abs()))
    }

    /// Slope across the lane at `s_m`, radians; see [`Lane::banks_rad`].
    pub(crate) fn bank_rad(&self, s_m: f64) -> f64 {
        let Some(last) = self.banks_rad.len().checked_sub(1).filter(|&last| last > 0) else {
            return 0.0;
        };
        let step = (s_m / self.length_m * last as f64).clamp(0.0, last as f64);
        let index = (step as usize).min(last - 1);
        let share = step - index as f64;
        self.banks_rad[index] + share * (self.banks_rad[index + 1] - self.banks_rad[index])
    }

    fn step_heading_rad(&self, index: usize) -> f64 {
        let (from, to) = (self.centerline[index], self.centerline[index + 1]);
        (to[1] - from[1]).atan2(to[0] - from[0])
    }
}

impl LaneGraph {
    /// A graph of `lanes`, whose ids are their places.
    pub fn new(lanes: Vec<Lane>) -> Self {
        debug_assert!((0..).zip(&lanes).all(|(index, lane)| lane.id.0 == index));
        Self { lanes }
    }

    /// The lane of an id that belongs to this graph.
    pub fn lane(&self, id: LaneId) -> &Lane {
        &self.lanes[id.0 as usize]
    }
}

/// Normalises an angle to (-pi, pi].
pub(crate) fn wrap_angle(angle_rad: f64) -> f64 {
    let wrapped = angle_rad.rem_euclid(2.0 * PI);
    let turn = if wrapped > PI { 2.0 * PI } else { 0.0 };
    wrapped - turn
}

#[cfg(test)]
mod tests {
    use super::*;

    impl Lane {
        /// A lane of one width outside junctions, not yet linked. `centerline` holds at least two points.
        pub(crate) fn new(
            id: LaneId,
            centerline: Vec<[f64; 3]>,
            width_m: f64,
            speed_limit_mps: f64,
        ) -> Self {
            let length_m = centerline
                .windows(2)
                .map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]))
                .sum();
            let widths_m = vec![width_m; centerline.len()];
            Self {
                id,
                centerline,
                length_m,
                widths_m,
                width_m,
                speed_limit_mps,
                ..Self::default()
            }
        }
    }

    #[test]
    fn position_and_heading_on_a_circle() {
        let radius = 20.0;
        let points: Vec<_> = (0..=31).map(|i| f64::from(i) / 31.0 * PI / 2.0).collect();
        let centerline = points
            .iter()
            .map(|a| [radius * a.sin(), radius * (1.0 - a.cos()), 0.0])
            .collect();
        let lane = Lane::new(LaneId(0), centerline, 3.5, 10.0);
        assert!((lane.length_m - radius * PI / 2.0).abs() < 0.01);
        for share in [0.0, 0.21, 0.5, 0.77, 1.0] {
            let angle = share * PI / 2.0;
            let (point, heading) = lane.at(share * lane.length_m);
            assert!(
                (point[0] - radius * angle.sin()).abs() < 0.02,
                "{share}: {point:?}"
            );
            assert!((point[1] - radius * (1.0 - angle.cos())).abs() < 0.02);
            // Half a step is missing at both ends.
            assert!((heading - angle).abs() < 0.03, "{share}: {heading}");
        }
    }

    #[test]
    fn angles_wrap_into_the_half_open_circle() {
        assert!((wrap_angle(3.0 * PI) - PI).abs() < 1e-12);
        assert!((wrap_angle(-PI) - PI).abs() < 1e-12);
        assert!((wrap_angle(0.5 - 4.0 * PI) - 0.5).abs() < 1e-12);
    }
}
