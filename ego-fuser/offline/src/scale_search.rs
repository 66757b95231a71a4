//! Scales of activations of a cooperative model, searched on recorded sweeps.

use std::ops::ControlFlow;
use std::path::Path;

use dataset::{LeftOut, LoadOptions, Scenario};
use perception::detector::Detector;
use perception::int8::{ActivationScales, InferencePrecision, ScaleSearch};
use perception::weights::Weights;
use tch::Device;

use crate::evaluation::{EvaluateError, Evaluator, Setup};

/// Scales of the activations of a weights file, computed in floating point on the first `frames` ticks of every
/// scenario with true poses: of the detector on the sweeps of all vehicles, of the fusion on their maps. Sweeps that
/// cannot be read are counted in `left_out`.
///
/// # Errors
/// [`EvaluateError`] names the file and what is wrong with it.
pub fn search_scales(
    weights: &Path,
    scenarios: &[Scenario],
    frames: usize,
    left_out: &mut LeftOut,
) -> Result<ActivationScales, EvaluateError> {
    let mut search = ScaleSearch::default();
    // Scales that the file has already must not change what is observed.
    let precision = InferencePrecision::Float;
    let network = Weights::load(weights)?.with_precision(precision);
    let mut detector = Detector::from_weights(&network, &network.detector_config()?, Device::Cpu)?;
    for scenario in scenarios {
        for tick in 0..scenario.ticks.len().min(frames) {
            let loaded =
                scenario.load_tick(tick, 0..scenario.agents.len(), &LoadOptions::default());
            left_out.add_tick(&loaded);
            for (_, frame) in loaded.frames {
                detector.observe(&frame.points, &mut search)?;
            }
        }
    }
    drop((network, detector));
    let mut setup = Setup {
        frames: Some(frames),
        ..Setup::default()
    };
    setup.models.precision = precision;
    setup.models.weights = weights.to_owned();
    let mut evaluator = Evaluator::new(setup)?;
    evaluator.ego.fusion_mut().start_scale_search();
    for scenario in scenarios {
        let _ = evaluator.run(scenario, &mut |_| ControlFlow::Continue(()))?;
    }
    if let Some(fusion) = evaluator.ego.fusion_mut().take_scale_search() {
        search.merge(fusion);
    }
    Ok(search.scales())
}
