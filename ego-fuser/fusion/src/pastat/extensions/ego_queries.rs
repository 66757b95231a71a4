//! Ego queries, an extension: only the tokens of the ego's newest map are queries in the attention over agents and time
//! (`rows: ego`), since only they are used in the end.
//!
//! Attention is then one pass over the tokens, where tensor operations pass over all of them a dozen times. Plain
//! floats: on the CPU, without gradients. Measured gain: not measured separately; every training in the tables has it.

use tch::{TchError, Tensor};

use crate::f64_tensor::numbers;

/// Cells that are processed together: their data fit into a core's L1 cache.
const STRIP: usize = 64;
/// As in `LayerNormConfig`.
const EPSILON: f32 = 1e-5;

/// The tokens of all entries but the ego's newest, and the validity of all.
pub(crate) struct Others {
    /// `[N - 1, D, cells]`.
    tokens: Vec<f32>,
    /// `[N, cells]`, 0 for invalid tokens; the ego's newest first.
    valid: Vec<f32>,
    dim: usize,
    cells: usize,
}

impl Others {
    /// From the tokens of all entries `[N, D, h, w]` and their validity `[N, h, w]`.
    pub(crate) fn of(tokens: &Tensor, valid: &Tensor) -> Result<Self, TchError> {
        let (entries, dim, height, width) = tokens.size4()?;
        let others = tokens.f_narrow(0, 1, entries - 1)?;
        let [dim, cells] = [dim, height * width].map(|size| size as usize);
        Ok(Self {
            tokens: numbers(&others)?,
            valid: numbers(valid)?,
            dim,
            cells,
        })
    }

    /// For each head and cell the mean of all entries' normalised tokens, weighted by the attention of the head's
    /// query, `[heads, D, cells]`. At a cell without valid tokens all have equal weight.
    ///
    /// # Shapes
    /// - `asked`: `[heads, D, cells]`: the score of a token is its product with it
    /// - `ego`: `[D, cells]`, the tokens of the ego's newest
    pub(crate) fn gather(&self, asked: &[f32], ego: &[f32]) -> Vec<f32> {
        let size = self.dim * self.cells;
        let entries: Vec<&[f32]> = std::iter::once(ego)
            .chain(self.tokens.chunks_exact(size))
            .collect();
        let mut gathered = vec![0.0; asked.len()];
        for first in (0..self.cells).step_by(STRIP) {
            let strip = Strip {
                first,
                count: STRIP.min(self.cells - first),
                of: self,
            };
            let normal: Vec<Normal> = entries.iter().map(|entry| strip.normal(entry)).collect();
            for (asked, gathered) in asked
                .chunks_exact(size)
                .zip(gathered.chunks_exact_mut(size))
            {
                let mut weights: Vec<StripRow> = entries
                    .iter()
                    .zip(&normal)
                    .map(|(entry, normal)| strip.score(asked, entry, normal))
                    .collect();
                strip.softmax(&mut weights);
                strip.mean(&entries, &normal, &weights, gathered);
            }
        }
        gathered
    }
}

/// A number for each cell of a strip.
type StripRow = [f32; STRIP];

/// Offset and factor of the layer norm for the tokens of a strip.
struct Normal {
    mean: StripRow,
    scale: StripRow,
}

/// Some consecutive cells.
struct Strip<'a> {
    first: usize,
    count: usize,
    of: &'a Others,
}

impl Strip<'_> {
    /// The strip's cells of each channel.
    fn rows<'b>(&self, map: &'b [f32]) -> impl Iterator<Item = &'b [f32]> + use<'b> {
        let cells = self.first..self.first + self.count;
        map.chunks_exact(self.of.cells)
            .map(move |row| &row[cells.clone()])
    }

    fn normal(&self, entry: &[f32]) -> Normal {
        let channels = self.of.dim as f32;
        let (mut mean, mut scale) = ([0.0; STRIP], [0.0; STRIP]);
        for row in self.rows(entry) {
            mean.iter_mut()
                .zip(row)
                .for_each(|(sum, value)| *sum += value);
        }
        mean.iter_mut().for_each(|sum| *sum /= channels);
        // Squares of deviations in a second pass: a difference of large sums would lose digits in f32.
        self.rows(entry).for_each(|row| {
            for ((sum, value), mean) in scale.iter_mut().zip(row).zip(&mean) {
                *sum += (value - mean) * (value - mean);
            }
        });
        for sum in &mut scale {
            *sum = (*sum / channels + EPSILON).sqrt().recip();
        }
        Normal { mean, scale }
    }

    fn score(&self, asked: &[f32], entry: &[f32], Normal { mean, scale }: &Normal) -> StripRow {
        let mut score = [0.0; STRIP];
        for (asked, row) in self.rows(asked).zip(self.rows(entry)) {
            for (((score, asked), value), mean) in score.iter_mut().zip(asked).zip(row).zip(mean) {
                *score += asked * (value - mean);
            }
        }
        // The scale is the same for all channels, so the sum is scaled and not each term.
        score
            .iter_mut()
            .zip(scale)
            .for_each(|(score, scale)| *score *= scale);
        score
    }

    fn is_valid(&self, entry: usize, cell: usize) -> bool {
        self.of.valid[entry * self.of.cells + self.first + cell] != 0.0
    }

    /// Scores of the entries to their weights.
    fn softmax(&self, scores: &mut [StripRow]) {
        for cell in 0..self.count {
            let is_any = (0..scores.len()).any(|entry| self.is_valid(entry, cell));
            for (entry, scores) in scores.iter_mut().enumerate() {
                // Without any valid token all scores are equal: minus infinity for all would give NaN.
                scores[cell] = match (is_any, self.is_valid(entry, cell)) {
                    (false, _) => 0.0,
                    (true, true) => scores[cell],
                    (true, false) => f32::NEG_INFINITY,
                };
            }
        }
        let mut most = [f32::NEG_INFINITY; STRIP];
        for scores in scores.iter() {
            most.iter_mut()
                .zip(scores)
                .for_each(|(most, score)| *most = most.max(*score));
        }
        let mut total = [0.0; STRIP];
        for scores in scores.iter_mut() {
            for ((score, most), total) in scores.iter_mut().zip(&most).zip(&mut total) {
                *score = (*score - most).exp();
                *total += *score;
            }
        }
        for scores in scores.iter_mut() {
            scores
                .iter_mut()
                .zip(&total)
                .for_each(|(score, total)| *score /= total);
        }
    }

    fn mean(&self, entries: &[&[f32]], normal: &[Normal], weights: &[StripRow], out: &mut [f32]) {
        let cells = self.first..self.first + self.count;
        for ((entry, Normal { mean, scale }), weight) in entries.iter().zip(normal).zip(weights) {
            // A normalised token is (value - mean) * scale, so the scale goes into the weight.
            let mut share = *weight;
            share
                .iter_mut()
                .zip(scale)
                .for_each(|(share, scale)| *share *= scale);
            for (sums, row) in out.chunks_exact_mut(self.of.cells).zip(self.rows(entry)) {
                for (((sum, value), mean), share) in sums[cells.clone()]
                    .iter_mut()
                    .zip(row)
                    .zip(mean)
                    .zip(&share)
                {
                    *sum += share * (value - mean);
                }
            }
        }
    }
}
