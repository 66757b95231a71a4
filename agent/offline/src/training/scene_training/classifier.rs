//! Classifier of a head, trained before its regressor: assigns a sweep to a cluster of sensor positions.

use std::time::Instant;

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use tch::nn::VarStore;
use tch::{Kind, TchError, Tensor, no_grad};

use crate::training::FeatureCache;
use localization::pgc::SceneHead;
use perception::train::{AdamW, AdamWConfig, Length, Observe, RunConfig, TrainingEvent, one_cycle};

/// Largest share of a training by the clock that the classifier takes.
const SHARE_OF_TIME: f64 = 0.12;
/// Number of training steps.
const STEPS: usize = 1500;
const BATCH: usize = 256;
/// Highest learning rate.
const LEARNING_RATE: f64 = 2e-3;
/// Label smoothing, as in LightLoc.
const LABEL_SMOOTHING: f64 = 0.1;

/// Trains with cross entropy and label smoothing; notes the share of training sweeps that are classified correctly.
pub(super) fn train_classifier(
    head: &SceneHead,
    variables: &VarStore,
    cache: &FeatureCache,
    class_of_sweep: &[usize],
    run: &RunConfig,
    observe: &mut Observe<'_>,
) -> Result<(), TchError> {
    let limit = match run.length {
        Length::Time(limit) => Some(limit.mul_f64(SHARE_OF_TIME)),
        Length::Steps(_) | Length::Epochs(_) => None,
    };
    let classes: Vec<i64> = class_of_sweep.iter().map(|&class| class as i64).collect();
    let classes = Tensor::f_from_slice(&classes)?.f_to_device(variables.device())?;
    let mut rng = ChaCha8Rng::seed_from_u64(run.seed);
    let mut optimizer = AdamW::new(variables, AdamWConfig::default());
    let started = Instant::now();
    for step in 0..STEPS {
        let of_time = limit.map_or(0.0, |limit| {
            started.elapsed().as_secs_f64() / limit.as_secs_f64().max(1e-3)
        });
        // Time or steps, whichever ends first; the learning rate follows the same share.
        let share_done = of_time.max(step as f64 / STEPS as f64);
        if share_done >= 1.0 {
            break;
        }
        let rows = (0..BATCH).map(|_| rng.random_range(0..cache.sweep_count()) as i64);
        let rows: Vec<i64> = rows.collect();
        let rows = Tensor::f_from_slice(&rows)?.f_to_device(variables.device())?;
        let logits = head.classify(&cache.sweeps.f_index_select(0, &rows)?, true)?;
        let log_shares = logits.f_log_softmax(1, Kind::Float)?;
        let wanted = classes.f_index_select(0, &rows)?;
        // Cross entropy with label smoothing: a share of it is the mean over all classes.
        let hit = log_shares.f_gather(1, &wanted.f_unsqueeze(1)?, false)?;
        let hit = hit.f_mean(Kind::Float)?;
        let even = log_shares.f_mean(Kind::Float)?;
        let loss = -(hit * (1.0 - LABEL_SMOOTHING) + even * LABEL_SMOOTHING);
        optimizer.zero_grad();
        loss.f_backward()?;
        optimizer.step(one_cycle(LEARNING_RATE, share_done))?;
    }
    let logits = no_grad(|| head.classify(&cache.sweeps, false))?;
    let found = logits.f_argmax(1, false)?.f_eq_tensor(&classes)?;
    let share = found.f_to_kind(Kind::Float)?.f_mean(Kind::Float)?;
    observe(&TrainingEvent::Note(format!(
        "{:.1} % of the training sweeps are assigned to their cluster",
        100.0 * share.f_double_value(&[])?
    )));
    Ok(())
}
