//! `agent train`: the two stages of PGC, and the baselines.

mod encoder;
mod options;
mod pose_regression;
mod scene;
mod sgloc;

use agent_offline::training::{train_diffloc, train_hypliloc};
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
    /// Train DiffLoc, a baseline of the localizer, on one scene, on a frozen encoder; writes checkpoint, curve.csv,
    /// weights.safetensors and model-card.md.
    ///
    /// Tokens of all sweeps lie on the device: 18 kB for each. A length in minutes begins when they are computed.
    #[command(name = "diffloc")]
    DiffLoc(pose_regression::Args),
    /// Train HypLiLoc, a baseline of the localizer, on one scene, on a frozen encoder; writes checkpoint, curve.csv,
    /// weights.safetensors and model-card.md.
    ///
    /// Tokens of all sweeps lie on the device: 18 kB for each. A length in minutes begins when they are computed.
    #[command(name = "hypliloc")]
    HypLiLoc(pose_regression::Args),
}

/// Runs the chosen stage.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    malloc_settings::ensure(&malloc_settings::FEW_PRODUCTS)
        .context("cannot execute this program again")?;
    match &args.stage {
        Stage::Encoder(args) => encoder::run(args),
        Stage::Scene(args) => scene::run(args),
        Stage::SgLoc(args) => sgloc::run(args),
        Stage::DiffLoc(args) => pose_regression::run(args, "DiffLoc", train_diffloc),
        Stage::HypLiLoc(args) => pose_regression::run(args, "HypLiLoc", train_hypliloc),
    }
}
