//! Trees and bushes.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::super::curve::Pose2;
use super::super::{Shape, Solid, SolidKind};
use super::frontage::{Zone, sides};
use super::parts::PartFootprint;
use super::site::Site;

/// Kinds of trees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Species {
    Broadleaf,
    Conifer,
    Columnar,
    Bush,
}

impl Species {
    pub(super) fn random(rng: &mut ChaCha8Rng) -> Self {
        match rng.random_range(0..10) {
            0..=4 => Self::Broadleaf,
            5..=6 => Self::Conifer,
            7 => Self::Columnar,
            _ => Self::Bush,
        }
    }
}

/// Trunk and crown; `size` is about 1 for a grown tree.
pub(super) fn tree(
    foot: PartFootprint,
    species: Species,
    size: f64,
    rng: &mut ChaCha8Rng,
) -> Vec<Solid> {
    let leaves = rng.random_range(0.2..0.45);
    match species {
        Species::Broadleaf => {
            let clear = rng.random_range(1.8..3.0) * size;
            let [rx, ry, rz] =
                [1.4..2.6, 1.4..2.6, 1.3..2.4].map(|range| rng.random_range(range) * size);
            let mut parts = vec![
                trunk(foot, rng.random_range(0.12..0.28) * size, clear + rz),
                crown(foot, [0.0, 0.0, clear + rz], [rx, ry, rz], leaves),
            ];
            // Large crowns are lobed.
            if size > 0.9 {
                let turn: f64 = rng.random_range(0.0..std::f64::consts::TAU);
                let at = [
                    0.6 * rx * turn.cos(),
                    0.6 * ry * turn.sin(),
                    clear + rz * rng.random_range(1.1..1.6),
                ];
                parts.push(crown(foot, at, [0.7 * rx, 0.7 * ry, 0.7 * rz], leaves));
            }
            parts
        }
        Species::Conifer => {
            let height = rng.random_range(6.0..13.0) * size;
            let radius = height * rng.random_range(0.13..0.2);
            let mut parts = vec![trunk(foot, 0.16 * size, height * 0.5)];
            for (level, share) in [(0.28, 1.0), (0.52, 0.72), (0.76, 0.42)] {
                let radii = [radius * share, radius * share, 0.22 * height];
                parts.push(crown(foot, [0.0, 0.0, level * height], radii, leaves));
            }
            parts
        }
        Species::Columnar => {
            let height = rng.random_range(7.0..14.0) * size;
            let radius = rng.random_range(0.7..1.2) * size;
            let radii = [radius, radius, 0.45 * height];
            vec![
                trunk(foot, 0.14 * size, height * 0.4),
                crown(foot, [0.0, 0.0, 0.55 * height], radii, leaves),
            ]
        }
        Species::Bush => {
            let radius = rng.random_range(0.5..1.1) * size;
            let height = rng.random_range(0.5..1.0) * size;
            let (at, radii_m) = ([0.0, 0.0, height * 0.7], [radius, radius * 0.9, height]);
            vec![foot.solid(SolidKind::Hedge, Shape::Ellipsoid { radii_m }, at, leaves)]
        }
    }
}

fn trunk(foot: PartFootprint, radius_m: f64, height_m: f64) -> Solid {
    foot.post(SolidKind::TreeTrunk, -0.3, [radius_m, height_m + 0.3], 0.25)
}

fn crown(foot: PartFootprint, at: [f64; 3], radii_m: [f64; 3], leaves: f32) -> Solid {
    let shape = Shape::Ellipsoid { radii_m };
    foot.solid(SolidKind::TreeCrown, shape, at, leaves)
}

/// Plants a tree at a pose on the ground, if all of it finds room.
pub(super) fn plant(site: &mut Site, pose: Pose2, kind: Species, size: f64, rng: &mut ChaCha8Rng) {
    let parts = tree(site.foot(pose), kind, size, rng);
    // Crowns may touch; the trunk keeps its distance from walls and poles by the crown around it.
    site.try_place(&parts, 0.0, false);
}

/// Rows of street trees on broad pavements and verges, one species and rhythm a street.
pub(super) fn place_along_streets(site: &mut Site, rng: &mut ChaCha8Rng) {
    for side in sides(site.network) {
        if side.zone != Zone::Street
            || side.pavement_m(site, side.length_m / 2.0) < 2.2
            || rng.random_bool(0.35)
        {
            continue;
        }
        let species = if rng.random_bool(0.8) {
            Species::Broadleaf
        } else {
            Species::Columnar
        };
        let (rhythm, size) = (rng.random_range(8.0..18.0), rng.random_range(0.55..0.95));
        let mut s = rng.random_range(4.0..14.0);
        while s < side.length_m - 4.0 {
            if rng.random_bool(0.85) {
                let pose = side.beyond_kerb(site, s, rng.random_range(0.7..1.0));
                let size = size * rng.random_range(0.85..1.15);
                plant(site, pose, species, size, rng);
            }
            s += rhythm * rng.random_range(0.8..1.25);
        }
    }
}
