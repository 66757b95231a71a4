//! Field override: another value for a field of a scenario file, from the command line.

use std::fmt;
use std::str::FromStr;

use serde_json::{Map, Value};

use super::Scenario;

/// `scene.lockstep=true`: the path of a field and its value in YAML.
#[derive(Debug, Clone, PartialEq)]
pub struct FieldOverride {
    path: Vec<String>,
    value: Value,
    /// The value for a field that is a text or a list of texts: `5` is a number, `"5"` may be meant.
    text: Value,
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
        let texts = serde_saphyr::from_str::<Vec<String>>(value).map(Value::from);
        let text = texts.or_else(|_| serde_saphyr::from_str(value).map(Value::String));
        let value: Value = serde_saphyr::from_str(value)
            .map_err(|error| format!("{value:?} is no YAML: {error}"))?;
        let text = text.unwrap_or_else(|_| value.clone());
        Ok(Self { path, value, text })
    }
}

impl fmt::Display for FieldOverride {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.path.join("."), self.value)
    }
}

impl FieldOverride {
    /// A scenario with the field set, to a text where its type accepts nothing else.
    ///
    /// # Errors
    /// The error of the value in YAML.
    pub(super) fn applied_to(&self, scenario: &Scenario) -> serde_json::Result<Scenario> {
        let document = serde_json::to_value(scenario)?;
        let with = |value| serde_json::from_value(self.set(document.clone(), value));
        with(&self.value).or_else(|error| with(&self.text).map_err(|_| error))
    }

    /// Sets the field in a document; sections on the way that are missing or have no fields are made.
    fn set(&self, mut document: Value, value: &Value) -> Value {
        let mut place = &mut document;
        for field in &self.path {
            if !place.is_object() {
                *place = Value::Object(Map::new());
            }
            place = &mut place[field];
        }
        *place = value.clone();
        document
    }
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
            let field: FieldOverride = text.parse().unwrap();
            document = field.set(document, &field.value);
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
