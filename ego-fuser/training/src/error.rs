//! Error of samples, stored maps and trainings.

use dataset::ReadError;
use figures::FigureError;
use fusion::method::Method;
use fusion::model::ModelError;
use localization::pose_source::PoseSourceError;
use perception::detector::DetectorError;
use perception::torch_error::first_line;
use perception::train::TrainingError;
use perception::weights::FileError;
use tch::TchError;

/// Result of making samples or training: a [`Error`] if nothing else is named.
pub(crate) type Result<T, E = Error> = std::result::Result<T, E>;

/// Reason why there is no next sample or no stored map, or why a training ended early.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// A file of a data set is missing or malformed.
    #[error(transparent)]
    Read(#[from] ReadError),
    /// A file cannot be read, written or used.
    #[error(transparent)]
    File(#[from] FileError),
    /// The data cannot be used; the text names them, and what is needed.
    #[error("{0}")]
    Data(String),
    /// The settings of the pose error are invalid.
    #[error(transparent)]
    Poses(#[from] PoseSourceError),
    /// The frozen encoder cannot be built or run.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// The model cannot be built or run.
    #[error(transparent)]
    Model(#[from] ModelError),
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
    Picture(#[from] FigureError),
    /// The tensor library failed.
    #[error("training: {}", first_line(.0))]
    Torch(#[from] TchError),
}
