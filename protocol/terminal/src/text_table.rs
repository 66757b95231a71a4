//! Text table of one style: no borders, two spaces between columns, numbers to the right.

use std::fmt;

use comfy_table::{Table, presets};

/// Characters between two columns.
pub const GAP: u16 = 2;

/// Alignment of the cells of a column: texts to the left, numbers to the right.
pub use comfy_table::CellAlignment as Side;

/// A table for people, as lines that each end in a line end.
#[derive(Debug, Clone)]
pub struct TextTable(Table);

impl TextTable {
    /// A table with these columns.
    pub fn new<'a>(columns: impl IntoIterator<Item = (&'a str, Side)>) -> Self {
        let (names, sides): (Vec<&str>, Vec<Side>) = columns.into_iter().unzip();
        let mut table = Table::new();
        table.load_style(presets::NOTHING).set_header(names);
        for (column, side) in table.column_iter_mut().zip(sides) {
            column.set_padding((0, GAP));
            column.set_cell_alignment(side);
        }
        Self(table)
    }

    /// A table with columns of texts, then of numbers.
    pub fn of(texts: &[&str], numbers: &[&str]) -> Self {
        let texts = texts.iter().map(|name| (*name, Side::Left));
        Self::new(texts.chain(numbers.iter().map(|name| (*name, Side::Right))))
    }

    /// Appends a row.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.0.add_row(cells);
    }
}

impl fmt::Display for TextTable {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0
            .lines()
            .try_for_each(|line| writeln!(f, "{}", line.trim_end()))
    }
}

/// A number with this many decimals; a dash if it is unknown.
pub fn number(value: Option<f64>, digits: usize) -> String {
    value.map_or("-".into(), |value| format!("{value:.digits$}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_are_left_aligned_and_numbers_right_aligned() {
        let mut table = TextTable::new([
            ("name", Side::Left),
            ("size", Side::Right),
            ("note", Side::Left),
        ]);
        table.row(["a".to_owned(), "1.5".to_owned(), "largest".to_owned()]);
        table.row(["longer".to_owned(), "12345".to_owned(), String::new()]);
        assert_eq!(
            table.to_string(),
            "name     size  note\na         1.5  largest\nlonger  12345\n"
        );
    }
}
