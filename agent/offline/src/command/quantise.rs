//! `agent quantise`: scales of activations of scene encoder and head for 8-bit inference, stored in the head's file.

use std::path::PathBuf;

use agent_offline::sweep_database::open_drives;
use dataset::{LeftOut, LoadOptions};
use localization::pgc::Localizer;
use localization::pgc::head_files::{encoder_or_named, head_config};
use perception::inference::Inference;
use perception::int8::{SCALES_KEY, ScaleSearch};
use perception::weights::annotate;
use support::cli::{BadInput, Outcome};
use support::output;

use super::scene_heads::{check_place, generated_maps};

/// Search the scales of activations on a few training sweeps of a scene and store them in its head, which is then
/// computed in 8-bit integers, as is its encoder.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Data sets, splits or scenarios of the scene.
    #[arg(long, value_name = "DIR", num_args = 1.., required = true)]
    dataset: Vec<PathBuf>,
    /// Weights of the encoder, or of a detector that has it and its scales [default: those that the head names].
    #[arg(long, value_name = "FILE")]
    encoder: Option<PathBuf>,
    /// Weights of the head; its parameters stay as they are.
    #[arg(long, value_name = "FILE")]
    head: PathBuf,
    /// Number of sweeps of every scenario, evenly over its ticks and vehicles.
    #[arg(long, value_name = "N", default_value_t = 10, value_parser = clap::value_parser!(u16).range(1..))]
    sweeps: u16,
}

/// Searches the scales and stores them.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    tch::set_num_threads(1);
    let encoder = encoder_or_named(args.encoder.as_deref(), &args.head).map_err(BadInput::of)?;
    // The confidence of a new head is fitted after this: its absence is no news.
    let localizer = Localizer::load_without_confidence(&encoder, &args.head, Inference::FLOAT);
    let localizer = localizer.map_err(BadInput::of)?;
    // By the names of maps alone: poses may be in a frame of their own, they are not used here.
    let (_, config) = head_config(&args.head).map_err(BadInput::of)?;
    check_place((&args.head, &config), &generated_maps(&args.dataset)?, &[])?;
    let (mut search, mut left_out, mut observed) = (ScaleSearch::default(), LeftOut::default(), 0);
    for folder in &args.dataset {
        let drives = open_drives(folder, &mut left_out).map_err(BadInput::of)?;
        for scenario in &drives.scenarios {
            let (ticks, agents) = (scenario.ticks.len(), scenario.agents.len());
            let count = (ticks * agents).min(args.sweeps.into());
            for number in 0..count {
                // Vehicles take turns: a stride over all sweeps could meet the same one each time.
                let (tick, agent) = (number * ticks / count, number % agents);
                let loaded = scenario.load_tick(tick, agent..agent + 1, &LoadOptions::default());
                left_out.add_tick(&loaded);
                for (_, frame) in &loaded.frames {
                    localizer.observe(&frame.points, &mut search)?;
                    observed += 1;
                }
            }
        }
    }
    let scales = search.scales();
    if scales.is_empty() {
        return Err(BadInput::new(format!(
            "none of {observed} sweeps has as many cells as a pose needs: nothing to search scales on"
        ))
        .into());
    }
    let sha256 =
        annotate(&args.head, SCALES_KEY, &serde_json::to_string(&scales)?).map_err(BadInput::of)?;
    let (head, activations) = (args.head.display(), scales.len());
    output::line(format_args!(
        "{head}: {activations} activations of {observed} sweeps, SHA-256 {sha256}"
    ))?;
    Ok(left_out.print())
}
