//! Retrieval in `agent eval`: databases of sweeps, and what they are compared by.

use std::path::PathBuf;

use agent_offline::sweep_database::{described_sweeps, read_database};
use dataset::LeftOut;
use indicatif::ProgressBar;
use localization::baselines::{DescribePolar, PolarRetrieval, Retrieval};
use localization::pgc::{Localize, Localizer, LocalizerError, stopwatch};
use nalgebra::Isometry3;
use protocol::PointCloud;
use support::cli::BadInput;
use terminal::progress;

/// Descriptor of a sweep for retrieval.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, clap::ValueEnum)]
pub(crate) enum RetrievalBy {
    /// Features of the encoder, of the whole sweep; with --baseline its tokens, in all directions of the sensor.
    #[default]
    Encoder,
    /// Scan Context: greatest heights in rings and sectors, in all directions of the sensor.
    ScanContext,
    /// The true position: an oracle, the most that retrieval can give.
    Position,
}

/// Unit of the progress.
const DESCRIBED: &str = "sweeps described";

/// Retrieval by the encoder of a localizer.
pub(crate) fn by_encoder(
    folders: &[PathBuf],
    localizer: Localizer,
    left_out: &mut LeftOut,
) -> Result<Box<dyn Localize>, BadInput> {
    let bar = Bar::start(DESCRIBED);
    let database = read_database(folders, &localizer, left_out, &mut bar.advance());
    let database = database.map_err(BadInput::of)?;
    Ok(Box::new(Retrieval::new(localizer, database)))
}

/// Retrieval by polar descriptors.
pub(crate) fn by_descriptor(
    folders: &[PathBuf],
    descriptor: Box<dyn DescribePolar>,
    left_out: &mut LeftOut,
) -> Result<Box<dyn Localize>, BadInput> {
    let bar = Bar::start(DESCRIBED);
    let mut describe = |cloud: &PointCloud| descriptor.polar(cloud, &mut stopwatch());
    let sweeps = described_sweeps(folders, &mut describe, left_out, &mut bar.advance());
    let sweeps = sweeps.map_err(BadInput::of)?;
    let retrieval = PolarRetrieval::new(descriptor, sweeps).map_err(BadInput::of)?;
    Ok(Box::new(retrieval))
}

/// Poses of all sweeps.
pub(crate) fn positions(
    folders: &[PathBuf],
    left_out: &mut LeftOut,
) -> Result<Vec<Isometry3<f64>>, BadInput> {
    let bar = Bar::start(DESCRIBED);
    let mut describe = |_: &PointCloud| Ok::<_, LocalizerError>(Some(()));
    let sweeps = described_sweeps(folders, &mut describe, left_out, &mut bar.advance());
    let sweeps = sweeps.map_err(BadInput::of)?.into_iter();
    Ok(sweeps.map(|((), pose)| pose).collect())
}

/// Progress bar that ends with its scope.
pub(super) struct Bar(ProgressBar);

impl Bar {
    pub(super) fn start(unit: &str) -> Self {
        Self(progress::bar(0, unit))
    }

    pub(super) fn advance(&self) -> impl FnMut(usize, usize) + '_ {
        |done, all| {
            self.0.set_length(all as u64);
            self.0.set_position(done as u64);
        }
    }
}

impl Drop for Bar {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
