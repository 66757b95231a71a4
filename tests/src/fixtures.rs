//! Test fixtures: golden archives of the project and sample data outside it.
//!
//! Golden archives are in `tests/golden`, or in `V2V_GOLDEN`. Sample data may not be redistributed: tests that need it
//! are `#[ignore]`d, and read it from the folder that `V2V_DATA` names. A missing fixture fails the test with its path. A
//! missing tensor or an unexpected type fails with the names in the message.
//!
//! ```
//! let golden = tests::fixtures::golden("c5_poses");
//! let (shape, poses) = golden.f64("in.poses");
//! assert_eq!(shape[1], 6);
//! assert_eq!(poses.len(), shape[0] * 6);
//! ```

use std::path::{Path, PathBuf};

use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// A golden archive in memory.
#[derive(Debug)]
pub struct Golden {
    name: String,
    bytes: Vec<u8>,
    config: Value,
}

/// The golden archive `<name>.safetensors`.
///
/// # Panics
/// When it is missing or damaged, with its path.
#[must_use]
pub fn golden(name: &str) -> Golden {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("golden");
    let path = fixture("V2V_GOLDEN", Some(folder), &format!("{name}.safetensors"));
    let bytes = std::fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let (_, header) = SafeTensors::read_metadata(&bytes)
        .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let text = header
        .metadata()
        .as_ref()
        .and_then(|metadata| metadata.get("config"));
    let config = text.map_or(Value::Null, |text| {
        serde_json::from_str(text)
            .unwrap_or_else(|error| panic!("{}: config: {error}", path.display()))
    });
    Golden {
        name: name.to_owned(),
        bytes,
        config,
    }
}

/// The sample folder or file `name`, for example `v2xset-scene`.
///
/// # Panics
/// When it is missing, with its path, or `V2V_DATA` is not set.
#[must_use]
pub fn data(name: &str) -> PathBuf {
    fixture("V2V_DATA", None, name)
}

/// Path of `name` in the folder of the environment variable, else in `default`.
fn fixture(variable: &str, default: Option<PathBuf>, name: &str) -> PathBuf {
    let root = std::env::var_os(variable).map(PathBuf::from).or(default);
    let root =
        root.unwrap_or_else(|| panic!("{variable} names no folder, which has to have {name}"));
    let path = root.join(name);
    assert!(
        path.exists(),
        "{} does not exist; {variable} names another folder",
        path.display()
    );
    path
}

impl Golden {
    /// The configuration the archive was made with.
    #[must_use]
    pub fn config(&self) -> &Value {
        &self.config
    }

    /// Names of all tensors, sorted.
    #[must_use]
    pub fn names(&self) -> Vec<String> {
        let tensors = self.tensors();
        let mut names: Vec<String> = tensors
            .names()
            .into_iter()
            .map(ToString::to_string)
            .collect();
        names.sort();
        names
    }

    /// True if there is a tensor of this name.
    #[must_use]
    pub fn has(&self, name: &str) -> bool {
        self.tensors().tensor(name).is_ok()
    }

    /// The whole archive, for readers that take bytes.
    #[must_use]
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Shape and values of an `f32` tensor.
    #[must_use]
    pub fn f32(&self, name: &str) -> (Vec<usize>, Vec<f32>) {
        self.values(name, Dtype::F32, f32::from_le_bytes)
    }

    /// Shape and values of an `f64` tensor.
    #[must_use]
    pub fn f64(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        self.values(name, Dtype::F64, f64::from_le_bytes)
    }

    /// Shape and values of an `i64` tensor.
    #[must_use]
    pub fn i64(&self, name: &str) -> (Vec<usize>, Vec<i64>) {
        self.values(name, Dtype::I64, i64::from_le_bytes)
    }

    /// Shape and values of an `i32` tensor.
    #[must_use]
    pub fn i32(&self, name: &str) -> (Vec<usize>, Vec<i32>) {
        self.values(name, Dtype::I32, i32::from_le_bytes)
    }

    /// Shape and values of a `u8` tensor; booleans are stored as these.
    #[must_use]
    pub fn u8(&self, name: &str) -> (Vec<usize>, Vec<u8>) {
        self.values(name, Dtype::U8, |[byte]| byte)
    }

    fn tensors(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.bytes)
            .unwrap_or_else(|error| panic!("{}: {error}", self.name))
    }

    fn values<T, const N: usize>(
        &self,
        name: &str,
        dtype: Dtype,
        from: fn([u8; N]) -> T,
    ) -> (Vec<usize>, Vec<T>) {
        let tensors = self.tensors();
        let tensor = tensors
            .tensor(name)
            .unwrap_or_else(|error| panic!("{}: {name}: {error}", self.name));
        assert_eq!(tensor.dtype(), dtype, "{}: {name}", self.name);
        let (chunks, rest) = tensor.data().as_chunks::<N>();
        assert!(
            rest.is_empty(),
            "{}: {name}: {} stray bytes",
            self.name,
            rest.len()
        );
        (
            tensor.shape().to_vec(),
            chunks.iter().map(|&bytes| from(bytes)).collect(),
        )
    }
}

/// Fails at the first value with `|a - b| > atol + rtol * |b|`, naming its index and the largest difference.
///
/// # Panics
/// When lengths differ or a value is off.
pub fn assert_close<T: Into<f64> + Copy>(
    what: &str,
    actual: &[T],
    expected: &[T],
    atol: f64,
    rtol: f64,
) {
    assert_eq!(actual.len(), expected.len(), "{what}: number of values");
    let differences = actual.iter().zip(expected).map(|(&a, &b)| {
        let (a, b): (f64, f64) = (a.into(), b.into());
        ((a - b).abs(), atol + rtol * b.abs(), a, b)
    });
    let mut largest = 0.0_f64;
    let mut first_off = None;
    for (index, (difference, allowed, a, b)) in differences.enumerate() {
        // A NaN is neither below nor above the bound: the condition is on valid values.
        let close = difference <= allowed;
        if !close && first_off.is_none() {
            first_off = Some((index, a, b));
        }
        largest = largest.max(difference);
    }
    if let Some((index, a, b)) = first_off {
        panic!(
            "{what}[{index}]: {a} is not {b} (atol {atol}, rtol {rtol}); largest difference {largest:.3e}"
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn close_is_symmetric_about_the_bound() {
        assert_close("x", &[1.0f32, 2.0], &[1.05, 1.95], 0.06, 0.0);
    }

    #[test]
    #[should_panic(expected = "x[1]: 2 is not 3")]
    fn far_names_the_value() {
        assert_close("x", &[1.0f64, 2.0], &[1.0, 3.0], 0.1, 0.0);
    }

    #[test]
    #[should_panic(expected = "x[0]: NaN is not 1")]
    fn not_a_number_is_never_close() {
        assert_close("x", &[f64::NAN], &[1.0], 0.1, 0.0);
    }
}
