//! Encoder of cells: features of the parts of a sweep that scene coordinates are regressed for.
//!
//! Two encoders: sparse convolutions that were trained for localization, and the levels of a detector's backbone, which
//! a vehicle that detects has computed anyway.

mod backbone;
mod bev_cells;

use std::ops::Range;
use std::path::Path;

use perception::detector::{BackboneLevel, encoder_sha256};
use perception::int8::{ActivationScales, QuantiseError, ScaleSearch};
use perception::weights::Weights;
use tch::{Device, Kind};

pub use bev_cells::{BevCells, BevFormat};

use super::encoder_config::SceneEncoderConfig;
use super::error::{LocalizerError, Result};
use super::scene_encoder::{SceneEncoder, SceneFeatures};
use super::voxel_batch::VoxelBatch;
use super::voxelise::{SweepCell, SweepVoxels};
use backbone::BackboneEncoder;

/// An encoder and the device that it computes on.
#[derive(Debug)]
pub struct CellEncoder {
    network: CellNetwork,
    format: SweepFormat,
    device: Device,
}

#[derive(Debug)]
enum CellNetwork {
    Sparse(Box<SceneEncoder>),
    Backbone(Box<BackboneEncoder>),
}

/// Parts of a sweep that an encoder takes, and the channels of what it returns.
#[derive(Debug, Clone, PartialEq)]
pub enum SweepFormat {
    /// Voxels of sparse convolutions.
    Voxels(SceneEncoderConfig),
    /// BEV cells of a detector.
    Bev(BevFormat),
}

/// One sweep, ready for an encoder: everything that needs no tensors.
#[derive(Debug, Clone)]
pub enum PreparedSweep {
    /// For sparse convolutions.
    Voxels(SweepVoxels),
    /// For a detector's backbone.
    Bev(BevCells),
}

/// Features of some sweeps.
#[derive(Debug)]
pub struct EncodedCells {
    /// Of all cells, sweep after sweep, and of the sweeps.
    pub features: SceneFeatures,
    /// Rows of each sweep's cells.
    pub rows: Vec<Range<i64>>,
}

impl CellEncoder {
    /// Reads the encoder of a weights file: a scene encoder, or the one inside a detector. Returns the SHA-256 that a
    /// head names it by beside it: of the file, or of the detector's encoder, which files of several methods share.
    ///
    /// A detector's backbone always computes in the number format of its file, on the CPU, as for the training of the
    /// head: the levels of another format are others.
    ///
    /// # Errors
    /// [`LocalizerError`] when the file is missing, truncated or of another kind.
    pub fn load(path: &Path, device: Device) -> Result<(Self, String)> {
        let weights = Weights::load(path)?;
        let encoder = if BackboneEncoder::is_in(&weights) {
            let encoder = Box::new(BackboneEncoder::of_detector(&weights, device)?);
            Self {
                format: SweepFormat::Bev(encoder.format.clone()),
                network: CellNetwork::Backbone(encoder),
                device,
            }
        } else {
            Self::sparse(SceneEncoder::from_weights(&weights, device)?, device)
        };
        Ok((encoder, Self::sha256_of(&weights)))
    }

    /// SHA-256 that a head names the encoder of a file by, see [`Self::load`].
    pub fn sha256_of(weights: &Weights) -> String {
        match BackboneEncoder::is_in(weights) {
            true => encoder_sha256(weights),
            false => weights.sha256().to_owned(),
        }
    }

    /// A scene encoder on its device.
    pub fn sparse(encoder: SceneEncoder, device: Device) -> Self {
        Self {
            format: SweepFormat::Voxels(encoder.config().clone()),
            network: CellNetwork::Sparse(Box::new(encoder)),
            device,
        }
    }

    /// Format of its sweeps.
    pub fn format(&self) -> &SweepFormat {
        &self.format
    }

    /// Features of some sweeps, without gradients; in integers where quantised, otherwise sparse convolutions in `kind`
    /// and a backbone in single precision.
    ///
    /// # Errors
    /// [`LocalizerError`] when a sweep has another format, or the tensor library fails.
    pub fn encode(&self, sweeps: &[&PreparedSweep], kind: Kind) -> Result<EncodedCells> {
        match &self.network {
            CellNetwork::Sparse(encoder) => {
                let batch = self.batch(encoder, sweeps)?;
                let (features, rows) = (encoder.encode(&batch, kind)?, batch.cell_rows);
                Ok(EncodedCells { features, rows })
            }
            CellNetwork::Backbone(encoder) => {
                let cells: Result<Vec<_>, _> = sweeps.iter().map(|sweep| sweep.bev()).collect();
                encoder.encode(&cells?)
            }
        }
    }

    /// Features of one sweep, as [`Self::encode`] in single precision. A backbone uses `levels`, those of the sweep, if
    /// they are given in its number format.
    pub(super) fn encode_one(
        &self,
        sweep: &PreparedSweep,
        levels: Option<&[BackboneLevel]>,
    ) -> Result<SceneFeatures> {
        match (&self.network, levels) {
            (CellNetwork::Backbone(encoder), Some(levels)) if encoder.takes(levels) => {
                encoder.features(sweep.bev()?, levels)
            }
            _ => Ok(self.encode(&[sweep], Kind::Float)?.features),
        }
    }

    /// Computes in integers from here on, if its scales are stored with the head: a detector has its own.
    ///
    /// # Errors
    /// [`QuantiseError`] names the activation whose scale is missing.
    pub fn quantise(&mut self, scales: &ActivationScales) -> Result<(), QuantiseError> {
        match &mut self.network {
            CellNetwork::Sparse(encoder) => encoder.quantise(scales),
            CellNetwork::Backbone(_) => Ok(()),
        }
    }

    /// Adds the activations that [`Self::quantise`] needs scales of.
    ///
    /// # Errors
    /// As [`Self::encode`].
    pub fn observe(&self, sweep: &PreparedSweep, search: &mut ScaleSearch) -> Result<()> {
        if let CellNetwork::Sparse(encoder) = &self.network {
            encoder.observe(&self.batch(encoder, &[sweep])?, search)?;
        }
        Ok(())
    }

    fn batch(&self, encoder: &SceneEncoder, sweeps: &[&PreparedSweep]) -> Result<VoxelBatch> {
        let voxels: Result<Vec<_>, _> = sweeps.iter().map(|sweep| sweep.voxels()).collect();
        Ok(VoxelBatch::new(&voxels?, encoder.config(), self.device)?)
    }
}

impl SweepFormat {
    /// Prepares points `[N]` of x, y, z (metres, sensor frame) and intensity; those out of range or not finite are left
    /// out.
    pub fn prepare(&self, points: &[[f32; 4]]) -> PreparedSweep {
        match self {
            Self::Voxels(config) => {
                let points = points.iter().map(|&[x, y, z, _]| [x, y, z]);
                PreparedSweep::Voxels(SweepVoxels::new(points, config))
            }
            Self::Bev(format) => PreparedSweep::Bev(BevCells::new(points, format)),
        }
    }

    /// Largest horizontal distance of a point that enters the features, metres.
    pub fn range_m(&self) -> f64 {
        match self {
            Self::Voxels(config) => config.range_m,
            Self::Bev(format) => format.range_m,
        }
    }

    /// Channels of a cell before its surroundings are added.
    pub fn local_channels(&self) -> i64 {
        match self {
            Self::Voxels(config) => config.local_channels(),
            Self::Bev(format) => format.local_channels(),
        }
    }

    /// Channels of a cell.
    pub fn cell_channels(&self) -> i64 {
        match self {
            Self::Voxels(config) => config.cell_channels(),
            Self::Bev(format) => format.cell_channels(),
        }
    }

    /// Channels of a whole sweep.
    pub fn sweep_channels(&self) -> i64 {
        match self {
            Self::Voxels(config) => config.sweep_channels(),
            Self::Bev(format) => format.sweep_channels(),
        }
    }
}

impl PreparedSweep {
    /// The cells, in the order of the encoder's rows.
    pub fn cells(&self) -> &[SweepCell] {
        match self {
            Self::Voxels(voxels) => voxels.cells(),
            Self::Bev(sweep) => &sweep.cells,
        }
    }

    fn voxels(&self) -> Result<&SweepVoxels> {
        let problem = "BEV cells of a detector, must be voxels";
        match self {
            Self::Voxels(voxels) => Ok(voxels),
            Self::Bev(_) => Err(LocalizerError::Config(problem.into())),
        }
    }

    fn bev(&self) -> Result<&BevCells> {
        let problem = "voxels, must be BEV cells of a detector";
        match self {
            Self::Bev(cells) => Ok(cells),
            Self::Voxels(_) => Err(LocalizerError::Config(problem.into())),
        }
    }
}
