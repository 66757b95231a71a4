//! Sampling of points: one for each voxel, then the farthest from all before.

/// Edge of a voxel, metres.
const VOXEL_M: f32 = 1.0;
/// Lowest voxel, metres above the sensor; lower points count as in it.
const LOWEST_M: f32 = -8.0;
/// Voxels on top of each other; higher points count as in the highest one.
const LAYERS: usize = 32;

/// The first point of each voxel, points within `range_m` of the sensor in the plane.
pub(super) fn thin(points_m: &[[f32; 3]], range_m: f32) -> Vec<[f32; 3]> {
    let side = (2.0 * range_m / VOXEL_M).ceil() as usize + 1;
    let mut is_taken = vec![false; side * side * LAYERS];
    let index = |value: f32, lowest: f32, count: usize| {
        (((value - lowest) / VOXEL_M) as usize).min(count - 1)
    };
    let mut thinned = Vec::with_capacity(4096);
    for &point in points_m {
        let [x, y, z] = point;
        // False for NaN too.
        let is_inside = x * x + y * y <= range_m * range_m && z.is_finite();
        if is_inside {
            let plane = index(x, -range_m, side) * side + index(y, -range_m, side);
            let voxel = plane * LAYERS + index(z, LOWEST_M, LAYERS);
            if !std::mem::replace(&mut is_taken[voxel], true) {
                thinned.push(point);
            }
        }
    }
    thinned
}

/// `count` points, each the farthest from all before it; the first is the farthest from the sensor. The first k of them
/// are the k that a sampling of k points would choose. Starts over when there are fewer; empty if there are none.
pub(super) fn farthest_points(points_m: &[[f32; 3]], count: usize) -> Vec<[f32; 3]> {
    let [x, y, z] = [0, 1, 2].map(|axis| {
        points_m
            .iter()
            .map(|point| point[axis])
            .collect::<Vec<f32>>()
    });
    let mut nearest = vec![f32::INFINITY; points_m.len()];
    let range = |[x, y, z]: [f32; 3]| x * x + y * y + z * z;
    let first =
        (0..points_m.len()).max_by(|&a, &b| range(points_m[a]).total_cmp(&range(points_m[b])));
    let Some(mut latest) = first else {
        return Vec::new();
    };
    let mut chosen = Vec::with_capacity(count);
    while chosen.len() < count.min(points_m.len()) {
        chosen.push(points_m[latest]);
        let [px, py, pz] = points_m[latest];
        for (((nearest, x), y), z) in nearest.iter_mut().zip(&x).zip(&y).zip(&z) {
            let (dx, dy, dz) = (x - px, y - py, z - pz);
            *nearest = nearest.min(dx * dx + dy * dy + dz * dz);
        }
        latest = index_of_largest(&nearest);
    }
    chosen.iter().copied().cycle().take(count).collect()
}

/// In two passes, which the compiler vectorises, other than a search for value and index in one.
fn index_of_largest(values: &[f32]) -> usize {
    let mut lanes = [f32::NEG_INFINITY; 16];
    let (chunks, rest) = values.as_chunks::<16>();
    for chunk in chunks {
        lanes
            .iter_mut()
            .zip(chunk)
            .for_each(|(lane, value)| *lane = if value > lane { *value } else { *lane });
    }
    let largest = lanes
        .iter()
        .chain(rest)
        .fold(f32::NEG_INFINITY, |a, b| a.max(*b));
    values
        .iter()
        .position(|&value| value == largest)
        .unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_keeps_its_first_point_and_points_out_of_range_are_left_out() {
        let points = [
            [0.1, 0.1, 0.1],
            [0.9, 0.9, 0.9],
            [1.1, 0.1, 0.1],
            [30.0, 0.0, 0.0],
            [f32::NAN, 0.0, 0.0],
        ];
        let heights = [
            [5.0, 5.0, -100.0],
            [5.0, 5.0, 1e9],
            [5.0, 5.0, f32::INFINITY],
            [5.0, 5.0, 2e9],
        ];
        let thinned = thin(&[&points[..], &heights].concat(), 20.0);
        assert_eq!(thinned, [points[0], points[2], heights[0], heights[1]]);
    }

    #[test]
    fn every_point_is_the_farthest_from_those_before() {
        let line: Vec<[f32; 3]> = (0..=40).map(|k| [k as f32, 0.0, 0.0]).collect();
        let chosen = farthest_points(&line, 5);
        assert_eq!(
            chosen.iter().map(|point| point[0]).collect::<Vec<f32>>(),
            [40.0, 0.0, 20.0, 10.0, 30.0]
        );
        assert_eq!(farthest_points(&line, 3), chosen[..3]);
    }

    #[test]
    fn few_points_are_repeated_in_their_order() {
        let two = [[3.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        assert_eq!(
            farthest_points(&two, 5),
            [two[0], two[1], two[0], two[1], two[0]]
        );
        assert!(farthest_points(&[], 5).is_empty());
    }
}
