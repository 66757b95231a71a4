//! Errors of a training.

use perception::train::TrainingError;

use crate::samples::SampleError;
use fusion::method::Method;
use fusion::model::ModelError;

/// Reason why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum TrainError {
    /// The model cannot be built or run.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// There is no next sample.
    #[error(transparent)]
    Sample(#[from] SampleError),
    /// The training itself has failed.
    #[error(transparent)]
    Training(#[from] TrainingError),
    /// The method cannot be trained.
    #[error("method {0} exchanges boxes and is not trained; train `none` and use its weights")]
    NotTrained(Method),
    /// A frozen encoder needs trained weights.
    #[error("a frozen encoder needs weights to begin with")]
    NothingToFreeze,
    /// Points are merged before they are encoded, so there are no maps to store.
    #[error(
        "method {0} puts points together before the encoder and cannot be trained behind a frozen one"
    )]
    NothingToKeep(Method),
    /// The picture of the curve cannot be written.
    #[error(transparent)]
    Picture(#[from] figures::FigureError),
    /// The tensor library reported an error.
    #[error("training: {0}")]
    Torch(#[from] tch::TchError),
}
