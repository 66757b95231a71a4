//! Window attention in plain floats, on the CPU and without gradients: windows are so small that the tensor library
//! takes longer to sort their tokens than to multiply them.

use multiversion::multiversion;

use crate::vector_loops::{LANES, exponentials};

/// Windows of one size on the tokens of a map.
pub(super) struct TokenWindows {
    /// Rows and columns of tokens, multiples of `edge`.
    pub(super) size: [usize; 2],
    /// Tokens along each edge of a window.
    pub(super) edge: usize,
    /// Channels of a token; of its first head with this size of window the first; of a head.
    pub(super) channels: [usize; 3],
    /// `[heads, edge^2, edge^2]`: added to the score of each pair of tokens.
    pub(super) preference: Vec<f32>,
}

/// Attention within windows: from queries, keys and values of all tokens, `[h, w, 3 * D]`, to the channels of these heads
/// of `out` `[h, w, D]`.
#[multiversion(targets("x86_64+avx2+fma"))]
pub(super) fn attend(windows: &TokenWindows, projected: &[f32], out: &mut [f32]) {
    let &TokenWindows {
        size: [height, width],
        edge,
        channels: [dim, first, each],
        ..
    } = windows;
    let (tokens, scale) = (edge * edge, (each as f32).sqrt().recip());
    // Blocks of tokens, and of channels, of which the last are none.
    let [length, wide] = [tokens, each].map(|size| size.div_ceil(LANES));
    // Lanes are tokens in the keys and channels in the values: both products fill whole lanes.
    let mut keys = vec![[0.0; LANES]; length * each];
    let mut values = vec![[0.0; LANES]; wide * length * LANES];
    let mut scores = vec![0.0; length * LANES];
    for window in 0..height / edge * (width / edge) {
        let (row, column) = (window / (width / edge), window % (width / edge));
        let corner = (row * width + column) * edge;
        let place = |token: usize| corner + token / edge * width + token % edge;
        for (head, preference) in windows.preference.chunks_exact(tokens * tokens).enumerate() {
            let channel = first + head * each;
            for token in 0..tokens {
                // A token has query, key and value in turn: this begins at its key.
                let of = &projected[place(token) * 3 * dim + dim..][..2 * dim];
                for at in 0..each {
                    keys[token / LANES * each + at][token % LANES] = of[channel + at];
                    values[at / LANES * length * LANES + token][at % LANES] =
                        of[dim + channel + at];
                }
            }
            for (token, preference) in preference.chunks_exact(tokens).enumerate() {
                scores[..tokens].copy_from_slice(preference);
                // The last block may reach beyond the window: its other places get no weight.
                scores[tokens..].fill(f32::NEG_INFINITY);
                let query = &projected[place(token) * 3 * dim + channel..][..each];
                for (scores, keys) in scores.chunks_exact_mut(LANES).zip(keys.chunks_exact(each)) {
                    let sums = products(query, keys);
                    scores
                        .iter_mut()
                        .zip(sums)
                        .for_each(|(score, sum)| *score += sum * scale);
                }
                let share = exponentials(&mut scores).recip();
                let out = &mut out[place(token) * dim + channel..][..each];
                for (out, values) in out
                    .chunks_mut(LANES)
                    .zip(values.chunks_exact(length * LANES))
                {
                    let sums = products(&scores, values);
                    out.iter_mut()
                        .zip(sums)
                        .for_each(|(out, sum)| *out = sum * share);
                }
            }
        }
    }
}

/// Sum of blocks of numbers, each times its factor.
#[inline(always)]
fn products(factors: &[f32], blocks: &[[f32; LANES]]) -> [f32; LANES] {
    let mut sums = [0.0; LANES];
    for (factor, block) in factors.iter().zip(blocks) {
        (0..LANES).for_each(|lane| sums[lane] += factor * block[lane]);
    }
    sums
}
