//! Why a training ends early.

use perception::train::TrainingError;

use crate::samples::SampleError;
use fusion::method::Method;
use fusion::model::ModelError;

/// Why a training ended early.
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
    /// An encoder that does not learn must have learnt before.
    #[error("a frozen encoder needs weights to begin with")]
    NothingToFreeze,
    /// Points are put together before they are encoded, so there are no maps to keep.
    #[error("method {0} puts points together before the encoder and cannot be trained behind a frozen one")]
    NothingToKeep(Method),
    /// The picture of the curve cannot be written.
    #[error(transparent)]
    Picture(#[from] figures::FigureError),
    /// The tensor library refused.
    #[error("training: {0}")]
    Torch(#[from] tch::TchError),
}
