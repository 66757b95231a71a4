//! Scene geometry for ray casting and driving.

use super::raycast::{Bounds, Convex, Course, Placement, Plane, RayBody, SolidShape, Surface};
use super::terrain::{TerrainSurface, deck_shape};
use super::traffic::Roads;
use crate::map::{LaneIndex, MapModel, Shape, Solid, Terrain};

/// A map prepared for ray casting and driving.
pub(crate) struct World<'t> {
    pub(crate) map_model: &'t MapModel,
    pub(crate) roads: Roads<'t>,
    pub(crate) lane_index: LaneIndex,
    pub(crate) ground: Box<dyn Surface + Send + Sync>,
    standing: Vec<StaticObject>,
}

/// A static object.
struct StaticObject {
    shape: SolidShape,
    placement: Placement,
    /// Radius of the circle around it, seen from above, metres.
    radius_m: f64,
}

impl<'t> World<'t> {
    pub(crate) fn new(map_model: &'t MapModel) -> Self {
        // Decks are bodies, since the ground has only one height at a place.
        let decks = map_model.ground.decks.iter().filter_map(deck_shape);
        let decks = decks.map(|(shape, center_m)| (shape, Placement::level(center_m, 0.0)));
        let solids = map_model.solids.iter().map(|solid| {
            let placement = Placement::level(solid.center_m, solid.yaw_rad);
            (SolidShape::from(solid), placement)
        });
        let standing = solids.chain(decks).map(|(shape, placement)| StaticObject {
            radius_m: shape.bounds.radius_m(),
            shape,
            placement,
        });
        Self {
            map_model,
            roads: Roads::new(&map_model.lanes),
            lane_index: LaneIndex::new(&map_model.lanes),
            ground: ground_surface(map_model),
            standing: standing.collect(),
        }
    }

    /// Appends static objects within `radius_m` of a position.
    pub(crate) fn standing_near(
        &self,
        [x_m, y_m]: [f64; 2],
        radius_m: f64,
    ) -> impl Iterator<Item = RayBody<'_>> {
        self.standing.iter().filter_map(move |standing| {
            let position = standing.placement.position_m;
            let (dx, dy) = (position.x - x_m, position.y - y_m);
            let reach = radius_m + standing.radius_m;
            let is_near = dx * dx + dy * dy < reach * reach;
            is_near.then(|| RayBody {
                shape: &standing.shape,
                motion: Course::still(standing.placement),
            })
        })
    }
}

/// The ground of a map, without its decks, as a surface for ray casting.
pub fn ground_surface(map_model: &MapModel) -> Box<dyn Surface + Send + Sync> {
    match &map_model.ground.terrain {
        Terrain::Plane { z_m } => Box::new(Plane(*z_m)),
        Terrain::Grid(grid) => Box::new(TerrainSurface::new(grid)),
    }
}

impl From<&Solid> for SolidShape {
    fn from(solid: &Solid) -> Self {
        let part = match solid.shape {
            Shape::Box { half_m } => {
                Convex::Box(Bounds::centered([0.0; 3], half_m.map(|half| half as f32)))
            }
            Shape::Cylinder {
                radius_m,
                half_height_m,
            } => Convex::Cylinder {
                radius_m: radius_m as f32,
                half_height_m: half_height_m as f32,
            },
            Shape::Ellipsoid { radii_m } => Convex::Ellipsoid {
                radii_m: radii_m.map(|radius| radius as f32),
            },
        };
        Self::new(vec![part], solid.reflectivity)
    }
}
