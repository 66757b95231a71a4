//! Drives on disk in the layouts of the localization benchmarks: NCLT and Oxford, as LightLoc converts both.
//!
//! Points and poses there have z down: they are written rotated by half a turn about x, which the reader reverts.

use std::fs;
use std::path::{Path, PathBuf};

use dataset::{LoadOptions, Scenario};
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// Sweeps at either end of a drive that LightLoc, and so the reader, leaves out.
pub const LEFT_OUT: usize = 5;
/// Time of the first sweep, microseconds.
const START_MICROS: u64 = 1_547_120_000_000_000;

/// Layout of a benchmark.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Benchmark {
    /// Sequences named by the day; points one after another.
    Nclt,
    /// Sequences named by day and time; points component by component.
    Oxford,
}

impl Benchmark {
    /// Folder of its sequences.
    #[must_use]
    pub fn folder(self) -> &'static str {
        match self {
            Self::Nclt => "NCLT",
            Self::Oxford => "Oxford",
        }
    }

    fn sequence(self, drive: usize) -> String {
        match self {
            Self::Nclt => format!("2012-01-{:02}", 10 + drive),
            Self::Oxford => format!("2019-01-{:02}-14-02-26-radar-oxford-10k", 10 + drive),
        }
    }

    fn points(self, points: &[[f32; 4]]) -> Vec<u8> {
        let turned: Vec<[f32; 4]> = points
            .iter()
            .map(|&[x, y, z, i]| [x, -y, -z, 255.0 * i])
            .collect();
        let numbers: Vec<f32> = match self {
            Self::Nclt => turned.into_flattened(),
            Self::Oxford => (0..4)
                .flat_map(|part| turned.iter().map(move |point| point[part]))
                .collect(),
        };
        numbers
            .iter()
            .flat_map(|number| number.to_le_bytes())
            .collect()
    }
}

/// Writes every drive of the first agent of each scenario below `root`; returns the folder of the sequences.
///
/// # Panics
/// When a scenario cannot be read or a file cannot be written.
pub fn write(root: &Path, benchmark: Benchmark, drives: &[Scenario]) -> PathBuf {
    let folder = root.join(benchmark.folder());
    for (number, drive) in drives.iter().enumerate() {
        let sequence = folder.join(benchmark.sequence(number));
        let points_dir = sequence.join("velodyne_left");
        fs::create_dir_all(&points_dir).expect("a folder");
        let (mut stamps, mut poses) = (Vec::new(), Vec::new());
        for tick in 0..drive.ticks.len() {
            let frame = drive
                .load(0, tick, &LoadOptions::default())
                .expect("a frame");
            let micros = START_MICROS + frame.capture_nanos / 1000;
            fs::write(
                points_dir.join(format!("{micros}.bin")),
                benchmark.points(&frame.points.xyzi),
            )
            .expect("a file");
            stamps.push(micros);
            poses.push(matrix(
                &frame
                    .world_from_lidar
                    .expect("a generated drive has its poses")
                    .isometry(),
            ));
        }
        fs::write(
            sequence.join("velodyne_left_False.h5"),
            hdf5(&stamps, &poses),
        )
        .expect("a file");
    }
    folder
}

/// The first three rows of the matrix, in axes with z down.
fn matrix(pose: &Isometry3<f64>) -> [f64; 12] {
    let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI);
    let turn = Isometry3::from_parts(Vector3::zeros().into(), turn);
    let matrix = (turn * pose * turn.inverse()).to_homogeneous();
    std::array::from_fn(|place| matrix[(place / 4, place % 4)])
}

/// A minimal HDF5 file with the datasets `valid_timestamps` (`n` integers) and `poses` (`n x 12` doubles): superblock
/// 0, object headers 1, links in the root's header, data in one piece each.
pub(crate) fn hdf5(stamps: &[u64], poses: &[[f64; 12]]) -> Vec<u8> {
    // HDF5's descriptions of little-endian 64-bit integers and IEEE doubles.
    const INTEGER: &[u8] = &[0x10, 0x08, 0, 0, 8, 0, 0, 0, 0, 0, 64, 0];
    const DOUBLE: &[u8] = &[
        0x11, 0x20, 0x3f, 0, 8, 0, 0, 0, 0, 0, 64, 0, 52, 11, 0, 52, 0xff, 0x03, 0, 0,
    ];
    const ROOT_AT: usize = 96;
    let count = stamps.len() as u64;
    let stamps: Vec<u8> = stamps
        .iter()
        .flat_map(|stamp| stamp.to_le_bytes())
        .collect();
    let poses: Vec<u8> = poses
        .iter()
        .flatten()
        .flat_map(|number| number.to_le_bytes())
        .collect();
    let headers = |at: [usize; 4]| {
        let links = [
            hdf5_link("valid_timestamps", at[0]),
            hdf5_link("poses", at[1]),
        ];
        let no_heaps = hdf5_message(2, &[&[0, 0][..], &[0xff; 16]].concat());
        [
            hdf5_object(&[&[no_heaps][..], &links].concat()),
            hdf5_dataset(&[count], INTEGER, at[2], stamps.len()),
            hdf5_dataset(&[count, 12], DOUBLE, at[3], poses.len()),
        ]
    };
    // Lengths do not depend on the places that are written into them.
    let [root, first, second] = headers([0; 4]).map(|header| header.len());
    let data = ROOT_AT + root + first + second;
    let places = [
        ROOT_AT + root,
        ROOT_AT + root + first,
        data,
        data + stamps.len(),
    ];
    let end = data + stamps.len() + poses.len();

    let mut file = b"\x89HDF\r\n\x1a\n".to_vec();
    file.extend([0, 0, 0, 0, 0, 8, 8, 0, 4, 0, 16, 0, 0, 0, 0, 0]);
    for value in [
        0,
        u64::MAX,
        end as u64,
        u64::MAX,
        0,
        ROOT_AT as u64,
        0,
        0,
        0,
    ] {
        file.extend(value.to_le_bytes());
    }
    file.extend(headers(places).concat());
    file.extend(stamps);
    file.extend(poses);
    file
}

fn hdf5_dataset(shape: &[u64], datatype: &[u8], place: usize, bytes: usize) -> Vec<u8> {
    let mut space = vec![1, shape.len() as u8, 0, 0, 0, 0, 0, 0];
    space.extend(shape.iter().flat_map(|size| size.to_le_bytes()));
    let layout = [
        &[3, 1][..],
        &(place as u64).to_le_bytes(),
        &(bytes as u64).to_le_bytes(),
    ]
    .concat();
    hdf5_object(&[
        hdf5_message(1, &space),
        hdf5_message(3, datatype),
        hdf5_message(8, &layout),
    ])
}

fn hdf5_link(name: &str, place: usize) -> Vec<u8> {
    hdf5_message(
        6,
        &[
            &[1, 0, name.len() as u8][..],
            name.as_bytes(),
            &(place as u64).to_le_bytes(),
        ]
        .concat(),
    )
}

fn hdf5_object(messages: &[Vec<u8>]) -> Vec<u8> {
    let body = messages.concat();
    let mut header = vec![1, 0];
    header.extend((messages.len() as u16).to_le_bytes());
    header.extend(1_u32.to_le_bytes());
    header.extend((body.len() as u32).to_le_bytes());
    header.extend([0; 4]);
    header.extend(body);
    header
}

/// A message of an object's header: kind, length, no flags, data up to a multiple of 8 bytes.
fn hdf5_message(kind: u16, data: &[u8]) -> Vec<u8> {
    let padded = data.len().next_multiple_of(8);
    let mut message = [kind.to_le_bytes(), (padded as u16).to_le_bytes()].concat();
    message.extend([0; 4]);
    message.extend(data);
    message.resize(8 + padded, 0);
    message
}
