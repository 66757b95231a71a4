//! Type hashes of ROS 2 (REP-2011, REP-2016): SHA-256 of a type's description.
//!
//! The description is JSON with a fixed order of keys and a space after each `,` and `:`; constants, comments and default
//! values are not part of it.

use protocol::text::hex;
use sha2::{Digest, Sha256};

use super::definitions::Definition;

/// Prefix of the first version of these hashes.
const PREFIX: &str = "RIHS01_";
/// Type ids of the single values that the definitions have, from `type_description_interfaces/FieldType`.
const TYPE_IDS: [(&str, u8); 8] = [
    ("uint8", 3),
    ("int32", 6),
    ("uint32", 7),
    ("float32", 10),
    ("float64", 11),
    ("bool", 15),
    ("byte", 16),
    ("string", 17),
];
/// Type id of another message.
const NESTED: u8 = 1;
/// Distance from the id of a value to that of an array of it, and to that of a sequence without a bound.
const ARRAY: u8 = 48;
const SEQUENCE: u8 = 144;

/// Distributions of ROS 2 by what their rmw_zenoh writes into keys; Jazzy stands for all later ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub enum Distribution {
    /// Without type hashes.
    Humble,
    /// With type hashes.
    #[default]
    Jazzy,
}

/// Hash of the type `own`, which contains the types `contained`, directly or not.
pub(crate) fn type_hash(own: Definition, mut contained: Vec<Definition>) -> String {
    // The hash depends on the order of the referenced types, which is by name.
    contained.sort_unstable_by_key(|(name, _)| *name);
    let references: Vec<String> = contained.into_iter().map(description).collect();
    let text = format!(
        r#"{{"type_description": {}, "referenced_type_descriptions": [{}]}}"#,
        description(own),
        references.join(", ")
    );
    format!("{PREFIX}{}", hex(&Sha256::digest(text)))
}

fn description((name, fields): Definition) -> String {
    let fields = fields
        .lines()
        // A line with `=` defines a constant.
        .filter(|line| !line.contains('='))
        .filter_map(|line| line.split_once(' '));
    let fields: Vec<String> = fields.map(field).collect();
    format!(
        r#"{{"type_name": "{}", "fields": [{}]}}"#,
        full_name(name),
        fields.join(", ")
    )
}

fn field((type_name, name): (&str, &str)) -> String {
    let (value, length) = type_name
        .trim_end_matches(']')
        .split_once('[')
        .unwrap_or((type_name, "0"));
    let many = match length {
        "0" => 0,
        "" => SEQUENCE,
        _ => ARRAY,
    };
    let known = TYPE_IDS.iter().find(|(known, _)| *known == value);
    let id = known.map(|(_, id)| *id);
    let nested = id.map_or_else(|| full_name(value), |_| String::new());
    let id = id.unwrap_or(NESTED) + many;
    let capacity = if length.is_empty() { "0" } else { length };
    format!(
        r#"{{"name": "{name}", "type": {{"type_id": {id}, "capacity": {capacity}, "string_capacity": 0, "nested_type_name": "{nested}"}}}}"#
    )
}

/// `geometry_msgs/Pose` as `geometry_msgs/msg/Pose`.
fn full_name(name: &str) -> String {
    name.replacen('/', "/msg/", 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_description_has_fields_but_no_constants() {
        let definition = (
            "a_msgs/B",
            "byte OK=0\nfloat64[36] c\nd_msgs/E[] f\nstring g\n",
        );
        assert_eq!(
            description(definition),
            concat!(
                r#"{"type_name": "a_msgs/msg/B", "fields": ["#,
                r#"{"name": "c", "type": {"type_id": 59, "capacity": 36, "string_capacity": 0, "nested_type_name": ""}}, "#,
                r#"{"name": "f", "type": {"type_id": 145, "capacity": 0, "string_capacity": 0, "nested_type_name": "d_msgs/msg/E"}}, "#,
                r#"{"name": "g", "type": {"type_id": 17, "capacity": 0, "string_capacity": 0, "nested_type_name": ""}}]}"#
            )
        );
    }
}
