//! Road surfaces: quadrilaterals across every road, by use.

use super::convex::{CellIndex, PlanRectangle, Quad, bounds, overlap, range};
use super::curve::Pose2;
use super::road::{LaneKind, Road, RoadNetwork};

/// Distance between cross-sections, metres.
pub(crate) const STEP_M: f64 = 2.0;
/// Edge of a cell of the index, metres.
const CELL_M: f64 = 6.0;
/// Width of the pieces across a road that is bent across, metres.
const PIECE_M: f64 = 1.0;
/// Most pieces across one strip of such a road, and of all of them together.
const MAX_PIECES: f64 = 64.0;
const MAX_ALL_PIECES: f64 = 2e6;
/// Distance for which a slope across continues beside the road, metres.
const BESIDE_M: f64 = 4.0;
/// Most cells of the index that all patches together may touch: some 100 MB.
const MAX_TOUCHED: f64 = 2e7;

/// A cut across a road.
#[derive(Debug, Clone, Copy)]
pub(crate) struct CrossSection {
    pub s_m: f64,
    /// Place and heading of the reference line.
    pub pose: Pose2,
    /// Height of the reference line.
    pub z_m: f64,
    /// Two places across a road that is not level, the outermost paved ones: `t`, distance beside the reference line
    /// and height over it, metres.
    bank: Option<[[f64; 3]; 2]>,
    /// Lowest and highest `t` of the carriageway: driving lanes, shoulders, parking lanes; metres. Equal where there is
    /// none.
    pub carriageway_m: [f64; 2],
    /// The same with pavements and verges.
    pub paved_m: [f64; 2],
    /// Section of the road.
    pub section: usize,
}

/// A piece of a road's surface between two cross-sections.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patch {
    /// Corners: start right, end right, end left, start left; metres.
    pub quad: Quad,
    /// Heights of the corners, metres.
    pub z_m: [f64; 4],
    /// Highest place of the whole road between the two cross-sections, metres.
    pub top_m: f64,
    pub road: u32,
    /// True if vehicles drive here; else pavement or verge.
    pub carriageway: bool,
}

/// All roads' cross-sections and patches.
#[derive(Debug, Clone)]
pub(crate) struct RoadSurface {
    /// Cross-sections by road.
    pub roads: Vec<Vec<CrossSection>>,
    pub patches: Vec<Patch>,
    index: CellIndex,
    /// Lowest and highest x and y of all patches, metres.
    pub bounds_m: [[f64; 2]; 2],
}

impl CrossSection {
    /// Place at `t`, metres.
    pub(crate) fn at(&self, t_m: f64) -> [f64; 2] {
        let pose = self.pose.moved(0.0, self.aside_m(t_m), 0.0);
        [pose.x, pose.y]
    }

    /// Distance beside the reference line at `t`, metres; straight from one side of the road to the other.
    pub(crate) fn aside_m(&self, t_m: f64) -> f64 {
        self.across(t_m, 1).unwrap_or(t_m)
    }

    /// Height at `t`, metres; straight from one side of the road to the other.
    pub(crate) fn height_m(&self, t_m: f64) -> f64 {
        self.across(t_m, 2)
            .map_or(self.z_m, |height| self.z_m + height)
    }

    /// Slope across, radians; positive where the left side is higher.
    pub(crate) fn bank_rad(&self) -> f64 {
        self.bank.map_or(0.0, |[right, left]| {
            (left[2] - right[2]).atan2(left[1] - right[1])
        })
    }

    /// Lowest and highest of both paved edges, metres.
    pub(crate) fn range_m(&self) -> [f64; 2] {
        let [right, left] = self.paved_m.map(|t| self.height_m(t));
        [right.min(left), right.max(left)]
    }

    fn across(&self, t_m: f64, value: usize) -> Option<f64> {
        let [right, left] = self.bank?;
        let share = (t_m - right[0]) / (left[0] - right[0]).max(1e-3);
        Some(right[value] + share * (left[value] - right[value]))
    }
}

impl Patch {
    /// Height of the surface at (or beside) a place, metres.
    pub(crate) fn height_m(&self, [x, y]: [f64; 2]) -> f64 {
        let [start, end] = [[0, 3], [1, 2]].map(|[a, b]| middle(self.quad[a], self.quad[b]));
        let (dx, dy) = (end[0] - start[0], end[1] - start[1]);
        let share = ((x - start[0]) * dx + (y - start[1]) * dy) / (dx * dx + dy * dy).max(1e-9);
        let share = share.clamp(0.0, 1.0);
        let [right_z, left_z] =
            [[0, 1], [3, 2]].map(|[a, b]| self.z_m[a] + share * (self.z_m[b] - self.z_m[a]));
        if right_z == left_z {
            return right_z;
        }
        // A slope across goes on beside the road, so that a grid of heights meets it up to its edge.
        let [right, left] = [[0, 1], [3, 2]].map(|[a, b]| {
            let (a, b) = (self.quad[a], self.quad[b]);
            [0, 1].map(|axis| a[axis] + share * (b[axis] - a[axis]))
        });
        let (dx, dy) = (left[0] - right[0], left[1] - right[1]);
        let width_m = dx.hypot(dy).max(1e-3);
        let across_m = ((x - right[0]) * dx + (y - right[1]) * dy) / width_m;
        right_z + across_m.clamp(-BESIDE_M, width_m + BESIDE_M) / width_m * (left_z - right_z)
    }

    /// Heights of its lowest and its highest corner, metres.
    pub(crate) fn range_m(&self) -> [f64; 2] {
        range(self.z_m.into_iter())
    }
}

/// The middle between two places.
pub(super) fn middle(a: [f64; 2], b: [f64; 2]) -> [f64; 2] {
    [(a[0] + b[0]) / 2.0, (a[1] + b[1]) / 2.0]
}

impl RoadSurface {
    pub(crate) fn new(network: &RoadNetwork) -> Self {
        let roads: Vec<Vec<CrossSection>> = network.roads.iter().map(cross_sections).collect();
        let most_pieces = most_pieces(network);
        let mut patches = Vec::new();
        for (place, sections) in roads.iter().enumerate() {
            let road = &network.roads[place];
            for pair in sections.windows(2) {
                let [from, to] = [pair[0], pair[1]];
                let before = patches.len();
                // The carriageway, then what lies to the right and to the left of it.
                let [a, b] = [from, to].map(|cut| {
                    let ([low, high], [right, left]) = (cut.paved_m, cut.carriageway_m);
                    [[right, left], [low, right], [left, high]]
                });
                for ((a, b), carriageway) in a.into_iter().zip(b).zip([true, false, false]) {
                    // Strips of less than a centimetre are rounding.
                    if a[1] - a[0] > 0.01 || b[1] - b[0] > 0.01 {
                        strips(road, [(from, a), (to, b)], most_pieces, |quad, z_m| {
                            patches.push(Patch {
                                quad,
                                z_m,
                                // Set below, once all pieces of the strip are known.
                                top_m: f64::NAN,
                                road: place as u32,
                                carriageway,
                            });
                        });
                    }
                }
                let own = &mut patches[before..];
                let [_, top_m] = range(own.iter().flat_map(|patch| patch.z_m));
                own.iter_mut().for_each(|patch| patch.top_m = top_m);
            }
        }
        let bounds_m = match patches.is_empty() {
            true => [[0.0; 2]; 2],
            false => bounds(patches.iter().flat_map(|patch| patch.quad)),
        };
        let mut index = CellIndex::new(bounds_m, cell_m(&patches, CELL_M));
        for (number, patch) in patches.iter().enumerate() {
            index.insert(number as u32, bounds(patch.quad));
        }
        Self {
            roads,
            patches,
            index,
            bounds_m,
        }
    }

    /// True if `test` is true for any patch that overlaps `area`.
    pub(crate) fn any(&self, area: &PlanRectangle, mut test: impl FnMut(&Patch) -> bool) -> bool {
        let corners = area.corners();
        self.index.any(bounds(corners), |number| {
            let patch = &self.patches[number as usize];
            overlap(&corners, &patch.quad) && test(patch)
        })
    }

    /// True if an object from `bottom_m` to `top_m` over `rectangle` keeps clear of every road: above `headroom_m` over
    /// its surface, or wholly below it. Pavements count only if `pavements` is set.
    pub(crate) fn is_clear(
        &self,
        rectangle: &PlanRectangle,
        [bottom_m, top_m]: [f64; 2],
        headroom_m: f64,
        pavements: bool,
    ) -> bool {
        !self.any(rectangle, |patch| {
            let [low, high] = patch.range_m();
            (pavements || patch.carriageway) && bottom_m < high + headroom_m && top_m > low - 0.05
        })
    }
}

/// Most pieces across one strip: fewer where so many roads of a map are not level that the pieces would exhaust the
/// memory.
fn most_pieces(network: &RoadNetwork) -> f64 {
    let banked = network.roads.iter().filter(|road| !road.lateral.is_level());
    let cuts: f64 = banked
        .map(|road| road.length_m / STEP_M + road.sections.len() as f64)
        .sum();
    // Each cut begins three strips: the carriageway and both sides.
    (MAX_ALL_PIECES / (3.0 * cuts).max(1.0))
        .floor()
        .clamp(1.0, MAX_PIECES)
}

/// The pieces of a road's surface between two cross-sections and, in each, two `t`: one, or several side by side where
/// the road is bent across. Calls `piece` with the corners in the order of [`Patch::quad`] and their heights.
fn strips(
    road: &Road,
    [(from, a), (to, b)]: [(CrossSection, [f64; 2]); 2],
    most_pieces: f64,
    mut piece: impl FnMut(Quad, [f64; 4]),
) {
    if road.lateral.is_level() {
        let quad = [from.at(a[0]), to.at(b[0]), to.at(b[1]), from.at(a[1])];
        return piece(quad, [from.z_m, to.z_m, to.z_m, from.z_m]);
    }
    let is_straight = road.lateral.is_flat() && !road.sections[from.section].has_level_lanes();
    let width_m = (a[1] - a[0]).max(b[1] - b[0]);
    let count = match is_straight {
        true => 1,
        false => (width_m / PIECE_M).ceil().clamp(1.0, most_pieces) as usize,
    };
    for place in 0..count {
        let ends = [
            (&from, a, place),
            (&to, b, place),
            (&to, b, place + 1),
            (&from, a, place + 1),
        ];
        let corners = ends.map(|(cut, range, place)| {
            let t_m = range[0] + (range[1] - range[0]) * place as f64 / count as f64;
            road.point_at(cut.section, cut.s_m, t_m)
        });
        piece(corners.map(|[x, y, _]| [x, y]), corners.map(|[_, _, z]| z));
    }
}

/// Edge of the cells of a grid over all patches, metres: `least_m`, or more where surfaces are so wide and skewed that
/// the cells they touch would exhaust the memory or take minutes to visit.
pub(super) fn cell_m(patches: &[Patch], least_m: f64) -> f64 {
    let mut cell_m = least_m;
    // Every patch touches one cell at least, and there are far fewer patches than that.
    while touched(patches, cell_m) > MAX_TOUCHED && cell_m < 1e9 {
        cell_m *= 2.0;
    }
    cell_m
}

/// Number of cells of a grid that the bounds of patches touch.
fn touched(patches: &[Patch], cell_m: f64) -> f64 {
    let boxes = patches.iter().map(|patch| bounds(patch.quad));
    let sides = boxes.map(|[low, high]| [0, 1].map(|axis| (high[axis] - low[axis]) / cell_m + 1.0));
    sides.map(|[x, y]| x * y).sum()
}

fn cross_sections(road: &Road) -> Vec<CrossSection> {
    let mut cuts = Vec::new();
    for section in 0..road.sections.len() {
        let (from, to) = (road.sections[section].s_m, road.section_end_m(section));
        let steps = ((to - from) / STEP_M).ceil().max(1.0) as usize;
        for step in 0..=steps {
            let s_m = from + (to - from) * step as f64 / steps as f64;
            cuts.push(cut(road, section, s_m, s_m.min(to - 1e-6).max(from)));
        }
    }
    cuts
}

/// The cut at `s_m`, with widths taken at `inside_m`, which always lies in the section.
fn cut(road: &Road, section: usize, s_m: f64, inside_m: f64) -> CrossSection {
    let origin = road.lane_offset_m(inside_m);
    let kinds: [fn(LaneKind) -> bool; 3] = [
        |kind| kind == LaneKind::Driving,
        |kind| [LaneKind::Driving, LaneKind::Shoulder, LaneKind::Parking].contains(&kind),
        |kind| kind != LaneKind::Other && kind != LaneKind::Median,
    ];
    let [driving, carriageway, paved] = kinds.map(|wanted| {
        let lanes = &road.sections[section];
        let ids = lanes.lane_ids();
        let ids = ids.filter(|&id| lanes.lane(id).is_some_and(|lane| wanted(lane.kind)));
        let spans = ids.map(|id| road.lane_span_m(section, id, inside_m));
        let wide = spans.filter(|[low, high]| high > low);
        wide.reduce(|[a, b], [low, high]| [a.min(low), b.max(high)])
    });
    let carriageway_m = carriageway.or(driving).unwrap_or([origin; 2]);
    let paved_m = paved.unwrap_or(carriageway_m);
    let bank = (!road.lateral.is_level() && paved_m[1] > paved_m[0]).then(|| {
        paved_m.map(|t_m| {
            let [aside_m, height_m] = road.aside_m(section, inside_m, t_m);
            [t_m, aside_m, height_m]
        })
    });
    CrossSection {
        s_m,
        pose: road.pose_at(s_m),
        z_m: road.elevation.at(s_m),
        bank,
        carriageway_m,
        paved_m,
        section,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wide_surfaces_askew_get_larger_cells() {
        let surface = RoadSurface::new(&super::super::layout::town1(1).network);
        assert_eq!(cell_m(&surface.patches, CELL_M), CELL_M);
        let (right, left) = ([0.0, 0.0], [9_000.0, 9_000.0]);
        let wide = Patch {
            quad: [right, right, left, left],
            z_m: [0.0; 4],
            top_m: 0.0,
            road: 0,
            carriageway: true,
        };
        let cells = (9_000.0 / cell_m(&[wide; 100], CELL_M) + 1.0).powi(2) * 100.0;
        assert!(
            (MAX_TOUCHED / 5.0..=MAX_TOUCHED).contains(&cells),
            "{cells}"
        );
    }

    #[test]
    fn patches_follow_a_street_and_leave_headroom() {
        let layout = super::super::layout::town1(1);
        let surface = RoadSurface::new(&layout.network);
        let road = layout
            .network
            .roads
            .iter()
            .position(|road| road.junction.is_none())
            .unwrap();
        let cut = surface.roads[road][5];
        for (t_m, z_m, is_clear) in [
            (1.0, [0.0, 3.0], false),
            (1.0, [4.6, 8.0], true),
            (1.0, [-3.0, -0.2], true),
            (cut.paved_m[1] + 0.5, [0.0, 3.0], true),
        ] {
            let square = PlanRectangle::square(cut.at(t_m), 0.2);
            let found = surface.is_clear(&square, z_m, 4.5, false);
            assert_eq!(found, is_clear, "{t_m} {z_m:?}");
        }
    }
}
