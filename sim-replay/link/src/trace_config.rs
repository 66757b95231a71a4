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
        let read = |text: &str| serde_saphyr::from_str::<TraceConfig>(text);
        assert_eq!(
            read("link.csv").unwrap(),
            TraceConfig::new(Path::new("link.csv"))
        );
        let later = TraceConfig {
            offset_s: 90.5,
            ..TraceConfig::new(Path::new("link.csv"))
        };
        assert_eq!(read("{path: link.csv, offset_s: 90.5}").unwrap(), later);
        assert_eq!(
            read(&serde_json::to_string(&later).unwrap()).unwrap(),
            later
        );
        assert!(
            read("{path: link.csv, ofset_s: 1}")
                .unwrap_err()
                .to_string()
                .contains("ofset_s")
        );
        assert!(
            read("{offset_s: 1}")
                .unwrap_err()
                .to_string()
                .contains("path")
        );
    }
}
