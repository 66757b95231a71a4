//! `ego-fuser methods`: the registry as a table or JSON.

use anyhow::Result;
use fusion::Method;
use serde_json::json;
use support::output;

/// Lists the collaboration methods.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Print JSON for machines.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Prints the registry to standard output.
    pub(crate) fn run(self) -> Result<()> {
        if self.json {
            let rows = Method::ALL.iter().map(|method| {
                let (exchange, summary) = (method.exchange(), method.summary());
                json!({"method": method, "exchange": exchange, "summary": summary})
            });
            output::line(serde_json::to_string_pretty(&rows.collect::<Vec<_>>())?)?;
        } else {
            for method in Method::ALL {
                output::line(format_args!("{method:<10} {}", method.summary()))?;
            }
        }
        Ok(())
    }
}
