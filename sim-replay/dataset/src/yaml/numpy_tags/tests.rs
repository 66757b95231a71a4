use std::path::Path;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use proptest::prelude::*;

use super::*;
use crate::yaml;

/// A 4x4 matrix as V2V4Real has it, under `lidar_pose`, with the dtype anchored as `id002`.
pub(crate) fn pickled_matrix(values: &[f64; 16]) -> String {
    let bytes: Vec<u8> = values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let data = STANDARD.encode(bytes);
    let (first, second) = data.split_at(76);
    let (before, _) = MATRIX.trim_end().rsplit_once("!!binary |").unwrap();
    format!("{before}!!binary |\n    {first}\n    {second}\n")
}

/// An array of doubles as PyYAML writes it, to stand behind `key: `; `indent` is that of the key and two more.
pub(crate) fn pickled_array(shape: &[usize], values: &[f64], indent: &str) -> String {
    let data = STANDARD.encode(
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect::<Vec<u8>>(),
    );
    format!(
        "!!python/object/apply:numpy.core.multiarray._reconstruct\n\
         {indent}args:\n{indent}- !!python/name:numpy.ndarray ''\n{indent}- !!python/tuple [0]\n{indent}- !!binary |\n\
         {indent}  Yg==\n{indent}state: !!python/tuple\n{indent}- 1\n{indent}- !!python/tuple {shape:?}\n\
         {indent}- {}\n{indent}- false\n{indent}- !!binary |\n{indent}  {data}\n",
        dtype("f8", "<")
    )
}

fn dtype(name: &str, order: &str) -> String {
    format!(
        "!!python/object/apply:numpy.dtype {{args: [{name}, false, true], \
         state: !!python/tuple [3, '{order}', null, null, null, -1, -1, 0]}}"
    )
}

/// A scalar as PyYAML writes it.
pub(crate) fn pickled_scalar(name: &str, order: &str, bytes: &[u8]) -> String {
    let data = STANDARD.encode(bytes);
    format!(
        "!!python/object/apply:numpy.core.multiarray.scalar [{}, !!binary {data}]",
        dtype(name, order)
    )
}

/// As written by Python.
const MATRIX: &str = include_str!("numpy_matrix.yaml");

const NUMBERS: [f64; 16] = [
    0.0, -1.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 1e-300,
];

fn with_field<T>(text: &str, key: &str, read: impl Fn(&YamlField<'_>) -> Result<T>) -> Result<T> {
    let path = Path::new("000000.yaml");
    let node = yaml::parse(path, text.as_bytes())?;
    read(&YamlField::root(path, &node).required(key)?)
}

fn read(text: &str) -> Result<NumpyArray> {
    with_field(text, "lidar_pose", array)
}

#[test]
fn a_pickled_matrix_is_read_and_so_are_aliases() {
    let text = pickled_matrix(&NUMBERS)
        + "true_ego_pos: *id003\nlon: !!python/object/apply:numpy.core.multiarray.scalar\n- *id002\n- !!binary |\n  AAAAAAAA+D8=\n";
    let expected = (vec![4, 4], NUMBERS.to_vec());
    assert_eq!(read(&text).unwrap(), expected);
    assert_eq!(with_field(&text, "true_ego_pos", array).unwrap(), expected);
    assert_eq!(
        with_field(&text, "lon", |field| field.number()).unwrap(),
        1.5
    );
    for not_finite in [f64::NAN, f64::INFINITY] {
        let text = text.replace("AAAAAAAA+D8=", &STANDARD.encode(not_finite.to_le_bytes()));
        let error = with_field(&text, "lon", |field| field.number())
            .unwrap_err()
            .to_string();
        assert!(
            error.contains("lon") && error.contains("expected a finite number"),
            "{error}"
        );
    }
}

#[test]
fn newer_numpy_has_another_module() {
    assert!(read(&pickled_matrix(&NUMBERS).replace("numpy.core.", "numpy._core.")).is_ok());
}

#[test]
fn fortran_order_is_turned() {
    let text =
        pickled_matrix(&NUMBERS).replace("  - false\n  - !!binary", "  - true\n  - !!binary");
    let (_, values) = read(&text).unwrap();
    assert_eq!(
        (values[1], values[4], values[15]),
        (NUMBERS[4], NUMBERS[1], NUMBERS[15])
    );
    assert_eq!(
        row_major(&[2, 3], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0]),
        [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]
    );
}

#[test]
fn buffers_are_read_in_either_form() {
    let data = STANDARD.encode([1.5f32, -2.0].map(f32::to_be_bytes).concat());
    for buffer in [
        format!("!!binary {data}"),
        format!("!!python/object/apply:builtins.bytearray [!!binary {data}]"),
    ] {
        let text = format!(
            "a: !!python/object/apply:numpy._core.numeric._frombuffer [{buffer}, {}, !!python/tuple [2], C]\n",
            dtype("f4", ">")
        );
        assert_eq!(
            with_field(&text, "a", |field| field.numbers::<2>()).unwrap(),
            [1.5, -2.0]
        );
    }
}

#[test]
fn scalars_and_arrays_stand_wherever_numbers_do() {
    let three = pickled_scalar("i8", "<", &3i64.to_le_bytes());
    let half = pickled_scalar("f2", "<", &0x3800u16.to_le_bytes());
    let text = format!(
        "a: {three}\nb: [{half}, {three}]\nc: {}",
        pickled_array(&[2, 1], &[1.0, 2.0], "  ")
    ) + &format!(
        "d: !!python/tuple [1, {half}]\ne: {}",
        pickled_array(&[], &[7.0], "  ")
    ) + &format!("f: {{? {three}\n : 5}}\n");
    assert_eq!(with_field(&text, "a", |field| field.integer()).unwrap(), 3);
    assert_eq!(
        with_field(&text, "b", |field| field.numbers::<2>()).unwrap(),
        [0.5, 3.0]
    );
    assert_eq!(
        with_field(&text, "c", |field| field.numbers::<2>()).unwrap(),
        [1.0, 2.0]
    );
    assert_eq!(
        with_field(&text, "d", |field| field.numbers::<2>()).unwrap(),
        [1.0, 0.5]
    );
    assert_eq!(with_field(&text, "e", |field| field.number()).unwrap(), 7.0);
    assert_eq!(
        with_field(&text, "f", |field| field.required("3")?.integer()).unwrap(),
        5,
        "an id as key"
    );
    let error = with_field(&text, "c", |field| field.numbers::<3>())
        .unwrap_err()
        .to_string();
    assert!(
        error.ends_with("c: an array of shape [2, 1], expected [3]"),
        "{error}"
    );
}

#[test]
fn anything_else_is_an_error_that_names_the_field() {
    let cases = [
        (
            "numpy.core.multiarray._reconstruct",
            "os.system",
            "is not supported",
        ),
        (
            "python/name:numpy.ndarray",
            "python/name:subprocess.Popen",
            "expected !!python/name:numpy.ndarray",
        ),
        ("    Yg==", "    Yw==", "expected the code b"),
        ("- f8", "- O8", "dtype \"O8\", expected f2 to f8"),
        ("- <", "- '!'", "byte order \"!\""),
        (
            "    - 4\n    - 4\n",
            "    - 4\n    - 5\n",
            "128 bytes for 20 numbers of 8 bytes",
        ),
        (
            "    - 4\n    - 4\n",
            "    - 4000000000\n    - 4000000000\n",
            "is larger than 4096 numbers",
        ),
        (
            "    - 4\n    - 4\n",
            "    - -4\n    - -4\n",
            "a shape is not negative",
        ),
        (
            "  - false\n  - !!binary",
            "  - maybe\n  - !!binary",
            "Fortran order",
        ),
        (
            "  state: !!python/tuple\n  - 1",
            "  state: !!python/tuple\n  - 2",
            "pickle version 2, expected 1",
        ),
    ];
    for (from, to, expected) in cases {
        let text = pickled_matrix(&NUMBERS).replacen(from, to, 1);
        let message = read(&text).unwrap_err().to_string();
        assert!(
            message.contains(expected) && message.contains("lidar_pose"),
            "{message}"
        );
    }
}

proptest! {
    #[test]
    fn damage_never_panics(at in any::<prop::sample::Index>(), byte in 0x20..0x7fu8) {
        let mut text = pickled_matrix(&NUMBERS).into_bytes();
        let at = at.index(text.len());
        text[at] = byte;
        let _ = read(std::str::from_utf8(&text).unwrap());
    }
}
