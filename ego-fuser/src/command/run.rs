//! `ego-fuser run`: the fusing vehicle of a live fleet.

use crate::config::EgoConfig;
use crate::ego::{Ego, EgoError};
use crate::node::{self, NodeOptions};
use anyhow::Context;
use bus::{Configured, log_to_stderr};
use protocol::{CavId, Role};
use support::output;

use support::cli::{BadInput, Outcome};

/// Fuses what the ego's own agent and its neighbours send; detections out.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    config: Configured<EgoConfig>,
    /// Print a JSON summary at the end.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Loads the model, joins the run and works until the own agent ends.
    pub(crate) fn run(self) -> anyhow::Result<Outcome> {
        log_to_stderr();
        let config = self.config.validated()?;
        let (cav, ego) = build(&config)?;
        let stop = config.bus.stop().context("installing signal handlers")?;
        let bus = config.bus.join(&stop, &config.run, Role::Ego, &cav)?;
        tracing::info!(ego = %cav, method = %ego.method(), weights = %config.models.weights.display(), "ready");
        let report = node::run(&bus, &cav, ego, &NodeOptions::from(&config), &stop)?;
        bus.leave_at_end();
        if self.json {
            output::line(serde_json::to_string(&report)?)?;
        } else {
            let (frames, fused, failed) = (report.frames, report.fused, report.failed);
            let at_deadline = report.at_deadline;
            let failure = report.failure.as_ref();
            let reason = failure.map_or(String::new(), |reason| format!(", the first: {reason}"));
            let other = report.other_network.as_ref();
            let other = other.map_or(String::new(), |other| format!("; another network: {other}"));
            let boxes = match report.fused_boxes {
                0 => String::new(),
                boxes => format!(" ({boxes} of them boxes)"),
            };
            let refused = match (report.refused_boxes, report.refused_velocities) {
                (0, 0) => String::new(),
                (boxes, velocities) => {
                    format!(", {boxes} boxes and the velocities of {velocities} messages refused")
                }
            };
            output::line(format_args!(
                "{frames} frames, {fused} neighbours' messages fused{boxes}{refused}, {at_deadline} at the deadline, {failed} failed{reason}{other}"
            ))?;
        }
        let is_lossy = report.failed > 0 || report.other_network.is_some();
        Ok(Outcome::of(is_lossy))
    }
}

/// Vehicle and pipeline of a configuration, ready for the first frame but for its warm-up.
pub(super) fn build(config: &EgoConfig) -> anyhow::Result<(CavId, Ego)> {
    let cav = config.ego.id.clone();
    let cav = cav.context("the configuration names no ego")?;
    let models = &config.models;
    models.threads.apply();
    let inference = models.inference().map_err(BadInput::of)?;
    let ego = models.load(inference).map_err(EgoError::from);
    let ego = ego.and_then(|weights| Ego::from_weights(&weights, config.method, inference.device));
    let ego = ego.map_err(|error| BadInput::new(format!("weights: {error}")))?;
    let ego = ego
        .with_comm_range(config.comm_range_m)
        .with_box_alignment(config.ego.box_alignment)
        .with_misbehaviour_detection(config.ego.trust)?;
    Ok((cav, ego))
}
