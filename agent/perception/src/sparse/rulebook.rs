//! Rulebook of a sparse convolution: input row of each weight and output row.

use tch::{Device, TchError, Tensor};

use super::sites::Sites;

/// Number of weights of a 3x3x3 kernel.
pub const KERNEL_VOLUME: usize = 27;
/// Mark of a neighbour that does not exist.
const NONE: u32 = u32::MAX;

/// Neighbours of every output site of a 3x3x3 convolution.
///
/// Offset `k` of `[-1, 1]^3` is `9 (x + 1) + 3 (y + 1) + (z + 1)`: the order of a dense `[3, 3, 3]` kernel over x, y,
/// z.
#[derive(Debug, Clone, PartialEq)]
pub struct Rulebook {
    inputs: usize,
    /// `[outputs, 27]`: input rows.
    rows: Vec<u32>,
}

impl Rulebook {
    /// Stride 1: output sites are the input sites.
    pub fn submanifold(sites: &Sites) -> Self {
        let inputs = sites.len();
        let mut rows = vec![NONE; inputs * KERNEL_VOLUME];
        for (row, &[x, y, z]) in sites.coords().iter().enumerate() {
            rows[row * KERNEL_VOLUME + KERNEL_VOLUME / 2] = row as u32;
            // If b is the neighbour of a at offset k, a is that of b at 26 - k, so half of the kernel is looked up.
            for k in KERNEL_VOLUME / 2 + 1..KERNEL_VOLUME {
                let [dx, dy, dz] = offset(k);
                if let Some(other) = sites.row([x + dx, y + dy, z + dz]) {
                    rows[row * KERNEL_VOLUME + k] = other;
                    rows[other as usize * KERNEL_VOLUME + KERNEL_VOLUME - 1 - k] = row as u32;
                }
            }
        }
        Self { inputs, rows }
    }

    /// Stride 2, from the sites of a level to those of the next: output `o` has the inputs `2 o + [-1, 1]^3`.
    pub fn strided(sites: &Sites, halved: &Sites) -> Self {
        let mut rows = vec![NONE; halved.len() * KERNEL_VOLUME];
        for (row, coord) in sites.coords().iter().enumerate() {
            // An even coordinate is the centre of one output; an odd one lies between two.
            // The shift rounds negative coordinates down, too, unlike a division.
            let choices = coord.map(|axis| match axis & 1 {
                0 => [Some((axis >> 1, 0)), None],
                _ => [Some((axis >> 1, 1)), Some(((axis >> 1) + 1, -1))],
            });
            for (x, dx) in choices[0].into_iter().flatten() {
                for (y, dy) in choices[1].into_iter().flatten() {
                    for (z, dz) in choices[2].into_iter().flatten() {
                        if let Some(output) = halved.row([x, y, z]) {
                            rows[output as usize * KERNEL_VOLUME + index([dx, dy, dz])] =
                                row as u32;
                        }
                    }
                }
            }
        }
        let inputs = sites.len();
        Self { inputs, rows }
    }

    /// Number of output rows.
    pub fn outputs(&self) -> usize {
        self.rows.len() / KERNEL_VOLUME
    }

    /// The rulebooks of several sweeps as one, their rows one after another, as a tensor.
    ///
    /// # Errors
    /// Those of the tensor library.
    pub fn stacked<'a>(
        rulebooks: impl IntoIterator<Item = &'a Self>,
        device: Device,
    ) -> Result<GatherIndex, TchError> {
        let rulebooks: Vec<&Self> = rulebooks.into_iter().collect();
        let inputs: usize = rulebooks.iter().map(|book| book.inputs).sum();
        let mut index = Vec::with_capacity(rulebooks.iter().map(|book| book.rows.len()).sum());
        let mut first = 0;
        for book in rulebooks {
            index.extend(book.rows.iter().map(|&row| match row {
                // One beyond the last input: the row of zeros that `gather` appends.
                NONE => inputs as i64,
                _ => first + i64::from(row),
            }));
            first += book.inputs as i64;
        }
        Ok(GatherIndex {
            inputs: inputs as i64,
            rows: Tensor::f_from_slice(&index)?.f_to_device(device)?,
        })
    }
}

/// A rulebook as tensor on its device.
#[derive(Debug)]
pub struct GatherIndex {
    /// Number of input rows; also the mark of a missing neighbour.
    inputs: i64,
    /// `[outputs * 27]` of input rows, `i64`.
    rows: Tensor,
}

impl GatherIndex {
    /// The neighbours of every output, `[N_out * 27, C]`, of features `[N_in, C]`: zeros where there is none.
    ///
    /// # Errors
    /// [`TchError::Shape`] when the rows are not those of the rulebook.
    pub(super) fn gather(&self, x: &Tensor) -> Result<Tensor, TchError> {
        let (found, channels) = x.size2()?;
        if found != self.inputs {
            return Err(TchError::Shape(format!(
                "{found} rows of features, the rulebook is of {}",
                self.inputs
            )));
        }
        // A row of zeros stands for all missing neighbours.
        let zeros = x.f_new_zeros([1, channels], (x.kind(), x.device()))?;
        let padded = Tensor::f_cat(&[x, &zeros], 0)?;
        rows(&padded, &self.rows)
    }
}

/// Rows `[M, C]` of `x` `[N, C]` by an index `[M]`.
///
/// # Errors
/// Those of the tensor library, for example when a row does not exist.
pub fn rows(x: &Tensor, index: &Tensor) -> Result<Tensor, TchError> {
    // With an index that is expanded and not materialised, gather and its gradient copy whole rows.
    let index = index.f_unsqueeze(1)?.f_expand([-1, x.size()[1]], false)?;
    x.f_gather(0, &index, false)
}

fn offset(k: usize) -> [i32; 3] {
    [k / 9, k / 3 % 3, k % 3].map(|axis| axis as i32 - 1)
}

fn index([dx, dy, dz]: [i32; 3]) -> usize {
    (9 * (dx + 1) + 3 * (dy + 1) + dz + 1) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Number of pairs of input and output, of all weights together.
    fn pairs(book: &Rulebook) -> usize {
        book.rows.iter().filter(|&&row| row != NONE).count()
    }

    #[test]
    fn offsets_and_indices_agree() {
        assert!((0..KERNEL_VOLUME).all(|k| index(offset(k)) == k));
    }

    #[test]
    fn two_neighbours_are_inputs_of_each_other() {
        let book = Rulebook::submanifold(&Sites::collect([[0, 0, 0], [0, 0, 1], [5, 5, 5]]).0);
        assert_eq!((book.inputs, book.outputs(), pairs(&book)), (3, 3, 5));
        assert_eq!(book.rows[index([0, 0, 1])], 1);
        assert_eq!(book.rows[KERNEL_VOLUME + index([0, 0, -1])], 0);
    }

    #[test]
    fn an_odd_site_feeds_the_outputs_on_both_sides() {
        let (sites, _) = Sites::collect([[1, 0, 0], [2, 0, 0]]);
        let (halved, _) = sites.halved();
        assert_eq!(halved.coords(), [[0, 0, 0], [1, 0, 0]]);
        let book = Rulebook::strided(&sites, &halved);
        assert_eq!(book.rows[index([1, 0, 0])], 0);
        assert_eq!(book.rows[KERNEL_VOLUME + index([-1, 0, 0])], 0);
        assert_eq!(book.rows[KERNEL_VOLUME + index([0, 0, 0])], 1);
        assert_eq!(pairs(&book), 3);
    }
}
