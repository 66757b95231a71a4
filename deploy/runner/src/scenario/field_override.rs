//! Field override: another value for a field of a scenario file, from the command line.

use std::fmt;
use std::str::FromStr;

use serde_json::{Map, Value};

/// `scene.lockstep=true`: the path of a field and its value in YAML.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldOverride {
    path: Vec<String>,
    value: Value,
}

impl FromStr for FieldOverride {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        // At the first sign only: the value may have further ones.
        let (path, value) = text.split_once('=').ok_or_else(|| {
            format!("{text:?} is not FIELD=VALUE, for example scene.lockstep=true")
        })?;
        let path: Vec<String> = path.split('.').map(str::to_owned).collect();
        if path.iter().any(String::is_empty) {
            return Err(format!("{text:?}: a part of the field's name is empty"));
        }
        let value = serde_saphyr::from_str(value)
            .map_err(|error| format!("{value:?} is no YAML: {error}"))?;
        Ok(Self { path, value })
    }
}

impl fmt::Display for FieldOverride {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.path.join("."), self.value)
    }
}

impl FieldOverride {
    /// Sets the field in a document; sections on the way that are missing or have no fields are made.
    pub(super) fn apply(&self, document: &mut Value) {
        let Some((field, sections)) = self.path.split_last() else {
            return;
        };
        let mut place = document;
        for section in sections {
            place = fields_of(place)
                .entry(section.as_str())
                .or_insert(Value::Null);
        }
        fields_of(place).insert(field.clone(), self.value.clone());
    }
}

fn fields_of(place: &mut Value) -> &mut Map<String, Value> {
    if !place.is_object() {
        *place = Value::Object(Map::new());
    }
    place.as_object_mut().expect("it has just been made one")
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn fields_are_set_by_their_path() {
        let mut document = json!({"scene": {"dir": "a", "rate": 1.0}});
        for text in [
            "scene.rate=0.5",
            "agents.codec.dtype=i8",
            "vehicles.4279.pose={noisy: {position_std_m: 1}}",
        ] {
            text.parse::<FieldOverride>().unwrap().apply(&mut document);
        }
        let expected = json!({
            "scene": {"dir": "a", "rate": 0.5},
            "agents": {"codec": {"dtype": "i8"}},
            "vehicles": {"4279": {"pose": {"noisy": {"position_std_m": 1}}}},
        });
        assert_eq!(document, expected);
        for text in ["scene.rate", "=1", "scene..rate=1", "a=[1"] {
            assert!(text.parse::<FieldOverride>().is_err(), "{text}");
        }
    }
}
