//! Optimal assignment: pairs rows and columns of a cost matrix with the lowest total cost.
//!
//! Successive shortest augmenting paths with dual prices (Jonker and Volgenant 1987): each row in turn is connected to a
//! free column along the cheapest path of reduced costs, which stay non-negative. Cubic time in the smaller side.

use nalgebra::DMatrix;

/// Pairs `(row, column)` of the lowest total cost, ordered by row: as many as the shorter side has.
///
/// Costs that are not finite give pairs of an unspecified total, never a panic; see [`of_allowed`] for pairs that must
/// not be made.
pub fn of_lowest_cost(costs: &DMatrix<f64>) -> Vec<(usize, usize)> {
    if costs.nrows() <= costs.ncols() {
        return AssignmentSolver::new(costs).solve();
    }
    let mut pairs = AssignmentSolver::new(&costs.transpose()).solve();
    for (column, row) in &mut pairs {
        std::mem::swap(column, row);
    }
    pairs.sort_unstable();
    pairs
}

/// As many allowed pairs as possible, and among these sets the one of the lowest total cost. `None` and costs that are
/// not finite are pairs that must not be made.
pub fn of_allowed(
    rows: usize,
    columns: usize,
    cost: impl Fn(usize, usize) -> Option<f64>,
) -> Vec<(usize, usize)> {
    let costs = DMatrix::from_fn(rows, columns, |row, column| {
        cost(row, column).filter(|cost| cost.is_finite())
    });
    let allowed = costs.iter().flatten();
    let largest = allowed.fold(0.0_f64, |largest, cost| largest.max(cost.abs()));
    // No saving among the other pairs makes up for one pair that is forbidden.
    let forbidden = (largest + 1.0) * (2 * rows.min(columns) + 1) as f64;
    let mut pairs = of_lowest_cost(&costs.map(|cost| cost.unwrap_or(forbidden)));
    pairs.retain(|&pair| costs[pair].is_some());
    pairs
}

/// State of the search over a matrix with at most as many rows as columns.
struct AssignmentSolver<'a> {
    costs: &'a DMatrix<f64>,
    row_price: Vec<f64>,
    column_price: Vec<f64>,
    row_of: Vec<Option<usize>>,
    column_of: Vec<Option<usize>>,
}

impl<'a> AssignmentSolver<'a> {
    fn new(costs: &'a DMatrix<f64>) -> Self {
        let (rows, columns) = costs.shape();
        Self {
            costs,
            row_price: vec![0.0; rows],
            column_price: vec![0.0; columns],
            row_of: vec![None; columns],
            column_of: vec![None; rows],
        }
    }

    fn solve(mut self) -> Vec<(usize, usize)> {
        for row in 0..self.costs.nrows() {
            self.connect(row);
        }
        let rows = self.column_of.into_iter().enumerate();
        let pairs = rows.filter_map(|(row, column)| Some((row, column?)));
        pairs.collect()
    }

    /// Connects a free row, with other columns for other rows where that is cheaper.
    fn connect(&mut self, free_row: usize) {
        let columns = self.costs.ncols();
        // Cheapest paths from the free row to the columns.
        let mut path_cost = vec![f64::INFINITY; columns];
        let mut from_row = vec![free_row; columns];
        let mut is_final = vec![false; columns];
        // Step: cheapest path to a free column, by Dijkstra's algorithm on the reduced costs.
        let (mut row, mut reached) = (free_row, 0.0);
        let end = loop {
            // Extends the paths by the edges of the row; finds the cheapest column that is not final.
            let (mut nearest, mut lowest) = (None, f64::INFINITY);
            for column in (0..columns).filter(|&column| !is_final[column]) {
                let reduced =
                    self.costs[(row, column)] - self.row_price[row] - self.column_price[column];
                if reached + reduced < path_cost[column] {
                    path_cost[column] = reached + reduced;
                    from_row[column] = row;
                }
                if path_cost[column] < lowest {
                    (nearest, lowest) = (Some(column), path_cost[column]);
                }
            }
            // Only costs that are not finite reach no column.
            let Some(nearest) = nearest else { return };
            reached = lowest;
            is_final[nearest] = true;
            match self.row_of[nearest] {
                Some(owner) => row = owner,
                None => break nearest,
            }
        };
        // Step: prices that keep reduced costs non-negative and those of pairs at zero.
        self.row_price[free_row] += reached;
        for column in (0..columns).filter(|&column| is_final[column]) {
            if let Some(owner) = self.row_of[column] {
                self.row_price[owner] += reached - path_cost[column];
                self.column_price[column] -= reached - path_cost[column];
            }
        }
        // Step: back along the path, each row gives up its column for the next one.
        let mut next = Some(end);
        while let Some(column) = next {
            let row = from_row[column];
            self.row_of[column] = Some(row);
            next = self.column_of[row].replace(column);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_gives_its_column_up_where_the_total_gets_lower() {
        let costs = DMatrix::from_row_slice(2, 2, &[1.0, 2.0, 1.0, 9.0]);
        assert_eq!(of_lowest_cost(&costs), [(0, 1), (1, 0)]);
        let tall = DMatrix::from_row_slice(3, 1, &[5.0, -4.0, 3.0]);
        assert_eq!(of_lowest_cost(&tall), [(1, 0)]);
        assert_eq!(of_lowest_cost(&DMatrix::zeros(0, 3)), []);
        assert_eq!(of_lowest_cost(&DMatrix::zeros(2, 0)), []);
    }

    #[test]
    fn more_pairs_come_before_lower_costs_and_forbidden_pairs_are_never_made() {
        // Row 1 may have column 0 only.
        let cost =
            |row: usize, column: usize| [[Some(0.1), Some(1.9)], [Some(1.8), None]][row][column];
        assert_eq!(of_allowed(2, 2, cost), [(0, 1), (1, 0)]);
        assert_eq!(of_allowed(2, 2, |_, _| None), []);
        assert_eq!(
            of_allowed(1, 2, |_, column| [Some(f64::NAN), Some(3.0)][column]),
            [(0, 1)]
        );
    }

    #[test]
    fn costs_that_are_not_finite_do_not_panic() {
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, f64::MAX] {
            let costs = DMatrix::from_fn(
                4,
                5,
                |row, column| if (row + column) % 2 == 0 { bad } else { 1.0 },
            );
            let _ = of_lowest_cost(&costs);
        }
    }
}
