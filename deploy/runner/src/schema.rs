//! JSON schemas of the configuration files, generated from the types that read them.

use schemars::{SchemaGenerator, generate::SchemaSettings};

use link::LinkConfig;

use crate::experiment::spec::Experiment;
use crate::scenario::Scenario;

/// A kind of file with a schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum SchemaOf {
    /// `v2vloc up SCENARIO`.
    Scenario,
    /// `v2vloc sweep EXPERIMENT` and `v2vloc eval --table EXPERIMENT`.
    Experiment,
    /// A file with the stages of a link.
    Link,
}

impl SchemaOf {
    /// The schema as indented JSON with a line end.
    pub fn json(self) -> String {
        let generator = SchemaGenerator::new(SchemaSettings::draft07());
        let schema = match self {
            Self::Scenario => generator.into_root_schema_for::<Scenario>(),
            Self::Experiment => generator.into_root_schema_for::<Experiment>(),
            Self::Link => generator.into_root_schema_for::<LinkConfig>(),
        };
        format!("{:#}\n", schema.to_value())
    }
}

#[cfg(test)]
mod tests;
