//! Trace of a link: file and start time.

use std::fmt;
use std::path::{Path, PathBuf};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::value::MapAccessDeserializer;
use serde::de::{Error, MapAccess, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use support::rounding;

/// A trace: its path alone, or `{path, offset_s}`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TraceConfig {
    /// The file.
    pub path: PathBuf,
    /// Time in the trace at which the link begins, seconds.
    pub offset_s: f64,
}

impl TraceConfig {
    /// A trace from its beginning on.
    pub fn new(path: &Path) -> Self {
        Self {
            path: path.to_owned(),
            offset_s: 0.0,
        }
    }

    /// [`Self::offset_s`] in nanoseconds.
    pub(super) fn offset_nanos(&self) -> u64 {
        rounding::to_u64(self.offset_s * 1e9)
    }
}

impl JsonSchema for TraceConfig {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "TraceConfig".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({
            "description": "A trace: its path alone, or its path and the second of it at which the link begins.",
            "anyOf": [
                {"type": "string"},
                {
                    "type": "object",
                    "properties": {"path": {"type": "string"}, "offset_s": {"type": "number", "default": 0.0}},
                    "required": ["path"],
                    "additionalProperties": false
                }
            ]
        })
    }
}

impl<'de> Deserialize<'de> for TraceConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        // YAML describes its own types, so a text and a map can be told apart without a tag.
        deserializer.deserialize_any(PathOrFields)
    }
}

struct PathOrFields;

impl<'de> Visitor<'de> for PathOrFields {
    type Value = TraceConfig;

    fn expecting(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str("the path of a trace, or {path, offset_s}")
    }

    fn visit_str<E: Error>(self, path: &str) -> Result<TraceConfig, E> {
        Ok(TraceConfig::new(Path::new(path)))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<TraceConfig, A::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Fields {
            path: PathBuf,
            #[serde(default)]
            offset_s: f64,
        }
        let Fields { path, offset_s } = Fields::deserialize(MapAccessDeserializer::new(map))?;
        Ok(TraceConfig { path, offset_s })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_path_without_offset_begins_at_the_beginning() {
        let first = TraceConfig::new(Path::new("link.csv"));
        let later = TraceConfig {
            offset_s: 90.5,
            ..first.clone()
        };
        let written = serde_json::to_string(&later).unwrap();
        for (text, expected) in [
            ("link.csv", &first),
            ("{path: link.csv, offset_s: 90.5}", &later),
            (written.as_str(), &later),
        ] {
            let read: TraceConfig = serde_saphyr::from_str(text).unwrap();
            assert_eq!(read, *expected, "{text}");
        }
        for (text, field) in [
            ("{path: link.csv, ofset_s: 1}", "ofset_s"),
            ("{offset_s: 1}", "path"),
        ] {
            let error = serde_saphyr::from_str::<TraceConfig>(text).unwrap_err();
            assert!(error.to_string().contains(field), "{error}");
        }
    }
}
