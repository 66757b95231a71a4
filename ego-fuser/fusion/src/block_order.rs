//! Token order: the cells of a feature map, ordered so that every window is one contiguous run.
//!
//! Square windows whose edges divide one another nest: a window of 16 cells holds four of 8, each of those four of 4.
//! When the tokens of each window are contiguous at every level, partitioning a feature map into windows of any of the
//! edges is a view; attention over windows of several sizes then copies the feature map twice in all, on the way in and
//! on the way out.

use tch::{TchError, Tensor};

/// An order of the cells of a feature map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlockOrder {
    /// Edges of the windows in cells, each dividing the next.
    edges: Vec<i64>,
}

impl BlockOrder {
    /// The order for windows of these edges; `None` when some edge does not divide the next larger one.
    pub fn new(edges: &[i64]) -> Option<Self> {
        let mut edges = edges.to_vec();
        edges.sort_unstable();
        edges.dedup();
        let nests = edges.first().is_some_and(|&first| first > 0)
            && edges.windows(2).all(|pair| pair[1] % pair[0] == 0);
        nests.then_some(Self { edges })
    }

    /// Edge of the largest window, cells.
    pub fn largest(&self) -> i64 {
        self.edges[self.edges.len() - 1]
    }

    /// `[N, C, H, W]` to tokens `[N, H * W, C]`. H and W are multiples of the largest edge.
    ///
    /// # Errors
    /// [`TchError`] when they are not.
    pub fn tokens(&self, maps: &Tensor) -> Result<Tensor, TchError> {
        let (count, channels, height, width) = maps.size4()?;
        let levels = self.edges.len() as i64 + 1;
        let sizes = [self.split(height), self.split(width)].concat();
        let shape = [&[count][..], &sizes, &[channels]].concat();
        // Row and column of a level side by side, the largest windows first: then each window is one run.
        let by_level = (0..levels).flat_map(|level| [1 + level, 1 + levels + level]);
        let order = [0].into_iter().chain(by_level).chain([2 * levels + 1]);
        let channels_last = maps.f_permute([0, 2, 3, 1])?.f_contiguous()?;
        channels_last
            .f_view(shape.as_slice())?
            .f_permute(order.collect::<Vec<i64>>())?
            .f_reshape([count, height * width, channels])
    }

    /// Tokens `[N, H * W, C]` back to `[N, C, H, W]`.
    ///
    /// # Errors
    /// [`TchError`] when there are not as many as cells.
    pub fn maps(&self, tokens: &Tensor, height: i64, width: i64) -> Result<Tensor, TchError> {
        let (count, _, channels) = tokens.size3()?;
        let (rows, columns) = (self.split(height), self.split(width));
        let last = 2 * rows.len() as i64 + 1;
        let sizes = (0..rows.len()).flat_map(|level| [rows[level], columns[level]]);
        let shape: Vec<i64> = [count].into_iter().chain(sizes).chain([channels]).collect();
        // The inverse: the rows of all levels, which are the odd dimensions, then the columns of all levels.
        let halves = (1..last).step_by(2).chain((2..last).step_by(2));
        let order: Vec<i64> = [0].into_iter().chain(halves).chain([last]).collect();
        let channels_last = tokens.f_view(shape.as_slice())?.f_permute(order)?;
        channels_last
            .f_reshape([count, height, width, channels])?
            .f_permute([0, 3, 1, 2])?
            .f_contiguous()
    }

    /// Row and column of each token within a window of `edge`, in the order of tokens.
    pub fn places(&self, edge: i64) -> Vec<[i64; 2]> {
        let mut places = vec![[0, 0]];
        let mut covered = 1;
        // Each level repeats the order inside the smaller window at every corner of the larger one.
        for &level in self.edges.iter().filter(|&&level| level <= edge) {
            let steps = level / covered;
            let corners = (0..steps)
                .flat_map(|row| (0..steps).map(move |column| [row * covered, column * covered]));
            places = corners
                .flat_map(|[row, column]| places.iter().map(move |[y, x]| [row + y, column + x]))
                .collect();
            covered = level;
        }
        places
    }

    /// A length cut into the numbers of windows at each level, the largest windows first.
    fn split(&self, length: i64) -> Vec<i64> {
        let mut sizes = vec![length / self.largest()];
        sizes.extend(self.edges.windows(2).rev().map(|pair| pair[1] / pair[0]));
        sizes.push(self.edges[0]);
        sizes
    }
}

#[cfg(test)]
mod tests {
    use tch::{Device, Kind};

    use super::*;

    #[test]
    fn edges_must_nest() {
        assert!(BlockOrder::new(&[4, 8, 16]).is_some_and(|order| order.largest() == 16));
        assert!(BlockOrder::new(&[16, 4]).is_some());
        assert_eq!(BlockOrder::new(&[4, 6]), None);
        assert_eq!(BlockOrder::new(&[]), None);
        assert_eq!(BlockOrder::new(&[0, 4]), None);
    }

    #[test]
    fn each_window_is_a_run_of_tokens_in_the_order_of_places() {
        let order = BlockOrder::new(&[2, 4, 12]).unwrap();
        let (height, width) = (24, 36);
        let map =
            Tensor::arange(height * width, (Kind::Int64, Device::Cpu)).view([1, 1, height, width]);
        let tokens = order.tokens(&map).unwrap();
        let flat = Vec::<i64>::try_from(tokens.view(-1)).unwrap();
        for edge in [2, 4, 12] {
            let places = order.places(edge);
            for window in flat.chunks((edge * edge) as usize) {
                let [first_row, first_column] = [window[0] / width, window[0] % width];
                assert_eq!(
                    [first_row % edge, first_column % edge],
                    [0, 0],
                    "a window of {edge}"
                );
                let found: Vec<_> = window
                    .iter()
                    .map(|cell| [cell / width - first_row, cell % width - first_column])
                    .collect();
                assert_eq!(found, places, "a window of {edge}");
            }
        }
        assert_eq!(order.maps(&tokens, height, width).unwrap(), map);
        assert!(
            order
                .tokens(&Tensor::zeros([1, 1, 24, 35], (Kind::Float, Device::Cpu)))
                .is_err()
        );
    }
}
