//! YAML as a tree with lines and tags, so that errors give file, line and field.
//!
//! Tags are kept as text and never acted upon. The cost of a document is limited: its size, its depth, its nodes, and
//! the repetitions of its parts by aliases.
//!
//! Calls go one way. [`read`] lets [`tree`] build a [`node`], with [`scalar`] for what is not quoted. Readers of data
//! sets take a [`field`] of it, a node with its position; its [`numbers`] may be those of NumPy, which [`numpy_tags`]
//! reads.

mod field;
mod node;
mod numbers;
pub(super) mod numpy_tags;
mod scalar;
mod tree;

use std::path::Path;

pub(super) use field::YamlField;
pub(super) use node::{Value, YamlNode};
pub(super) use numbers::whole;

use super::{ReadError, Result, files};

/// Largest YAML file that is read, bytes. Frames with four cameras and fifty objects have about 20 kB.
const MAX_BYTES: u64 = 16 << 20;

/// Reads and parses a file.
pub(super) fn read(path: &Path) -> Result<YamlNode> {
    parse(path, &files::read_limited(path, MAX_BYTES)?)
}

/// Parses a document; `path` is for messages.
pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<YamlNode> {
    let malformed =
        |line: u64, reason: String| ReadError::malformed_at(path, Some(line), None, reason);
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let valid = bytes.iter().take(error.valid_up_to());
        let breaks = valid.filter(|&&byte| byte == b'\n').count();
        malformed(breaks as u64 + 1, "the text is not UTF-8".into())
    })?;
    tree::build(text).map_err(|(line, reason)| malformed(line, format!("no sound YAML: {reason}")))
}

#[cfg(test)]
mod tests {
    use std::fmt;

    use proptest::prelude::*;

    use super::*;

    fn parsed(text: &str) -> YamlNode {
        parse(Path::new("a.yaml"), text.as_bytes()).unwrap()
    }

    fn message(result: Result<impl fmt::Debug, ReadError>) -> String {
        result.unwrap_err().to_string()
    }

    #[test]
    fn numbers_come_in_every_spelling() {
        let node = parsed("a: [1, 2.5, 1e-06, 1.0e-06, -3, .5, '7', +8, 1., 0x10]");
        let field = YamlField::root(Path::new("a.yaml"), &node)
            .required("a")
            .unwrap();
        assert_eq!(
            field.numbers::<10>().unwrap(),
            [1.0, 2.5, 1e-6, 1e-6, -3.0, 0.5, 7.0, 8.0, 1.0, 16.0]
        );
    }

    #[test]
    fn integer_keys_unknown_keys_and_anchors() {
        let node = parsed(
            "vehicles:\n  4335: &a\n    speed: 1\n    color: 1, 2\n  4336: *a\nunknown: {x: [~]}\n",
        );
        let root = YamlField::root(Path::new("a.yaml"), &node);
        let vehicles = root.required("vehicles").unwrap().entries().unwrap();
        assert_eq!(
            vehicles.iter().map(|(key, _)| *key).collect::<Vec<_>>(),
            ["4335", "4336"]
        );
        assert_eq!(
            vehicles[1].1.required("speed").unwrap().number().unwrap(),
            1.0
        );
    }

    #[test]
    fn tags_are_text_and_binary_stays_base64() {
        let node = parsed(
            "a: !!python/tuple\n- 1\n- !!binary |\n  Yg==\n- !!python/name:numpy.ndarray ''\n",
        );
        let root = YamlField::root(Path::new("a.yaml"), &node);
        let tuple = root.required("a").unwrap();
        assert_eq!(tuple.node.tag.as_deref(), Some("python/tuple"));
        let items = tuple.items().unwrap();
        assert_eq!(items[1].text().unwrap().trim(), "Yg==");
        assert_eq!(
            items[2].node.tag.as_deref(),
            Some("python/name:numpy.ndarray")
        );
    }

    #[test]
    fn errors_name_file_line_and_field() {
        let node = parsed(
            "lidar_pose: [1, 2, 3]\nvehicles:\n  7:\n    extent:\n    - 1\n    - .nan\n    - x\n",
        );
        let root = YamlField::root(Path::new("a.yaml"), &node);
        let pose = root.required("lidar_pose").unwrap();
        assert_eq!(
            message(pose.numbers::<6>()),
            "a.yaml:1: lidar_pose: a list of 3, expected 6 numbers"
        );
        let car = root.required("vehicles").unwrap().required("7").unwrap();
        let extent = car.required("extent").unwrap();
        assert_eq!(
            message(extent.numbers::<3>()),
            "a.yaml:6: vehicles.7.extent.1: NaN, expected a finite number"
        );
        assert_eq!(
            message(car.required("angle")),
            "a.yaml:4: vehicles.7.angle: missing"
        );
        assert_eq!(
            message(root.required("vehicles").unwrap().number()),
            "a.yaml:3: vehicles: a map of 1, expected a finite number"
        );
    }

    #[test]
    fn broken_yaml_is_reported_with_line_and_reason_only() {
        let error = parse(Path::new("a.yaml"), b"a: 1\nb: [1, 2\nc: 3\n").unwrap_err();
        let line = crate::Problem::from(&error).line;
        assert!(line.is_some_and(|line| line > 1), "{error}");
        let text = error.to_string();
        assert!(
            text.starts_with("a.yaml:") && text.contains("no sound YAML: "),
            "{text}"
        );
        assert!(
            !text.contains("saphyr") && !text.contains("granit") && !text.contains('\n'),
            "{text}"
        );
        assert_eq!(
            message(parse(Path::new("a.yaml"), b"a: 1\nb: \xff\n")),
            "a.yaml:2: the text is not UTF-8"
        );
        assert_eq!(
            message(parse(Path::new("a.yaml"), b"a: 1\n---\nb: 2\n")),
            "a.yaml:2: no sound YAML: a second document begins here, expected one"
        );
    }

    #[test]
    fn documents_may_be_empty_or_nothing_but_comments() {
        for text in ["", "\n", "# nothing\n", "---\n"] {
            assert_eq!(parsed(text).value, Value::Null, "{text:?}");
        }
    }

    #[test]
    fn the_last_of_two_equal_keys_counts_as_in_python() {
        let node = parsed("a:\n  b: 1\n  b: 2\n");
        let root = YamlField::root(Path::new("a.yaml"), &node);
        let b = root.required("a").unwrap().required("b").unwrap();
        assert_eq!(b.integer().unwrap(), 2);
    }

    #[test]
    fn a_key_of_the_document_stands_there_once() {
        assert_eq!(
            refusal("vehicles: {7: {}}\nego_speed: 1\nvehicles: {}\n"),
            "a.yaml:3: no sound YAML: the key vehicles is here again, expected once"
        );
    }

    #[test]
    fn merged_maps_give_missing_entries() {
        let node = parsed("base: &b {x: 1, y: 2}\na:\n  <<: *b\n  x: 3\n");
        let a = YamlField::root(Path::new("a.yaml"), &node)
            .required("a")
            .unwrap();
        let values = ["x", "y"].map(|key| a.required(key).unwrap().integer().unwrap());
        assert_eq!((values, a.entries().unwrap().len()), ([3, 2], 2));
    }

    fn refusal(text: &str) -> String {
        message(parse(Path::new("a.yaml"), text.as_bytes()))
    }

    #[test]
    fn bombs_are_refused() {
        assert!(refusal(&"[".repeat(10_000)).contains("no sound YAML"));
        assert!(refusal(&"- ".repeat(10_000)).contains("no sound YAML"));
        assert!(refusal(&format!("[{}]", "1,".repeat(600_000))).contains("more than 500000 nodes"));
        let mut aliases = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
        for level in 1..12 {
            let repeats = vec![format!("*a{}", level - 1); 10].join(", ");
            aliases += &format!("a{level}: &a{level} [{repeats}]\n");
        }
        assert!(refusal(&aliases).contains("aliases repeat more than 200000 nodes"));
        assert!(refusal("a: &a [*a]\n").contains("an alias within its own anchor"));
    }

    proptest! {
        #[test]
        fn random_text_never_panics(bytes in prop::collection::vec(prop::sample::select(b"abc:-[]{}&*!|>'\"#\n 019.,~\xff".to_vec()), 0..120)) {
            let _ = parse(Path::new("a.yaml"), &bytes);
        }

        #[test]
        fn numbers_are_read_back_bit_exactly(values in prop::array::uniform6(prop::num::f64::NORMAL)) {
            let node = parsed(&format!("a: {values:?}\nb: [{}]\n", values.map(|value| format!("{value:e}")).join(", ")));
            let root = YamlField::root(Path::new("a.yaml"), &node);
            for key in ["a", "b"] {
                prop_assert_eq!(root.required(key).unwrap().numbers::<6>().unwrap(), values);
            }
        }
    }
}
