//! Pairs of overlapping sweeps, with the matches of their cells.

use std::collections::HashMap;
use std::f64::consts::PI;
use std::sync::Arc;

use nalgebra::{Isometry3, Point3, Rotation3};
use rand::seq::{IndexedRandom, SliceRandom};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::sweep_store::{StoredSweep, SweepStore, heading_rad, yaw};
use crate::Error;
use localization::pgc::{SceneEncoderConfig, SweepCell, SweepVoxels};

/// Largest distance of the sensors of a pair in the plane, metres.
const PAIR_RANGE_M: f64 = 12.0;
/// Distance below which cells match, metres.
const MATCH_M: f32 = 1.5;
/// Probability that the partner is of another drive, if there is one: other traffic, often the other direction.
const OTHER_DRIVE: f64 = 0.7;
/// Smallest share of points that is kept.
const MIN_KEPT: f64 = 0.6;
/// Number of cells of each sweep in one loss.
const CELLS: usize = 640;
/// Number of pairs that are tried before an error is returned.
const TRIES: usize = 200;
/// Largest share of those cells that may be flat ground.
const FLAT_SHARE: f64 = 0.25;

/// Largest roll and pitch, radians.
const MAX_LEAN_RAD: f64 = 0.03;

/// Cells of one sweep of a pair that enter the loss.
#[derive(Debug)]
pub(crate) struct ChosenCells {
    /// The sweep, rotated at random.
    pub sweep: SweepVoxels,
    /// `[n]`: indices of its cells.
    pub rows: Vec<usize>,
    /// `[n]`: positions, metres in the world of the pair (its origin near the sensors).
    pub places_m: Vec<[f32; 3]>,
    /// Rotation part of `sensor_from_world`.
    pub sensor_from_world: Rotation3<f32>,
}

/// Two sweeps of the same place.
#[derive(Debug)]
pub(crate) struct Pair {
    /// The sweep whose cells are the queries.
    pub anchor: ChosenCells,
    /// The sweep whose cells are the candidates.
    pub partner: ChosenCells,
    /// For each chosen cell of the anchor the index in `partner.rows` of its match.
    pub matches: Vec<usize>,
    /// Heading of the partner relative to the anchor, radians.
    pub relative_yaw_rad: f64,
}

/// Generator of pairs, each a function of the seed and its number.
#[derive(Debug, Clone)]
pub(crate) struct PairMaker {
    store: Arc<SweepStore>,
    config: SceneEncoderConfig,
    seed: u64,
    /// For each sweep those in range, of its own drive and of others.
    partners: Arc<Vec<[Vec<u32>; 2]>>,
    /// Sweeps that have a partner.
    pub(crate) anchors: Arc<Vec<u32>>,
}

impl PairMaker {
    /// Finds the overlapping sweeps of each sweep.
    ///
    /// # Errors
    /// [`Error::Input`] when no two sweeps overlap.
    pub(crate) fn new(
        store: Arc<SweepStore>,
        config: SceneEncoderConfig,
        seed: u64,
    ) -> Result<Self, Error> {
        let partners = partners(&store);
        let anchors: Vec<u32> = (0..partners.len() as u32)
            .filter(|&index| !partners[index as usize].iter().all(Vec::is_empty))
            .collect();
        if anchors.is_empty() {
            return Err(Error::Input(format!(
                "no two sweeps of one world within {PAIR_RANGE_M} m of each other"
            )));
        }
        Ok(Self {
            store,
            config,
            seed,
            partners: Arc::new(partners),
            anchors: Arc::new(anchors),
        })
    }

    /// Pair `number`.
    ///
    /// # Errors
    /// [`Error::Input`] when neighbouring sweeps have no matching cells, for example because they are empty.
    pub(crate) fn pair(&self, number: u64) -> Result<Pair, Error> {
        // A stream for each number: a pair does not depend on the thread that makes it.
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(number);
        for _ in 0..TRIES {
            let anchor = self.anchors[rng.random_range(0..self.anchors.len())] as usize;
            let [own, other] = &self.partners[anchor];
            let takes_other = own.is_empty() || (!other.is_empty() && rng.random_bool(OTHER_DRIVE));
            let among = if takes_other { other } else { own };
            let Some(&partner) = among.choose(&mut rng) else {
                continue;
            };
            let pair = self.build(anchor, partner as usize, &mut rng);
            if !pair.matches.is_empty() {
                return Ok(pair);
            }
        }
        Err(Error::Input(format!(
            "{TRIES} pairs of sweeps side by side have no cell at the same spot: are the sweeps empty?"
        )))
    }

    fn build(&self, anchor: usize, partner: usize, rng: &mut ChaCha8Rng) -> Pair {
        // Positions near the anchor are small enough for f32.
        let origin = self.store.sweeps[anchor].world_from_sensor.translation;
        let turned = [anchor, partner].map(|index| {
            let stored = &self.store.sweeps[index];
            // A car rolls and pitches a little, whatever its recorded pose.
            let [roll, pitch] =
                std::array::from_fn(|_| rng.random_range(-MAX_LEAN_RAD..MAX_LEAN_RAD));
            let turned_from_sensor = Isometry3::rotation(nalgebra::Vector3::new(roll, pitch, 0.0))
                * yaw(rng.random_range(-PI..PI));
            let keep = rng.random_range(MIN_KEPT..1.0);
            let sweep = stored.turned_voxels(&turned_from_sensor, keep, rng, &self.config);
            let world_from_sensor = origin.inverse() * stored.world_from_sensor;
            (sweep, world_from_sensor * turned_from_sensor.inverse())
        });
        let [(anchor_sweep, world_from_anchor), turned_partner] = turned;
        let (sweep, world_from_partner) = turned_partner;
        let anchor_places = places(anchor_sweep.cells(), &world_from_anchor);
        let partner_places = places(sweep.cells(), &world_from_partner);
        let grid = CubeIndex::new(&partner_places);
        let candidates = choose(anchor_sweep.cells(), CELLS, rng);
        let matched = candidates
            .into_iter()
            .filter_map(|cell| Some((cell, grid.nearest(anchor_places[cell])?)));
        let matched: Vec<(usize, usize)> = matched.collect();
        // The partners of the anchor's cells, and others as negatives.
        let mut rows: Vec<usize> = matched.iter().map(|&(_, partner)| partner).collect();
        rows.extend(choose(sweep.cells(), CELLS, rng));
        // Each candidate occurs once: the map has its index among the distinct rows.
        let mut seen = HashMap::new();
        let mut distinct = Vec::new();
        for row in rows {
            seen.entry(row).or_insert_with(|| {
                distinct.push(row);
                distinct.len() - 1
            });
        }
        let matches = matched.iter().map(|(_, partner)| seen[partner]).collect();
        let rows: Vec<usize> = matched.iter().map(|&(cell, _)| cell).collect();
        let relative_yaw_rad = heading_rad(&world_from_partner) - heading_rad(&world_from_anchor);
        Pair {
            anchor: chosen(anchor_sweep, rows, &anchor_places, &world_from_anchor),
            partner: chosen(sweep, distinct, &partner_places, &world_from_partner),
            matches,
            relative_yaw_rad,
        }
    }
}

fn chosen(
    sweep: SweepVoxels,
    rows: Vec<usize>,
    places_m: &[[f32; 3]],
    world_from_sensor: &Isometry3<f64>,
) -> ChosenCells {
    let places_m = rows.iter().map(|&row| places_m[row]).collect();
    let sensor_from_world = world_from_sensor.rotation.inverse().to_rotation_matrix();
    ChosenCells {
        sweep,
        rows,
        places_m,
        sensor_from_world: sensor_from_world.cast(),
    }
}

/// Up to `count` cells at random, flat ground no more than its share.
pub(super) fn choose(cells: &[SweepCell], count: usize, rng: &mut impl Rng) -> Vec<usize> {
    let (mut flat, mut high): (Vec<usize>, Vec<usize>) =
        (0..cells.len()).partition(|&cell| cells[cell].is_flat());
    high.shuffle(rng);
    flat.shuffle(rng);
    high.truncate(count - (count as f64 * FLAT_SHARE) as usize);
    flat.truncate((count as f64 * FLAT_SHARE) as usize);
    high.extend(flat);
    high
}

fn places(cells: &[SweepCell], world_from_sensor: &Isometry3<f64>) -> Vec<[f32; 3]> {
    let places = cells.iter().map(|cell| {
        let point = world_from_sensor * Point3::from(cell.centroid_m.map(f64::from));
        point.cast::<f32>().into()
    });
    places.collect()
}

/// Index of positions by cubes of [`MATCH_M`].
struct CubeIndex<'a> {
    places_m: &'a [[f32; 3]],
    cubes: HashMap<[i32; 3], Vec<u32>>,
}

impl<'a> CubeIndex<'a> {
    fn new(places_m: &'a [[f32; 3]]) -> Self {
        let mut cubes: HashMap<[i32; 3], Vec<u32>> = HashMap::new();
        for (index, &place) in (0..).zip(places_m) {
            cubes.entry(cube(place)).or_default().push(index);
        }
        Self { places_m, cubes }
    }

    /// The nearest position within [`MATCH_M`].
    fn nearest(&self, point: [f32; 3]) -> Option<usize> {
        let [x, y, z] = cube(point);
        let mut best = (MATCH_M * MATCH_M, None);
        // Cubes have the search radius as edge: these 27 hold all positions within it.
        let cubes = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| [dx, dy]));
        let cubes = cubes.flat_map(|[dx, dy]| (-1..=1).map(move |dz| [x + dx, y + dy, z + dz]));
        for &index in cubes.filter_map(|cube| self.cubes.get(&cube)).flatten() {
            let place = self.places_m[index as usize];
            let square: f32 = (0..3).map(|axis| (place[axis] - point[axis]).powi(2)).sum();
            if square < best.0 {
                best = (square, Some(index as usize));
            }
        }
        best.1
    }
}

fn cube(place: [f32; 3]) -> [i32; 3] {
    place.map(|axis| (axis / MATCH_M).floor() as i32)
}

/// For each sweep those of the same world in range: of its own drive, and of others.
fn partners(store: &SweepStore) -> Vec<[Vec<u32>; 2]> {
    let mut buckets: HashMap<(usize, i32, i32), Vec<u32>> = HashMap::new();
    for (index, sweep) in (0..).zip(&store.sweeps) {
        buckets.entry(bucket(sweep)).or_default().push(index);
    }
    let partners = store.sweeps.iter().enumerate().map(|(index, own)| {
        let (world, x, y) = bucket(own);
        let around = (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (world, x + dx, y + dy)));
        let candidates = around.filter_map(|bucket| buckets.get(&bucket)).flatten();
        let in_range = candidates.copied().filter(|&other| {
            // A bridge and the road below it are near in the plane alone.
            let other_m = store.sweeps[other as usize].world_from_sensor.translation;
            let offset = other_m.vector - own.world_from_sensor.translation.vector;
            other as usize != index && offset.xy().norm() <= PAIR_RANGE_M && offset.z.abs() <= 2.0
        });
        let (same, other) =
            in_range.partition(|&other| store.sweeps[other as usize].drive == own.drive);
        [same, other]
    });
    partners.collect()
}

/// World of a sweep, and its position in steps of [`PAIR_RANGE_M`].
fn bucket(sweep: &StoredSweep) -> (usize, i32, i32) {
    let place = sweep.world_from_sensor.translation.vector / PAIR_RANGE_M;
    let [x, y] = [place.x, place.y].map(|axis| axis.floor() as i32);
    (sweep.world, x, y)
}
