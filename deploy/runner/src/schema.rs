//! JSON schemas of the configuration files, generated from the types that read them.

use schemars::{JsonSchema, SchemaGenerator, generate::SchemaSettings};

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
        let text = match self {
            Self::Scenario => text_of::<Scenario>(),
            Self::Experiment => text_of::<Experiment>(),
            Self::Link => text_of::<LinkConfig>(),
        };
        text + "\n"
    }
}

fn text_of<T: JsonSchema>() -> String {
    let generator = SchemaGenerator::new(SchemaSettings::draft07());
    format!("{:#}", generator.into_root_schema_for::<T>().to_value())
}

#[cfg(test)]
mod tests;
