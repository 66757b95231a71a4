//! Surfels: a point cloud as small planes, one per voxel whose points and those around it are flat.
//!
//! Coordinates have to be near zero, some kilometres, or sums of squares lose the precision that planes need.

use nalgebra::{Matrix3, SymmetricEigen, Vector3};

use perception::sparse::Sites;

/// Smallest vertical part of the normal of a level plane.
const LEVEL_NORMAL_Z: f64 = 0.9;
/// Fewest points that a plane is fitted to.
const MIN_POINTS: f64 = 6.0;
/// Largest thickness of a plane: its smallest variance as a share of the middle one.
const MAX_THICKNESS: f64 = 0.08;
/// Smallest width of a plane: its middle variance as a share of the largest. Below it the points lie on one scan line,
/// and any plane through that line fits.
const MIN_WIDTH: f64 = 0.02;

/// A small plane.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Surfel {
    /// Mean of the voxel's own points, metres.
    pub centre_m: Vector3<f64>,
    /// Unit normal, of either sign.
    pub normal: Vector3<f64>,
}

/// True for the normal of a plane like the ground.
pub(crate) fn is_level(normal: &Vector3<f64>) -> bool {
    normal.z.abs() > LEVEL_NORMAL_Z
}

/// A plane as it is kept: a town has half a million of them. Single precision is 30 nm in a voxel of half a metre.
#[derive(Debug, Clone, Copy)]
struct KeptPlane {
    /// Centre from the voxel's lowest corner, metres.
    offset_m: Vector3<f32>,
    normal: Vector3<f32>,
}

/// Sums over the points of a voxel.
#[derive(Debug, Clone, Copy, Default)]
struct PointSums {
    count: f64,
    sum: Vector3<f64>,
    /// Sum of `p p^T`.
    outer: Matrix3<f64>,
}

impl PointSums {
    fn add(&mut self, point: &Vector3<f64>) {
        self.count += 1.0;
        self.sum += point;
        self.outer += point * point.transpose();
    }

    fn merge(&mut self, other: &Self) {
        self.count += other.count;
        self.sum += other.sum;
        self.outer += other.outer;
    }

    fn mean(&self) -> Vector3<f64> {
        self.sum / self.count
    }

    /// Normal of the plane through the points, if they are flat.
    fn normal(&self) -> Option<Vector3<f64>> {
        if self.count < MIN_POINTS {
            return None;
        }
        let mean = self.mean();
        let eigen = SymmetricEigen::new(self.outer / self.count - mean * mean.transpose());
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        // Rounding can leave the smallest variance of an exact plane below zero.
        let [thin, middle, wide] = order.map(|axis| eigen.eigenvalues[axis].max(0.0));
        let flat = thin <= MAX_THICKNESS * middle && middle >= MIN_WIDTH * wide && wide > 0.0;
        flat.then(|| eigen.eigenvectors.column(order[0]).into_owned())
    }
}

/// A cloud, or many clouds in one frame, as planes on a voxel grid.
#[derive(Debug, Clone, Default)]
pub(super) struct Surfels {
    pub(super) voxel_m: f64,
    sites: Sites,
    moments: Vec<PointSums>,
    /// By row of `sites`; made by [`Self::fit`].
    planes: Vec<Option<KeptPlane>>,
    /// Number of voxels with a plane.
    pub(super) count: usize,
}

impl Surfels {
    pub(super) fn new(voxel_m: f64) -> Self {
        Self {
            voxel_m,
            ..Self::default()
        }
    }

    /// Adds a point; those that no voxel can hold (not finite, hundreds of kilometres out) are left out.
    pub(super) fn add(&mut self, point_m: &Vector3<f64>) {
        let Some(voxel) = voxel_of(point_m, self.voxel_m) else {
            return;
        };
        let row = self.sites.add(voxel) as usize;
        self.moments.resize(self.sites.len(), PointSums::default());
        self.moments[row].add(point_m);
    }

    /// Fits the planes: each to the points of its voxel and of the 26 around it, since one sweep leaves a line or two
    /// in a voxel.
    pub(super) fn fit(&mut self) {
        let voxels = self.sites.coords().iter().zip(&self.moments);
        let planes = voxels.map(|(coord, own)| {
            let mut around = PointSums::default();
            for offset in 0..27 {
                let shifted = [
                    coord[0] + offset % 3 - 1,
                    coord[1] + offset / 3 % 3 - 1,
                    coord[2] + offset / 9 - 1,
                ];
                if let Some(row) = self.sites.row(shifted) {
                    around.merge(&self.moments[row as usize]);
                }
            }
            let plane = Surfel {
                // Of its own points: the mean over all 27 voxels may lie outside this one.
                centre_m: own.mean(),
                normal: around.normal()?,
            };
            Some(self.kept(*coord, &plane))
        });
        self.planes = planes.collect();
        self.count = self.planes.iter().flatten().count();
    }

    /// A grid of planes that were fitted before: no point can be added to it.
    pub(super) fn of_planes(
        voxel_m: f64,
        planes: impl ExactSizeIterator<Item = ([i32; 3], Surfel)>,
    ) -> Self {
        let mut surfels = Self::new(voxel_m);
        surfels.planes.reserve_exact(planes.len());
        for (voxel, plane) in planes {
            // A voxel has one plane: the first.
            if surfels.sites.add(voxel) as usize == surfels.planes.len() {
                surfels.planes.push(Some(surfels.kept(voxel, &plane)));
            }
        }
        surfels.count = surfels.planes.len();
        surfels
    }

    /// Voxels with their planes, in order of first appearance.
    pub(super) fn planes(&self) -> impl Iterator<Item = ([i32; 3], Surfel)> {
        (self.sites.coords().iter().copied())
            .zip(&self.planes)
            .filter_map(|(voxel, kept)| Some((voxel, self.plane(voxel, kept.as_ref()?))))
    }

    fn kept(&self, voxel: [i32; 3], plane: &Surfel) -> KeptPlane {
        KeptPlane {
            offset_m: (plane.centre_m - self.corner_m(voxel)).cast(),
            normal: plane.normal.cast(),
        }
    }

    fn plane(&self, voxel: [i32; 3], kept: &KeptPlane) -> Surfel {
        Surfel {
            centre_m: self.corner_m(voxel) + kept.offset_m.cast::<f64>(),
            normal: kept.normal.cast(),
        }
    }

    fn corner_m(&self, voxel: [i32; 3]) -> Vector3<f64> {
        Vector3::from(voxel.map(f64::from)) * self.voxel_m
    }

    /// The plane whose centre is nearest to a point, among the eight voxels on the point's side: complete to half a
    /// voxel, approximate to one and a half.
    pub(super) fn near(&self, point_m: &Vector3<f64>) -> Option<Surfel> {
        let first = voxel_of(&point_m.add_scalar(-self.voxel_m / 2.0), self.voxel_m)?;
        let planes = (0..8).filter_map(|offset| {
            let voxel = [
                first[0] + (offset & 1),
                first[1] + (offset >> 1 & 1),
                first[2] + (offset >> 2),
            ];
            let row = self.sites.row(voxel)?;
            let plane = self.plane(voxel, self.planes.get(row as usize)?.as_ref()?);
            Some((plane, (plane.centre_m - point_m).norm_squared()))
        });
        let nearest = planes.min_by(|(_, a), (_, b)| a.total_cmp(b));
        nearest.map(|(plane, _)| plane)
    }

    /// True if there is a level plane near a place, at most six voxels above or below the point.
    pub(super) fn has_level_at(&self, point_m: &Vector3<f64>) -> bool {
        (-6..=6).any(|step| {
            let at_m = point_m + Vector3::z() * (f64::from(step) * self.voxel_m);
            let near = self.near(&at_m);
            near.is_some_and(|near| is_level(&near.normal))
        })
    }
}

/// One point for every occupied voxel: the mean of the points in it, in order of first appearance.
pub(super) fn decimate(
    points_m: impl IntoIterator<Item = Vector3<f64>>,
    voxel_m: f64,
) -> Vec<Vector3<f64>> {
    let mut sites = Sites::default();
    let mut sums: Vec<(Vector3<f64>, f64)> = Vec::new();
    for point in points_m {
        let Some(voxel) = voxel_of(&point, voxel_m) else {
            continue;
        };
        let row = sites.add(voxel) as usize;
        sums.resize(sites.len(), Default::default());
        sums[row].0 += point;
        sums[row].1 += 1.0;
    }
    sums.into_iter().map(|(sum, count)| sum / count).collect()
}

/// Voxel of a point; `None` if no voxel can hold it.
fn voxel_of(point_m: &Vector3<f64>, voxel_m: f64) -> Option<[i32; 3]> {
    let voxel = (point_m / voxel_m).map(f64::floor);
    // One voxel of margin for the neighbours that are looked up. Also rejects values that are not finite.
    let edge = f64::from((1 << 20) - 2);
    let held = voxel.iter().all(|axis| axis.abs() < edge);
    held.then(|| [voxel.x as i32, voxel.y as i32, voxel.z as i32])
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points 0.1 m apart on the plane through `at` spanned by `u` and `v`.
    fn patch(at: [f64; 3], u: [f64; 3], v: [f64; 3]) -> impl Iterator<Item = Vector3<f64>> {
        let [at, u, v] = [at, u, v].map(Vector3::from);
        (0..1600).map(move |k| at + u * (f64::from(k % 40) * 0.1) + v * (f64::from(k / 40) * 0.1))
    }

    #[test]
    fn a_wall_has_its_normal() {
        for at in [[0.0, 0.0, 0.0], [-300.0, 4400.0, 120.0]] {
            let mut surfels = Surfels::new(0.5);
            patch(at, [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]).for_each(|point| surfels.add(&point));
            surfels.fit();
            assert!(surfels.count > 30);
            let beside = Vector3::from(at) + Vector3::new(1.2 - 0.16, 1.6 + 0.12, 1.0);
            let plane = surfels.near(&beside).unwrap();
            assert!((plane.normal.dot(&Vector3::new(0.8, -0.6, 0.0)).abs() - 1.0).abs() < 1e-6);
            assert!(((beside - plane.centre_m).dot(&plane.normal).abs() - 0.2).abs() < 1e-6);
        }
    }

    #[test]
    fn a_scan_line_and_a_few_points_are_no_plane() {
        let mut surfels = Surfels::new(1.0);
        for k in 0..200 {
            surfels.add(&Vector3::new(f64::from(k) * 0.05, 20.0, 0.3));
        }
        for k in 0..4 {
            surfels.add(&Vector3::new(50.0 + f64::from(k), f64::from(k * k), 0.0));
        }
        surfels.fit();
        assert_eq!(surfels.count, 0);
        assert_eq!(surfels.near(&Vector3::new(5.0, 20.0, 0.3)), None);
    }

    #[test]
    fn points_that_are_not_finite_are_left_out() {
        let mut surfels = Surfels::new(0.5);
        surfels.add(&Vector3::new(f64::NAN, 0.0, 0.0));
        surfels.add(&Vector3::new(0.0, f64::INFINITY, 0.0));
        patch([0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]).for_each(|point| surfels.add(&point));
        surfels.add(&Vector3::new(1e9, 0.0, 0.0));
        surfels.fit();
        assert!(surfels.count > 30);
        assert_eq!(surfels.near(&Vector3::new(f64::NAN, 0.0, 0.0)), None);
        assert!(decimate([Vector3::new(f64::NAN, 0.0, 0.0)], 0.5).is_empty());
    }

    #[test]
    fn thinning_leaves_one_mean_a_voxel() {
        let points = [
            [0.1, 0.1, 0.1],
            [0.3, 0.1, 0.1],
            [0.6, 0.1, 0.1],
            [-0.1, 0.1, 0.1],
        ]
        .map(Vector3::from);
        let thin = decimate(points, 0.5);
        let expected = [[0.2, 0.1, 0.1], [0.6, 0.1, 0.1], [-0.1, 0.1, 0.1]].map(Vector3::from);
        assert_eq!(thin.len(), 3);
        assert!(
            thin.iter()
                .zip(&expected)
                .all(|(a, b)| (a - b).norm() < 1e-12)
        );
    }
}
