//! PASTAT, the Pose-Aware Spatio-Temporal Alignment Transformer.
//!
//! One module per step, in the order of the paper: coarse alignment (Eq. 2), CE (Eq. 7), FSA, TE (Eq. 10-12),
//! transformer (Eq. 8, 9), decoder. Steps that are not in the paper are in `extensions`. Untrained, all are neutral:
//! the fusion begins as the element-wise maximum.

mod ablation;
mod coarse_alignment;
mod confidence_embedding;
mod config;
mod decoder;
mod extensions;
mod patches;
mod spatial_alignment;
mod temporal_encoding;
mod transformer;

use perception::int8::{ActivationScales, QuantiseError, ScaleSearch};
use perception::model_config::{ConfigError, DetectorConfig};
use tch::{TchError, Tensor, nn};

pub use ablation::{Part, ablated};
pub(crate) use config::PastatConfig;

use self::coarse_alignment::CoarseMaps;
use self::confidence_embedding::ConfidenceEmbedding;
use self::decoder::Decoder;
use self::extensions::map_refinement::MapRefinement;
use self::extensions::temporal_memory::TemporalMemory;
use self::patches::Patches;
use self::spatial_alignment::SpatialAlignment;
use self::transformer::Transformer;
use super::settings::of_size;
use crate::{
    AlignedMaps, Fusion, FusionOutput, FusionSettings, HistorySpec, MethodSpec, Requirements,
};

/// PASTAT.
pub static METHOD: MethodSpec = MethodSpec::of_features::<PastatConfig>(
    "feature maps with history, aligned by confidence and content, transformer (PASTAT)",
);

impl FusionSettings for PastatConfig {
    const KIND: &'static str = "pastat";

    fn for_detector(detector: &DetectorConfig) -> Self {
        of_size(detector, Self::lean, Self::full)
    }

    fn build(&self, path: &nn::Path<'_>) -> Result<Box<dyn Fusion>, ConfigError> {
        Ok(Box::new(Pastat::new(path, self)?))
    }

    fn requirements(&self) -> Requirements {
        Requirements {
            history: HistorySpec {
                frames: self.frames,
                earlier_cells: Some(self.earlier_cells),
                full_resolution: self.temporal_memory.is_some(),
            },
            ..Requirements::default()
        }
    }
}

/// PASTAT between encoder and detection head.
#[derive(Debug)]
pub(crate) struct Pastat {
    config: PastatConfig,
    patches: Patches,
    confidence_embedding: ConfidenceEmbedding,
    spatial_alignment: SpatialAlignment,
    transformer: Transformer,
    decoder: Decoder,
    temporal_memory: Option<TemporalMemory>,
    map_refinement: Option<MapRefinement>,
}

impl Pastat {
    /// Builds the module; its variables lie under `path`.
    ///
    /// # Errors
    /// [`ConfigError`] when it cannot be built.
    pub(crate) fn new(path: &nn::Path<'_>, config: &PastatConfig) -> Result<Self, ConfigError> {
        config.validate()?;
        let (memory, hidden) = (config.temporal_memory.as_ref(), config.map_refinement);
        // Random parameters are drawn in this order.
        Ok(Self {
            config: config.clone(),
            patches: Patches::new(path, config),
            confidence_embedding: ConfidenceEmbedding::new(path, config),
            spatial_alignment: SpatialAlignment::new(path, config),
            transformer: Transformer::new(path, config),
            decoder: Decoder::new(path, config),
            temporal_memory: memory.map(|memory| TemporalMemory::new(path, config, memory)),
            map_refinement: hidden.map(|hidden| MapRefinement::new(path, config.channels, hidden)),
        })
    }

    /// The fused map before its refinement, `[1, C, H, W]`, and the corrections of the poses.
    fn unrefined(&self, maps: &AlignedMaps) -> Result<(Tensor, Option<Tensor>), TchError> {
        let coarse = CoarseMaps::pick(maps, &self.config)?; // Eq. 2
        let confidences = self.confidence_embedding.embed(&coarse.origins)?; // Eq. 7
        let patches = self.patches.flatten(&coarse)?;
        let (fine, aligned, fit) = self.spatial_alignment.align(
            &coarse,
            patches,
            &confidences,
            &maps.grid,
            maps.is_training,
        )?; // FSA
        let of_maps = [&confidences.of_tokens, &fit];
        let ages = &coarse.origins.age_secs;
        let tokens = temporal_encoding::encode(aligned, of_maps, ages, &self.config)?; // Eq. 10-12
        let context = self.transformer.forward(&tokens)?; // Eq. 8, 9
        let mut fused = self.decoder.maximum(&fine, &tokens, &context)?;
        if let Some(memory) = &self.temporal_memory {
            fused = memory.blend(fused, maps, &coarse, &fine, &context)?;
        }
        let corrections = fine
            .corrections
            .map(|corrections| coarse.among_all(&corrections))
            .transpose()?;
        // Without the padding.
        let (_, _, height, width) = maps.warped.features.size4()?;
        let fused = self.decoder.changed(&fused, &context)?;
        let fused = fused.f_narrow(2, 0, height)?.f_narrow(3, 0, width)?;
        Ok((fused, corrections))
    }
}

impl Fusion for Pastat {
    fn fuse(&self, maps: &AlignedMaps) -> Result<FusionOutput, TchError> {
        let (fused, corrections) = self.unrefined(maps)?;
        // The refinement sees the map as the detection head will, after everything else.
        let refined = match &self.map_refinement {
            Some(refinement) => {
                // Without earlier maps the input does not contain the class head.
                let classes = maps.earlier_full_resolution().map(|(_, classes)| classes);
                let likely = classes.map(|classes| classes.likely(&fused)).transpose()?;
                refinement.forward(fused, likely.as_ref(), maps.is_training)?
            }
            None => fused,
        };
        Ok(FusionOutput {
            map: refined
                .f_squeeze_dim(0)?
                .f_to_kind(maps.warped.features.kind())?,
            corrections,
        })
    }

    fn observe(&self, maps: &AlignedMaps, search: &mut ScaleSearch) -> Result<(), TchError> {
        match &self.map_refinement {
            Some(refinement) => refinement.observe(&self.unrefined(maps)?.0, search),
            None => Ok(()),
        }
    }

    fn quantise(&mut self, scales: &ActivationScales) -> Result<(), QuantiseError> {
        self.map_refinement
            .as_mut()
            .map_or(Ok(()), |refinement| refinement.quantise(scales))
    }
}

#[cfg(test)]
mod tests;
