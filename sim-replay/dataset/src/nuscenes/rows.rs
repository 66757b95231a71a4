//! Rows of the tables of nuScenes: reading a table, references between tables, transforms.

use std::collections::HashMap;
use std::path::Path;

use nalgebra::Isometry3;
use protocol::Pose;
use protocol::text::excerpt;

use crate::json::JsonField;
use crate::{ReadError, Result, json_table, poses};

/// Largest table that is read, bytes. `sample_data.json` of nuScenes' `v1.0-trainval` has about 1.2 GB.
pub(super) const MAX_BYTES: u64 = 4 << 30;

/// Indices of rows by their tokens.
pub(super) type Indices = HashMap<String, usize>;

/// Reads all rows of a table.
pub(super) fn read_all(
    version: &Path,
    name: &str,
    problems: &mut Vec<ReadError>,
    row: impl FnMut(&JsonField<'_>) -> Result<()>,
) -> Result<usize> {
    json_table::read_all(&version.join(name), MAX_BYTES, problems, row)
}

/// The index of the row that a token refers to.
pub(super) fn referred(row: &JsonField<'_>, key: &str, indices: &Indices) -> Result<usize> {
    let token = row.required(key)?;
    let text = token.id()?;
    let index = indices.get(&text).copied();
    index.ok_or_else(|| token.error(format!("no row has the token {:?}", excerpt(&text, 40))))
}

/// `translation` in metres and `rotation` as quaternion w, x, y, z.
pub(super) fn transform(row: &JsonField<'_>) -> Result<Isometry3<f64>> {
    let translation_m = row.required("translation")?.numbers::<3>()?;
    let pose = Pose {
        translation_m,
        rotation_wxyz: row.required("rotation")?.numbers::<4>()?,
    };
    poses::of_rounded(&pose).map_err(|reason| row.error(reason))
}
