//! Settings of single vehicles that override those of all.

use agent::config::AgentSettings;
use localization::pose_source::PoseSourceConfig;
use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};
use serde_json::{Map, Value};

/// Fields of [`AgentSettings`] that one vehicle overrides; each replaces that of all vehicles as a whole.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
#[serde(transparent)]
pub struct AgentOverrides(Map<String, Value>);

impl<'de> Deserialize<'de> for AgentOverrides {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let fields = Map::deserialize(deserializer)?;
        serde_json::from_value::<AgentSettings>(Value::Object(fields.clone()))
            .map_err(D::Error::custom)?;
        Ok(Self(fields))
    }
}

impl JsonSchema for AgentOverrides {
    fn inline_schema() -> bool {
        true
    }

    fn schema_name() -> std::borrow::Cow<'static, str> {
        AgentSettings::schema_name()
    }

    /// Schema of the settings, with no field required.
    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        generator.subschema_for::<AgentSettings>()
    }
}

impl AgentOverrides {
    /// `settings` with the fields of this vehicle.
    pub fn over(&self, settings: &AgentSettings) -> AgentSettings {
        let Ok(Value::Object(mut all)) = serde_json::to_value(settings) else {
            return settings.clone();
        };
        all.extend(self.0.clone());
        // Both were valid settings before.
        serde_json::from_value(Value::Object(all)).unwrap_or_else(|_| settings.clone())
    }

    /// Changes the pose source, if the vehicle overrides it.
    pub(super) fn change_pose<E>(
        &mut self,
        change: impl FnOnce(PoseSourceConfig) -> Result<PoseSourceConfig, E>,
    ) -> Result<(), E> {
        if !self.0.contains_key("pose") {
            return Ok(());
        }
        let pose = change(self.over(&AgentSettings::default()).pose)?;
        if let Ok(pose) = serde_json::to_value(pose) {
            self.0.insert("pose".into(), pose);
        }
        Ok(())
    }
}
