//! Number of points that a header states.

use super::super::PcdError;
use super::Entries;

/// Limit on the number of points, above that of any sweep; a header that states more is invalid.
const MAX_POINTS: u64 = 10_000_000;

impl Entries<'_> {
    /// `POINTS`, or `WIDTH` times `HEIGHT`: the values present must be consistent, and one of `POINTS` and `WIDTH` is
    /// required.
    pub(super) fn points(&self) -> Result<usize, PcdError> {
        let width = self.count("WIDTH")?;
        let height = self.count("HEIGHT")?.map(|(_, height)| height);
        let (key, line, count) = match (width, self.count("POINTS")?) {
            (width, Some((line, points))) => {
                if let Some((_, width)) = width {
                    check_product(width, height, line, points)?;
                }
                ("POINTS", line, points)
            }
            (Some((line, width)), None) => {
                ("WIDTH", line, width.saturating_mul(height.unwrap_or(1)))
            }
            (None, None) => {
                let reason = "missing in the header, and WIDTH too";
                return Err(PcdError::of("POINTS", reason));
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
        let Some(entry) = self.find(key) else {
            return Ok(None);
        };
        let value = entry.single()?;
        let number = value.parse();
        let number = number.map_err(|_| entry.error(format!("{value:?} is no count")))?;
        Ok(Some((entry.line, number)))
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
