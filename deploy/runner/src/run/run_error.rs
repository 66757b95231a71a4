//! Errors of a run.

use std::path::PathBuf;

use bus::BusError;
use deploy::operate::keys::KeyFileError;
use deploy::operate::run_folder::RunFolderError;
use deploy::operate::supervise::SuperviseError;
use deploy::score::ScorerError;
use ego_fuser_offline::evaluation::EvaluateError;
use protocol::{ProcessId, RunId};

/// Result of a step of a run: a [`RunError`] if nothing else is named.
pub(crate) type Result<T, E = RunError> = std::result::Result<T, E>;

/// Reason why a run failed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// No fleet can be built from the scenario.
    #[error(transparent)]
    Fleet(anyhow::Error),
    /// The run folder cannot be used.
    #[error(transparent)]
    Folder(#[from] RunFolderError),
    /// The processes cannot connect.
    #[error(transparent)]
    Network(#[from] BusError),
    /// Another fleet of that name is present; receivers would reject the messages of both.
    #[error(
        "run {run} is already live on {router}: {}; choose another --name, or end it first",
        processes.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
    )]
    Live {
        /// Name of the run.
        run: RunId,
        /// Endpoint of the router.
        router: String,
        /// Processes to start that are present already.
        processes: Vec<ProcessId>,
    },
    /// No keys could be made for the processes.
    #[error("security: {0}")]
    Keys(#[from] KeyFileError),
    /// The scorer cannot start.
    #[error("scorer: {0}")]
    Scorer(#[from] ScorerError),
    /// The processes cannot be started.
    #[error(transparent)]
    Supervise(#[from] SuperviseError),
    /// Signals cannot be caught.
    #[error("cannot catch Ctrl-C: {0}")]
    Signals(std::io::Error),
    /// A run in simulation time cannot be computed.
    #[error(transparent)]
    Evaluate(Box<EvaluateError>),
    /// A process stays down.
    #[error("{process} {how} (log: {})", log.display())]
    Process {
        /// Name of the process.
        process: String,
        /// Description of its end.
        how: String,
        /// Its log.
        log: PathBuf,
    },
}

impl RunError {
    /// True if the input is at fault, and not the run.
    pub fn is_bad_input(&self) -> bool {
        match self {
            Self::Network(error) | Self::Scorer(ScorerError::Bus(error)) => error.is_bad_input(),
            Self::Fleet(_) | Self::Folder(RunFolderError::Taken(_)) | Self::Live { .. } => true,
            Self::Evaluate(error) => matches!(
                **error,
                EvaluateError::TooSlow { .. } | EvaluateError::Link(_) | EvaluateError::Setting(_)
            ),
            _ => false,
        }
    }

    /// True if the run was refused before any process started, so that its folder holds nothing of use.
    pub(crate) fn is_refusal(&self) -> bool {
        match self {
            Self::Process { .. } | Self::Folder(_) => false,
            Self::Evaluate(_) => self.is_bad_input(),
            _ => true,
        }
    }
}

impl From<EvaluateError> for RunError {
    fn from(error: EvaluateError) -> Self {
        Self::Evaluate(Box::new(error))
    }
}
