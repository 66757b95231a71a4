//! Square matrices over correspondences: distances, sets of bits, leading eigenvectors.

/// Products that are summed in parallel.
const LANES: usize = 16;

/// Distances between all points, row by row, in single precision.
pub(super) fn distances(points: &[[f32; 3]]) -> Vec<f32> {
    let [x, y, z] =
        [0, 1, 2].map(|axis| points.iter().map(|point| point[axis]).collect::<Vec<f32>>());
    let mut distances = Vec::with_capacity(points.len() * points.len());
    for &[px, py, pz] in points {
        distances.extend(x.iter().zip(&y).zip(&z).map(|((x, y), z)| {
            let (dx, dy, dz) = (px - x, py - y, pz - z);
            (dx * dx + dy * dy + dz * dz).sqrt()
        }));
    }
    distances
}

/// A square matrix of bits, 64 to a word.
#[derive(Debug)]
pub(super) struct Bits {
    words: Vec<u64>,
    words_per_row: usize,
}

impl Bits {
    /// Sets a bit wherever an entry of a `size` by `size` matrix fulfils the condition.
    pub(super) fn where_true(
        entries: &[f32],
        size: usize,
        condition: impl Fn(f32) -> bool,
    ) -> Self {
        let chunks = entries.chunks(size.max(1)).flat_map(|row| row.chunks(64));
        let words = chunks.map(|entries| {
            entries
                .iter()
                .enumerate()
                .fold(0_u64, |word, (bit, &entry)| {
                    word | u64::from(condition(entry)) << bit
                })
        });
        Self {
            words: words.collect(),
            words_per_row: size.div_ceil(64),
        }
    }

    /// Number of bits that two rows share; for a symmetric matrix an entry of its square.
    pub(super) fn common(&self, a: usize, b: usize) -> u32 {
        let words = self.row(a).iter().zip(self.row(b));
        words.map(|(a, b)| (a & b).count_ones()).sum()
    }

    fn row(&self, index: usize) -> &[u64] {
        &self.words[index * self.words_per_row..(index + 1) * self.words_per_row]
    }
}

/// Leading eigenvectors of symmetric `size` by `size` matrices, one after the other, of length one, by power iteration
/// from a vector of ones. All matrices take the same number of steps: it ends when all have converged.
pub(super) fn leading_eigenvectors(matrices: &[f32], size: usize, iterations: usize) -> Vec<f32> {
    let mut vectors = vec![1.0_f32; matrices.len() / size.max(1)];
    for _ in 0..iterations {
        let next: Vec<f32> = (matrices.chunks(size * size).zip(vectors.chunks(size)))
            .flat_map(|(matrix, vector)| {
                normalised(matrix.chunks(size).map(|row| dot(row, vector)).collect())
            })
            .collect();
        let mut entries = next.iter().zip(&vectors);
        // The default tolerances of torch.allclose.
        let stands_still = entries.all(|(a, b)| (a - b).abs() <= 1e-8 + 1e-5 * b.abs());
        vectors = next;
        if stands_still {
            break;
        }
    }
    vectors
}

fn normalised(mut vector: Vec<f32>) -> Vec<f32> {
    let length = dot(&vector, &vector).sqrt() + 1e-6;
    vector.iter_mut().for_each(|entry| *entry /= length);
    vector
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let (a_blocks, a_rest) = a.as_chunks::<LANES>();
    let (b_blocks, b_rest) = b.as_chunks::<LANES>();
    // One sum per lane: floating-point addition has an order that the compiler must not change.
    let mut sums = [0.0_f32; LANES];
    for (a, b) in a_blocks.iter().zip(b_blocks) {
        for lane in 0..LANES {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum::<f32>() + a_rest.iter().zip(b_rest).map(|(a, b)| a * b).sum::<f32>()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(row: usize, column: usize) -> f32 {
        f32::from(u8::from((row * column + row + column).is_multiple_of(3)))
    }

    #[test]
    fn common_bits_are_the_square_of_the_matrix() {
        let size = 130;
        let entries: Vec<f32> = (0..size * size)
            .map(|place| entry(place / size, place % size))
            .collect();
        let bits = Bits::where_true(&entries, size, |entry| entry > 0.5);
        for (a, b) in [(0, 0), (1, 129), (64, 65)] {
            let square: f32 = (0..size).map(|k| entry(a, k) * entry(k, b)).sum();
            assert_eq!(bits.common(a, b), square as u32);
        }
    }

    #[test]
    fn leading_eigenvectors_of_several_matrices() {
        // Eigenvectors (1, 1) and (1, 2) belong to the largest eigenvalues.
        let matrices = [2.0, 1.0, 1.0, 2.0, 1.0, 2.0, 2.0, 4.0];
        let vectors = leading_eigenvectors(&matrices, 2, 50);
        let expected = [
            0.5_f32.sqrt(),
            0.5_f32.sqrt(),
            0.2_f32.sqrt(),
            0.8_f32.sqrt(),
        ];
        assert!(
            vectors
                .iter()
                .zip(expected)
                .all(|(a, b)| (a - b).abs() < 1e-4),
            "{vectors:?}"
        );
    }

    #[test]
    fn distances_are_symmetric() {
        assert_eq!(
            distances(&[[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]),
            [0.0, 5.0, 5.0, 0.0]
        );
    }
}
