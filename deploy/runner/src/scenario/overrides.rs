//! Settings of single vehicles that override those of all.

use agent::config::AgentSettings;
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
        // Parsed only to refuse unknown fields and wrong types.
        serde_json::from_value::<AgentSettings>(Value::Object(fields.clone()))
            .map_err(D::Error::custom)?;
        Ok(Self(fields))
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

    /// Changes the settings that the vehicle has of its own.
    pub(super) fn change<E>(
        &mut self,
        change: impl FnOnce(AgentSettings) -> Result<AgentSettings, E>,
    ) -> Result<(), E> {
        let changed = change(self.over(&AgentSettings::default()))?;
        if let Ok(serde_json::Value::Object(changed)) = serde_json::to_value(changed) {
            for (field, value) in changed {
                // Only fields that the vehicle states: defaults must not replace those of all vehicles.
                self.0.entry(field).and_modify(|own| *own = value);
            }
        }
        Ok(())
    }
}
