//! `agent run`: one vehicle of a live fleet.

use crate::agent::Agent;
use crate::config::AgentConfig;
use crate::node;
use anyhow::Context;
use bus::{Configured, log_to_stderr};
use perception::detector::Detector;
use protocol::Role;
use support::output;

use support::cli::{BadInput, Outcome};

/// Run one vehicle: subscribes to its sensors; publishes pose, feature map, boxes or points.
///
/// Ends when the replay does, or on Ctrl-C or SIGTERM; with sensors of a ROS 2 network (v2vloc ros2 --lidar) it stays.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    config: Configured<AgentConfig>,
    /// Print a JSON summary at the end.
    #[arg(long)]
    json: bool,
}

/// Loads the models, joins the run and works until the replay ends.
pub(crate) fn run(args: Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let config = args.config.validated()?;
    let agent = agent(&config)?;
    let stop = config.bus.stop().context("installing signal handlers")?;
    let (run, cav) = (&config.run, &config.cav);
    let bus = config.bus.join(&stop, run, Role::Agent, cav)?;
    if config.gives_poses_only() {
        tracing::info!(%cav, "ready: poses only");
    } else {
        tracing::info!(%cav, weights = %config.models.weights.display(), "ready");
    }
    let report = node::run(&bus, agent, &config.options(), &stop)?;
    bus.leave_at_end();
    if args.json {
        output::line(serde_json::to_string(&report)?)?;
    } else {
        let reason = report.failure.as_ref();
        output::line(format_args!(
            "{} sweeps, {} without a pose, {} failed{}",
            report.sweeps,
            report.no_pose,
            report.failed,
            reason.map_or(String::new(), |reason| format!(", the first: {reason}"))
        ))?;
    }
    Ok(Outcome::of(report.failed > 0))
}

/// Pipeline of a configuration.
pub(super) fn agent(config: &AgentConfig) -> anyhow::Result<Agent> {
    config.models.threads.apply();
    load(config).map_err(|error| BadInput::of(error).into())
}

fn load(config: &AgentConfig) -> anyhow::Result<Agent> {
    let inference = config.models.inference()?;
    let pose_source = config
        .settings
        .pose
        .clone()
        .with_networks()?
        .build(inference)?;
    if config.gives_poses_only() {
        return Ok(Agent::without_detector(config.cav.clone(), pose_source));
    }
    let weights = config.models.load(inference).context("weights")?;
    let detector = Detector::from_weights(&weights, &weights.detector_config()?, inference.device)
        .context("weights")?;
    let sent = config.options().of_loop.publish;
    config.settings.check_limits(&sent, &detector)?;
    Ok(Agent::new(config.cav.clone(), pose_source, detector))
}
