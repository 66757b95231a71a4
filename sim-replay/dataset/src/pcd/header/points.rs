//! Number of points that a header states.

use super::super::PcdError;
use super::Entries;

/// Limit on the number of points, above that of any sweep; a header that states more is invalid.
const MAX_POINTS: u64 = 10_000_000;

impl Entries<'_> {
    /// `POINTS`, or `WIDTH` times `HEIGHT`: the values present must be consistent, and one of `POINTS` and `WIDTH` is
    /// required.
    pub(super) fn points(&self) -> Result<usize, PcdError> {
        let (width, height, points) = (
            self.count("WIDTH")?,
            self.count("HEIGHT")?,
            self.count("POINTS")?,
        );
        let (key, line, count) = match (width, points) {
            (Some((_, width)), Some((line, points))) => {
                check_product(width, height.map(|(_, height)| height), line, points)?;
                ("POINTS", line, points)
            }
            (None, Some((line, points))) => ("POINTS", line, points),
            (Some((line, width)), None) => (
                "WIDTH",
                line,
                width.saturating_mul(height.map_or(1, |(_, height)| height)),
            ),
            (None, None) => {
                return Err(PcdError::of(
                    "POINTS",
                    "missing in the header, and WIDTH too",
                ));
            }
        };
        if count > MAX_POINTS {
            let reason = format!("{count} points, at most {MAX_POINTS} are read");
            return Err(PcdError::at(line, key, reason));
        }
        usize::try_from(count)
            .map_err(|_| PcdError::at(line, key, format!("{count} do not fit this machine")))
    }

    fn count(&self, key: &str) -> Result<Option<(u64, u64)>, PcdError> {
        if !self.has(key) {
            return Ok(None);
        }
        let (line, value) = self.single(key)?;
        let number = value
            .parse()
            .map_err(|_| PcdError::at(line, key, format!("{value:?} is no count")))?;
        Ok(Some((line, number)))
    }
}

fn check_product(width: u64, height: Option<u64>, line: u64, points: u64) -> Result<(), PcdError> {
    let fits = match height {
        Some(height) => width.checked_mul(height) == Some(points),
        // As many rows as needed.
        None => points.checked_rem(width).unwrap_or(points) == 0,
    };
    if fits {
        return Ok(());
    }
    let height = height.map_or_else(
        || "of no HEIGHT".into(),
        |height| format!("x HEIGHT {height}"),
    );
    let reason = format!("{points}, which does not match WIDTH {width} {height}");
    Err(PcdError::at(line, "POINTS", reason))
}
