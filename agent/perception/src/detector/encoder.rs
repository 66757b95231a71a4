//! Canvas, backbone and shrink of a detector, in floating point or in 8-bit integers.

use tch::{Device, Tensor};

use super::backbone_level::BackboneLevel;
use super::int8_backbone::{CANVAS, Int8Backbone, observe_backbone};
use crate::int8::{ActivationScales, Quantisation, QuantiseError, ScaleSearch};
use crate::layers::backbone::BevBackbone;
use crate::layers::shrink::Shrink;
use crate::pillars::batch::PillarGrid;
use crate::pillars::point_pillars::PointPillars;
use crate::pillars::projection::PillarProjection;
use crate::pillars::voxels::Pillars;

/// From pillars to the feature map.
#[derive(Debug)]
pub(super) struct BevEncoder {
    pillar_grid: PillarGrid,
    projection: PillarProjection,
    /// Of the layers.
    device: Device,
    layers: Layers,
}

#[derive(Debug)]
enum Layers {
    Float {
        canvas: Vec<f32>,
        backbone: BevBackbone,
        /// Without layers where there is none.
        shrink: Shrink,
    },
    Int8 {
        canvas: Vec<u8>,
        quantisation: Quantisation,
        backbone: Int8Backbone,
    },
}

impl BevEncoder {
    /// The encoder of a network, its layers folded, in floating point.
    pub(super) fn new(network: &PointPillars) -> Self {
        let projection = PillarProjection::new(&network.encoder);
        let canvas = vec![0.0; canvas_len(&network.pillar_grid, &projection)];
        Self {
            pillar_grid: network.pillar_grid,
            projection,
            device: network.device(),
            layers: Layers::Float {
                canvas,
                backbone: network.backbone.folded(),
                shrink: network.shrink.folded(),
            },
        }
    }

    /// The same in integers, if its layers can be quantised.
    pub(super) fn quantised(self, scales: &ActivationScales) -> Result<Self, QuantiseError> {
        let Layers::Float {
            backbone, shrink, ..
        } = &self.layers
        else {
            return Ok(self);
        };
        let Some(backbone) = Int8Backbone::new(backbone, shrink, scales)? else {
            return Ok(self);
        };
        let canvas = vec![0; canvas_len(&self.pillar_grid, &self.projection)];
        let layers = Layers::Int8 {
            canvas,
            quantisation: scales.get(CANVAS)?,
            backbone,
        };
        Ok(Self { layers, ..self })
    }

    /// True if its layers are in integers.
    pub(super) fn is_quantised(&self) -> bool {
        matches!(self.layers, Layers::Int8 { .. })
    }

    /// Writes pillars to the canvas: `[1, C_pillar, H, W]`, channels innermost in memory.
    pub(super) fn scatter(&mut self, pillars: &Pillars) -> tch::Result<Tensor> {
        let (pillar_grid, projection) = (&self.pillar_grid, &self.projection);
        let flat = match &mut self.layers {
            Layers::Float { canvas, .. } => {
                canvas.fill(0.0);
                projection.scatter(pillars, pillar_grid, canvas);
                Tensor::f_from_slice(canvas)
            }
            Layers::Int8 {
                canvas,
                quantisation,
                ..
            } => {
                // Pillar features end with a ReLU, so that their zero point is 0.
                canvas.fill(0);
                projection.scatter_quantised(pillars, pillar_grid, *quantisation, canvas);
                Tensor::f_from_slice(canvas)
            }
        };
        let [height, width] = [pillar_grid.height, pillar_grid.width].map(|size| size as i64);
        let canvas = flat?.f_view([1, height, width, -1])?;
        let canvas = canvas.f_to_device(self.device)?;
        canvas.f_permute([0, 3, 1, 2])
    }

    /// Levels of the backbone for a canvas.
    pub(super) fn levels(&self, canvas: &Tensor) -> tch::Result<Vec<BackboneLevel>> {
        match &self.layers {
            Layers::Float { backbone, .. } => {
                let maps = backbone.levels_of(canvas, false).into_iter();
                Ok(maps.map(|map| BackboneLevel::new(map, None)).collect())
            }
            Layers::Int8 { backbone, .. } => backbone.levels(canvas),
        }
    }

    /// Feature map `[1, C, H', W']` of the levels of a canvas, contiguous.
    pub(super) fn features(&self, levels: &[BackboneLevel]) -> tch::Result<Tensor> {
        let maps = levels.iter().map(|level| level.values.shallow_clone());
        let maps: Vec<Tensor> = maps.collect();
        match &self.layers {
            Layers::Float {
                backbone, shrink, ..
            } => shrink.forward_contiguous(&backbone.upsampled(&maps, false)),
            Layers::Int8 { backbone, .. } => backbone.features(&maps),
        }
    }

    /// Adds the activations of a canvas to a search for their scales; nothing if the layers are in integers already.
    pub(super) fn observe(&self, canvas: &Tensor, search: &mut ScaleSearch) -> tch::Result<()> {
        match &self.layers {
            Layers::Float {
                backbone, shrink, ..
            } => observe_backbone(backbone, shrink, canvas, search),
            Layers::Int8 { .. } => Ok(()),
        }
    }
}

fn canvas_len(pillar_grid: &PillarGrid, projection: &PillarProjection) -> usize {
    pillar_grid.width * pillar_grid.height * projection.channels
}
