//! Static scene: roads, ground, buildings and street furniture.
//!
//! A [`MapModel`] is made from a source (one of two procedural kinds, or an OpenDRIVE map) and a seed; the same
//! source and seed give the same result, byte for byte. Routes, traffic and parked cars are generated later from
//! another seed.
//!
//! # Frames and units
//! World frame of the map: right-handed, x east, y north, z up, metres; yaw turns x towards y.

mod clearance;
mod clothoid;
mod conflicts;
mod convex;
pub mod curve;
mod finding;
mod ground;
mod lane;
pub mod lane_builder;
pub(crate) mod lane_links;
mod lane_queries;
pub mod lateral;
mod layout;
mod noise;
pub mod opendrive;
pub mod profile;
pub mod road;
mod roadside;
mod solid;
mod surface;
mod terrain;

pub use finding::Finding;
pub(crate) use ground::Triangle;
pub use ground::{Ground, HeightGrid, Terrain};
pub use lane::{Lane, LaneGraph, LaneId};
pub(crate) use lane_queries::LaneIndex;
use layout::RoadLayout;
use road::RoadNetwork;
pub use solid::{Shape, Solid, SolidKind};
use std::path::{Path, PathBuf};
use surface::RoadSurface;

use support::bounded_file;
use support::file_error::{AtFile, FileError};

/// Longest side of a map, metres.
const MAX_EXTENT_M: f64 = 50_000.0;

/// All static parts of a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct MapModel {
    /// Kind of procedural map, such as `town1`, or the stem of the map's file.
    pub name: String,
    /// Driving lanes.
    pub lanes: LaneGraph,
    /// Terrain and elevated road surfaces.
    pub ground: Ground,
    /// Buildings, trees, poles, walls, bridges.
    pub solids: Vec<Solid>,
    /// Places for parked vehicles.
    pub parking: Vec<ParkingSpot>,
    /// Parts of its map that were not built as the file gives them.
    pub findings: Vec<Finding>,
}

/// Source of a map.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RoadMapSource {
    /// A small town with T-junctions and crossings.
    Town1,
    /// A motorway ring with ramps, an interchange, an under-pass, roundabouts and a small town.
    Town4,
    /// A map file in OpenDRIVE format.
    OpenDrive(PathBuf),
}

impl RoadMapSource {
    /// The name of the map made from it: its kind, or the stem of the map's file in small letters.
    pub fn name(&self) -> String {
        match self {
            Self::Town1 => "town1".into(),
            Self::Town4 => "town4".into(),
            Self::OpenDrive(path) => path
                .file_stem()
                .map_or("map".into(), |stem| stem.to_string_lossy().to_lowercase()),
        }
    }
}

/// A place for one parked vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ParkingSpot {
    /// Centre of the spot on the ground, metres in the world frame.
    pub center_m: [f64; 3],
    /// Direction a parked vehicle's bonnet points to, radians.
    pub yaw_rad: f64,
    /// Slope across the spot as an angle, radians; positive where the left side of a parked vehicle is higher.
    pub roll_rad: f64,
    /// Length along the heading, metres.
    pub length_m: f64,
    /// Width across the heading, metres.
    pub width_m: f64,
}

/// Builds the map of `source` and `map_seed`.
///
/// # Errors
/// [`FileError`] when a map cannot be read or is no usable road network; procedural maps always build.
pub fn build(source: &RoadMapSource, map_seed: u64) -> Result<MapModel, FileError> {
    let layout = match source {
        RoadMapSource::Town1 => layout::town1(map_seed),
        RoadMapSource::Town4 => layout::town4(map_seed),
        RoadMapSource::OpenDrive(path) => {
            let (network, lanes) = read_map(path)?;
            check_extent(path, &network, &lanes)?;
            let islands = Vec::new();
            RoadLayout { network, islands }
        }
    };
    Ok(place_roadside(source.name(), &layout, map_seed))
}

/// Refuses maps without driving lanes, and maps so large that the ground between their roads would not fit in memory.
fn check_extent(path: &Path, network: &RoadNetwork, graph: &LaneGraph) -> Result<(), FileError> {
    if graph.lanes.is_empty() {
        let roads = network.roads.len();
        let problem = format_args!("none of its {roads} roads has a driving lane");
        return Err(FileError::new(path, problem));
    }
    let points = graph.lanes.iter().flat_map(|lane| &lane.centerline);
    let [low, high] = convex::bounds(points.map(|&[x, y, _]| [x, y]));
    let extent_m = (high[0] - low[0]).max(high[1] - low[1]);
    if extent_m > MAX_EXTENT_M {
        let problem = format_args!(
            "its lanes reach over {extent_m:.0} m, more than the limit of {MAX_EXTENT_M} m"
        );
        return Err(FileError::new(path, problem));
    }
    Ok(())
}

/// Reads the file of an OpenDRIVE map: its roads and junctions, with findings of parts that were not built as the file
/// gives them, and its driving lanes.
///
/// # Errors
/// [`FileError`] if it is not readable, or no usable OpenDRIVE map.
pub fn read_map(path: &Path) -> Result<(RoadNetwork, LaneGraph), FileError> {
    let bytes = bounded_file::read(path, opendrive::MAX_BYTES as u64).at(path)?;
    let mut network = opendrive::read(&bytes).at(path)?;
    let (lanes, findings) = lane_builder::lane_graph(&network);
    network.findings.extend(findings);
    Ok((network, lanes))
}

fn place_roadside(name: String, layout: &RoadLayout, map_seed: u64) -> MapModel {
    let (lanes, _) = lane_builder::lane_graph(&layout.network);
    let surface = RoadSurface::new(&layout.network);
    let ground = terrain::ground(&surface, map_seed);
    let (solids, parking) = roadside::place_roadside(layout, &surface, &ground, map_seed);
    MapModel {
        name,
        lanes,
        ground,
        solids,
        parking,
        findings: layout.network.findings.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_seed_same_town_on_any_thread() {
        for source in [RoadMapSource::Town1, RoadMapSource::Town4] {
            let elsewhere = {
                let source = source.clone();
                std::thread::spawn(move || build(&source, 11).unwrap())
            };
            let (here, other) = (build(&source, 11).unwrap(), build(&source, 12).unwrap());
            let elsewhere = elsewhere.join().unwrap();
            assert!(here == elsewhere, "{source:?} differs from itself");
            assert!(here != other, "{source:?} does not depend on its seed");
        }
    }

    fn weighted_sum(values: impl Iterator<Item = [f64; 3]>) -> f64 {
        values.map(|[x, y, z]| x + 2.0 * y + 3.0 * z).sum()
    }

    /// Scenes of a seed are the same from one version to the next only if the procedural maps are the same.
    #[test]
    fn procedural_maps_are_unchanged() {
        for (source, counts, sums) in [
            (
                RoadMapSource::Town1,
                [168, 4221, 445, 0],
                [4735203.0653, 2410977.6519, 244239.8916],
            ),
            (
                RoadMapSource::Town4,
                [172, 11365, 286, 192],
                [2554837.7919, 1465742.7106, 139175.4820],
            ),
        ] {
            let map_model = build(&source, 0).unwrap();
            let lanes = map_model.lanes.lanes.iter();
            let parking = map_model.parking.iter();
            let found = [
                weighted_sum(lanes.flat_map(|lane| &lane.centerline).copied()),
                weighted_sum(map_model.solids.iter().map(|solid| solid.center_m)),
                weighted_sum(
                    parking.map(|spot| [spot.center_m[0], spot.center_m[1], spot.yaw_rad]),
                ),
            ];
            let counted = [
                map_model.lanes.lanes.len(),
                map_model.solids.len(),
                map_model.parking.len(),
                map_model.ground.decks.len(),
            ];
            assert_eq!(counted, counts, "{source:?}");
            assert!(
                found
                    .iter()
                    .zip(sums)
                    .all(|(found, sum): (&f64, f64)| (found - sum).abs() < 0.01),
                "{found:?}"
            );
            assert!(
                map_model.findings.is_empty()
                    && map_model
                        .lanes
                        .lanes
                        .iter()
                        .all(|lane| lane.banks_rad.is_empty())
            );
        }
    }

    fn build_error(path: &Path) -> String {
        build(&RoadMapSource::OpenDrive(path.to_owned()), 0)
            .unwrap_err()
            .to_string()
    }

    fn one_road(lanes: &str, length_m: u32) -> String {
        format!(
            "<OpenDRIVE><road id=\"1\" length=\"{length_m}\"><planView><geometry s=\"0\" x=\"0\" y=\"0\" hdg=\"0\" \
             length=\"{length_m}\"><line/></geometry></planView><lanes><laneSection s=\"0\"><right>{lanes}</right>\
             </laneSection></lanes></road></OpenDRIVE>"
        )
    }

    #[test]
    fn unusable_maps_are_refused_with_their_path() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("town.xodr");
        let error = build_error(&path);
        assert!(error.starts_with(&path.display().to_string()), "{error}");
        std::fs::write(
            &path,
            "<OpenDRIVE><road id=\"1\" length=\"x\"/></OpenDRIVE>",
        )
        .unwrap();
        let error = build_error(&path);
        assert!(
            error.ends_with("line 1: <road> has no <planView>"),
            "{error}"
        );
        std::fs::File::create(&path)
            .unwrap()
            .set_len(opendrive::MAX_BYTES as u64 + 1)
            .unwrap();
        let error = build_error(&path);
        assert!(
            error.ends_with("larger than 67108864 bytes, the most that is read"),
            "{error}"
        );
        std::fs::write(&path, one_road("", 10)).unwrap();
        let error = build_error(&path);
        assert!(
            error.ends_with("none of its 1 roads has a driving lane"),
            "{error}"
        );
        let lane = "<lane id=\"-1\" type=\"driving\"><width sOffset=\"0\" a=\"3\" b=\"0\" c=\"0\" d=\"0\"/></lane>";
        std::fs::write(&path, one_road(lane, 60_000)).unwrap();
        let error = build_error(&path);
        assert!(
            error.ends_with("its lanes reach over 60000 m, more than the limit of 50000 m"),
            "{error}"
        );
        std::fs::write(&path, one_road(lane, 400)).unwrap();
        let map_model = build(&RoadMapSource::OpenDrive(path.clone()), 0).unwrap();
        assert_eq!(
            (map_model.name.as_str(), map_model.lanes.lanes.len()),
            ("town", 1)
        );
        assert!(map_model.obstructions().is_empty() && map_model.solids.len() > 50);
    }
}
