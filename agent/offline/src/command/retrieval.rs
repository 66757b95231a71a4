//! Retrieval in `agent eval`: databases of sweeps, and what they are compared by.

use std::path::PathBuf;

use agent_offline::Error;
use agent_offline::sweep_database::described_sweeps;
use dataset::LeftOut;
use localization::baselines::{DescribePolar, PolarRetrieval, Retrieval, SweepDatabase};
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

/// Retrieval by the encoder of a localizer.
pub(crate) fn by_encoder(
    folders: &[PathBuf],
    localizer: Localizer,
    left_out: &mut LeftOut,
) -> Result<Box<dyn Localize>, BadInput> {
    let sweeps = described(folders, left_out, |cloud| {
        localizer.sweep_features(cloud, &mut stopwatch())
    })?;
    let database = SweepDatabase::new(&sweeps);
    let database = database.ok_or_else(|| Error::NoSweeps(folders.to_vec(), left_out.reasons()));
    let database = database.map_err(BadInput::of)?;
    Ok(Box::new(Retrieval {
        localizer,
        database,
    }))
}

/// Retrieval by polar descriptors.
pub(crate) fn by_descriptor(
    folders: &[PathBuf],
    descriptor: Box<dyn DescribePolar>,
    left_out: &mut LeftOut,
) -> Result<Box<dyn Localize>, BadInput> {
    let sweeps = described(folders, left_out, |cloud| {
        descriptor.polar(cloud, &mut stopwatch())
    })?;
    let retrieval = PolarRetrieval::new(descriptor, sweeps).map_err(BadInput::of)?;
    Ok(Box::new(retrieval))
}

/// Poses of all sweeps.
pub(crate) fn positions(
    folders: &[PathBuf],
    left_out: &mut LeftOut,
) -> Result<Vec<Isometry3<f64>>, BadInput> {
    let sweeps = described(folders, left_out, |_| Ok::<_, LocalizerError>(Some(())))?;
    Ok(sweeps.into_iter().map(|((), pose)| pose).collect())
}

/// Descriptors of all sweeps of the drives, each with its pose; shows a progress bar. Sweeps without a descriptor are left out.
fn described<D, E: Into<LocalizerError>>(
    folders: &[PathBuf],
    left_out: &mut LeftOut,
    mut describe: impl FnMut(&PointCloud) -> Result<Option<D>, E>,
) -> Result<Vec<(D, Isometry3<f64>)>, BadInput> {
    let bar = progress::bar(0, "sweeps described");
    let mut on_sweep = progress::shown_on(&bar);
    let sweeps = described_sweeps(folders, &mut describe, left_out, &mut on_sweep);
    sweeps.map_err(BadInput::of)
}
