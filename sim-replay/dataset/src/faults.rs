//! Faults of one file's rows: counted, and reported in one line that names the first.

use super::{ReadError, Result};

/// Rows that were left out of one file.
#[derive(Debug, Default)]
pub(super) struct Faults {
    first: Option<ReadError>,
    count: usize,
}

impl Faults {
    pub(super) fn push(&mut self, fault: ReadError) {
        self.count += 1;
        self.first.get_or_insert(fault);
    }

    /// The value, or `None` and a fault.
    pub(super) fn take<T>(&mut self, result: Result<T>) -> Option<T> {
        result.map_err(|fault| self.push(fault)).ok()
    }

    /// Reports the first fault, with the number of `unit`s (`row`, `scan`) left out.
    pub(super) fn report(self, unit: &str, problems: &mut Vec<ReadError>) {
        let consequence = match self.count {
            1 => format!("the {unit} is left out"),
            count => format!("{count} {unit}s are left out, this is the first"),
        };
        problems.extend(self.first.map(|fault| fault.with_consequence(&consequence)));
    }
}
