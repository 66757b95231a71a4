//! k-means clusters of positions.

use rand::SeedableRng;
use rand::seq::IndexedRandom;
use rand_chacha::ChaCha8Rng;

/// Number of rounds; clusters hardly change afterwards.
const ROUNDS: usize = 25;

/// Centres of up to `count` clusters and the cluster of every point. Fewer points than clusters: every point is one.
///
/// Starts with points far from each other (k-means++, Arthur and Vassilvitskii 2007); same seed, same result.
pub(crate) fn kmeans<const N: usize>(
    points: &[[f64; N]],
    count: usize,
    seed: u64,
) -> (Vec<[f64; N]>, Vec<usize>) {
    let mut centres = spread(points, count.min(points.len()), seed);
    let mut labels = vec![0; points.len()];
    for _ in 0..ROUNDS {
        for (label, point) in labels.iter_mut().zip(points) {
            *label = nearest(&centres, point);
        }
        let mut sums = vec![([0.0; N], 0.0); centres.len()];
        for (&label, point) in labels.iter().zip(points) {
            let (sum, count) = &mut sums[label];
            for (sum, value) in sum.iter_mut().zip(point) {
                *sum += value;
            }
            *count += 1.0;
        }
        for (centre, (sum, count)) in centres.iter_mut().zip(&sums) {
            // A centre without points stays where it is.
            if *count > 0.0 {
                *centre = sum.map(|sum| sum / count);
            }
        }
    }
    (centres, labels)
}

fn spread<const N: usize>(points: &[[f64; N]], count: usize, seed: u64) -> Vec<[f64; N]> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut squares = vec![f64::MAX; points.len()];
    let mut centres: Vec<[f64; N]> = Vec::with_capacity(count);
    while centres.len() < count {
        let indices: Vec<usize> = (0..points.len()).collect();
        // All weights are zero when points repeat: any point is a valid choice then.
        let chosen = indices.choose_weighted(&mut rng, |&index: &usize| match centres.is_empty() {
            true => 1.0,
            false => squares[index],
        });
        let centre = points[chosen.copied().unwrap_or(0)];
        // The chance of a point to become a centre grows with its squared distance to the nearest one.
        for (least, point) in squares.iter_mut().zip(points) {
            *least = least.min(square(&centre, point));
        }
        centres.push(centre);
    }
    centres
}

/// Index of the centre nearest to a point.
pub(crate) fn nearest<const N: usize>(centres: &[[f64; N]], point: &[f64; N]) -> usize {
    let distances = centres.iter().map(|centre| square(centre, point));
    let least = distances.enumerate().min_by(|a, b| a.1.total_cmp(&b.1));
    least.map_or(0, |(index, _)| index)
}

fn square<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heaps_become_clusters() {
        let points = [0.0, 50.0, 100.0].into_iter().flat_map(|x: f64| {
            (0..20).map(move |k| [x + 0.1 * f64::from(k % 5), 0.1 * f64::from(k / 5), 0.0])
        });
        let points: Vec<[f64; 3]> = points.collect();
        let (centres, labels) = kmeans(&points, 3, 1);
        assert_eq!(centres.len(), 3);
        assert!(
            labels
                .chunks(20)
                .all(|heap| heap.iter().all(|label| *label == heap[0]))
        );
        assert_eq!(kmeans(&points, 3, 1), (centres, labels));
    }

    #[test]
    fn few_or_equal_points_are_valid() {
        assert_eq!(kmeans::<3>(&[], 4, 0).0.len(), 0);
        assert_eq!(kmeans(&[[1.0; 3]; 9], 4, 0).0, [[1.0; 3]; 4]);
    }
}
