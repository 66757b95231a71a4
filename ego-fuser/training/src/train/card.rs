//! Model card: data, settings and accuracy of a trained model.

use perception::train::{ModelCard, Trained};

use super::config::TrainConfig;
use super::frozen::sample_config;
use super::validation::Accuracy;
use crate::samples::{SceneSet, box_augmentation};
use fusion::model::CooperativeModel;

/// The card of a detector.
pub(super) fn card(
    config: &TrainConfig,
    model: &CooperativeModel,
    scenes: &SceneSet,
    trained: &Trained,
    accuracy: Option<&Accuracy>,
) -> ModelCard {
    let (detector, method, run) = (model.config(), model.method, &config.run);
    let mut card = ModelCard::new(
        &format!("{} detector, method `{method}`", detector.name),
        &format!(
            "PointPillars over {:?} m, trained for `{method}`: {}.",
            detector.lidar_range_m,
            method.summary()
        ),
    );
    let (ticks, scenarios) = (scenes.ticks.len(), scenes.scenarios.len());
    let data = format!("{ticks} ticks of {scenarios} scenarios");
    card.trained(run, trained, &data, "samples");
    let (rate, decay) = (run.learning_rate, run.optimizer.weight_decay);
    let rate = format!("{rate:e}, weight decay {decay:e}");
    card.row("peak learning rate", rate);
    let unassigned = format!("{:?}", config.loss.unassigned);
    card.row("anchors between the thresholds", unassigned);
    let samples = sample_config(config, model);
    let (poses, comm_range_m) = (&samples.poses, samples.comm_range_m);
    card.row(
        "augmentation",
        format_args!(
            "mirrored {:.0} %, turned up to {:.0} degrees, scaled up to {:.0} %",
            100.0 * samples.augmentation.mirror,
            samples.augmentation.turn_rad.to_degrees(),
            100.0 * samples.augmentation.scale
        ),
    );
    card.row(
        "vehicles",
        format_args!(
            "up to {} within {comm_range_m} m, each neighbour missing in {:.0} % and up to {:.1} s late",
            samples.max_agents,
            100.0 * samples.drop_neighbour,
            samples.moments.max_delay_nanos as f64 * 1e-9
        ),
    );
    if samples.merged_truth {
        let text = "samples of one vehicle, its neighbours' annotations are targets too";
        card.row("ego-only", text);
    }
    let (frames, gap) = (samples.moments.frames, samples.moments.gap);
    let text = format!("{frames} frames of each vehicle, up to {gap} ticks from one to the next");
    card.row("moments", text);
    let source = match poses.tables.is_empty() {
        true => "true",
        false => "found by a pose generator",
    };
    card.row("poses", source);
    if let Some(noise) = &poses.noise {
        card.row(
            "error on top of poses",
            format_args!(
                "{:?}, {} m and {} degrees, in {:.0} % of the samples",
                noise.mode,
                noise.position_std_m,
                noise.heading_std_deg,
                100.0 * poses.noise_share
            ),
        );
    }
    if poses.lost_share > 0.0 {
        let share = 100.0 * poses.lost_share;
        let text =
            format!("one neighbour in {share:.0} % of the samples, overconfident in a wrong pose");
        card.row("lost vehicles", text);
    }
    if config.loss.alignment_weight > 0.0 {
        let weight = config.loss.alignment_weight;
        let text = format!("learns to undo that error, loss with weight {weight}");
        card.row("alignment", text);
    }
    if config.frozen_encoder.is_some() {
        card.row("encoder", "frozen, its maps kept");
    }
    if config.box_input {
        let trained = "everything but the box input and the refinement of boxes";
        card.row("frozen", trained);
        card.row("neighbours", box_augmentation());
    }
    if let Some(accuracy) = accuracy {
        card.paragraph(&format!(
            "Validation on {} frames, ground truth of all vehicles within {comm_range_m} m, area of the network:",
            accuracy.frames
        ));
        let [global, frame_order] = [accuracy.ap_global, accuracy.ap_frame_order].map(|aps| {
            aps.map(|ap| ap.map_or("-".into(), |ap| format!("{ap:.4}")))
                .join(" | ")
        });
        card.paragraph(&format!(
            "| AP | 0.3 | 0.5 | 0.7 |\n| --- | --- | --- | --- |\n| global | {global} |\n| frame order | {frame_order} |"
        ));
    }
    card.configuration(detector);
    card.configuration_json(&model.fusion.config().to_json_pretty());
    card
}
