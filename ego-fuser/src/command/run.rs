//! `ego-fuser run`: the fusing vehicle of a live fleet.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::Duration;

use anyhow::Context;
use bus::{BusArgs, PeerArgs, STOP_LIMIT, log_to_stderr};
use ego_fuser::ego::Ego;
use ego_fuser::misbehaviour::TrustConfig;
use ego_fuser::node::{self, NodeOptions};
use ego_fuser::pairing::PairingConfig;
use fusion::Method;
use protocol::{CavId, Role};
use support::output;

use support::cli::BadInput;

/// Fuses what the ego's own agent and its neighbours send; detections out.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(flatten)]
    bus: BusArgs,
    /// The vehicle that fuses.
    #[arg(long, allow_hyphen_values = true)]
    ego: CavId,
    /// Weights (safetensors; configuration and method are inside).
    #[arg(long)]
    weights: PathBuf,
    /// A method of `ego-fuser methods` [default: what the weights were trained for].
    #[arg(long)]
    method: Option<Method>,
    /// Milliseconds a frame waits for its neighbours, from the arrival of the own agent's message.
    #[arg(long, default_value_t = 50)]
    deadline_ms: u64,
    /// Milliseconds that a neighbour's message may be older than the ego's frame.
    #[arg(long, default_value_t = 300)]
    max_age_ms: u64,
    /// "discover": all agents that are found; or the ids of those that may take part.
    #[arg(long, value_delimiter = ',', default_value = "discover", allow_hyphen_values = true)]
    neighbours: Vec<String>,
    /// Neighbours farther away than this have no part, metres in the plane.
    #[arg(long, value_name = "M", default_value_t = Ego::COMM_RANGE_M)]
    comm_range: f64,
    /// Hear neighbours behind the emulated air (`sim-replay link`) and not directly.
    #[arg(long)]
    over_link: bool,
    /// Leave out neighbours whose words do not fit what the ego sees itself.
    #[arg(long)]
    trust: bool,
    #[command(flatten)]
    peers: PeerArgs,
    /// Threads to compute with; the same number gives the same bits.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: u16,
    /// Go on when the own agent ends, for the next one; always so with --supervised.
    #[arg(long)]
    keep_running: bool,
    /// Print a JSON summary at the end.
    #[arg(long)]
    json: bool,
}

impl Arguments {
    /// Loads the model, joins the run and works until the own agent ends.
    pub(crate) fn run(self) -> anyhow::Result<()> {
        log_to_stderr();
        tch::set_num_threads(i32::from(self.threads));
        let options = self.options()?;
        let ego = Ego::load(&self.weights, self.method).map_err(|error| BadInput::new(format!("weights: {error}")))?;
        let ego = ego.with_comm_range(self.comm_range);
        let ego = ego.with_trust(self.trust.then(TrustConfig::default))?;
        let stop = self.bus.stop().context("installing signal handlers")?;
        let bus = self.bus.join(Role::Ego, &self.ego)?;
        tracing::info!(ego = %self.ego, method = %ego.method(), weights = %self.weights.display(), "ready");
        let report = node::run(&bus, &self.ego, ego, &options, &stop)?;
        if let Err(overdue) = bus.leave(STOP_LIMIT) {
            tracing::warn!("{overdue}");
        }
        if self.json {
            output::line(serde_json::to_string(&report)?)?;
        } else {
            let node::NodeReport { frames, fused, at_deadline, failed } = report;
            output::line(format_args!(
                "{frames} frames, {fused} neighbours' messages fused, {at_deadline} at the deadline, {failed} failed"
            ))?;
        }
        Ok(())
    }

    fn options(&self) -> anyhow::Result<NodeOptions> {
        let neighbours = match self.neighbours.as_slice() {
            [word] if word == "discover" => None,
            ids => {
                let ids: Result<BTreeSet<CavId>, _> = ids.iter().map(|id| CavId::new(id)).collect();
                Some(ids.map_err(|error| BadInput::new(format!("--neighbours: {error}")))?)
            }
        };
        let max_age_nanos = self.max_age_ms.saturating_mul(1_000_000);
        Ok(NodeOptions {
            deadline: Duration::from_millis(self.deadline_ms),
            pairing: PairingConfig { max_age_nanos, ..PairingConfig::default() },
            neighbours,
            over_link: self.over_link,
            keeps_running: self.keep_running || self.bus.supervised,
            inbox: self.peers.limits(),
            ..NodeOptions::default()
        })
    }
}
