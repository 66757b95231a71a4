//! `v2vloc schema`.

use runner::schema::SchemaOf;
use support::output;

use super::Outcome;

#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Kind of file.
    #[arg(value_enum)]
    of: SchemaOf,
}

impl Arguments {
    /// Prints the schema.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        output::text(self.of.json())?;
        Ok(Outcome::Done)
    }
}
