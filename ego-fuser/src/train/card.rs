//! The model card: what was trained on what, and how good it is.

use std::fmt::Write;

use super::{Summary, TrainConfig};
use crate::model::CooperativeModel;
use crate::samples::{SampleConfig, SceneSet};

/// The card as Markdown.
pub(super) fn text(
    config: &TrainConfig,
    model: &CooperativeModel,
    scenes: &SceneSet,
    data_sha256: &str,
    summary: &Summary,
) -> String {
    let detector = model.config();
    let parameters: usize = model.variables.variables().values().map(|tensor| tensor.numel()).sum();
    let mut card = String::new();
    let mut line = |text: String| {
        card.push_str(&text);
        card.push('\n');
    };
    line(format!("# {} detector, method `{}`\n", detector.name, model.method));
    line(format!(
        "PointPillars over {:?} m, trained for `{}`: {}.\n",
        detector.lidar_range_m,
        model.method,
        model.method.summary()
    ));
    line("| | |\n| --- | --- |".into());
    line(format!("| command | `{}` |", config.command));
    line(format!("| parameters | {parameters} |"));
    line(format!("| weights | SHA-256 `{}` |", summary.sha256));
    let ticks = scenes.ticks().len();
    line(format!(
        "| data | {ticks} ticks of {} scenarios, listing SHA-256 `{data_sha256}` |",
        scenes.scenarios().len()
    ));
    line(format!("| seed | {} |", config.seed));
    line(format!("| steps | {} of {} samples |", summary.steps, config.batch));
    line(format!("| convolutions | {:?} |", config.precision));
    line(format!("| time | {:.0} s |", summary.seconds));
    line(format!(
        "| peak learning rate | {:e}, weight decay {:e} |",
        config.learning_rate, config.optimizer.weight_decay
    ));
    line(format!("| anchors between the thresholds | {:?} |", config.loss.unassigned));
    let SampleConfig { augmentation, drop_neighbour, pose_noise, max_agents, comm_range_m, .. } = &config.samples;
    line(format!(
        "| augmentation | mirrored {:.0} %, turned up to {:.0} degrees, scaled up to {:.0} % |",
        100.0 * augmentation.mirror,
        augmentation.turn_rad.to_degrees(),
        100.0 * augmentation.scale
    ));
    line(format!(
        "| vehicles | up to {max_agents} within {comm_range_m} m, each neighbour missing in {:.0} %, poses off by {} m and {} degrees |",
        100.0 * drop_neighbour,
        pose_noise.position_m,
        pose_noise.yaw_rad.to_degrees()
    ));
    if let Some(accuracy) = &summary.accuracy {
        line(format!(
            "\nValidation on {} frames, true poses, ground truth of all vehicles within {comm_range_m} m, area of the network:\n",
            accuracy.frames
        ));
        line("| AP | 0.3 | 0.5 | 0.7 |\n| --- | --- | --- | --- |".into());
        for (name, [ap_30, ap_50, ap_70]) in [("global", accuracy.ap_global), ("frame order", accuracy.ap_frame_order)]
        {
            line(format!("| {name} | {ap_30:.4} | {ap_50:.4} | {ap_70:.4} |"));
        }
    }
    let _ = write!(
        card,
        "\nConfiguration:\n\n```json\n{}\n```\n",
        serde_json::to_string_pretty(detector).unwrap_or_default()
    );
    card
}
