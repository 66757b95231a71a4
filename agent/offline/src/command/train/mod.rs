//! `agent train`: the two stages of PGC, and the baselines.

mod diffloc;
mod encoder;
mod hypliloc;
pub(super) mod options;
mod scene;
mod sgloc;

use anyhow::Context;
use bus::malloc_settings;
use clap::Subcommand;

/// Train a localizer: an encoder once, over many scenes; then a head for each scene. Or a baseline on one scene.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(subcommand)]
    stage: Stage,
}

#[derive(Debug, Subcommand)]
enum Stage {
    Encoder(encoder::Args),
    Scene(scene::Args),
    #[command(name = "sgloc")]
    SgLoc(sgloc::Args),
    #[command(name = "diffloc")]
    DiffLoc(diffloc::Args),
    #[command(name = "hypliloc")]
    HypLiLoc(hypliloc::Args),
}

/// Runs the chosen stage.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    malloc_settings::ensure(&malloc_settings::FEW_PRODUCTS)
        .context("cannot execute this program again")?;
    match &args.stage {
        Stage::Encoder(args) => encoder::run(args),
        Stage::Scene(args) => scene::run(args),
        Stage::SgLoc(args) => sgloc::run(args),
        Stage::DiffLoc(args) => diffloc::run(args),
        Stage::HypLiLoc(args) => hypliloc::run(args),
    }
}
