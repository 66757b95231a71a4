use std::fs;

use super::*;
use crate::pcd::Place;

fn id() -> CavId {
    CavId::new("0").unwrap()
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// Files of one agent in a folder, and the reader of its sweeps.
fn agent(storage: SweepStorage, files: &[(&str, Vec<u8>)]) -> (tempfile::TempDir, Sweeps) {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        fs::write(dir.path().join(name), bytes).unwrap();
    }
    let paths: Vec<PathBuf> = files.iter().map(|(name, _)| dir.path().join(name)).collect();
    let sweeps = Sweeps::new(storage, &OpenOptions::default()).with_agent(id(), paths);
    (dir, sweeps)
}

fn read(storage: SweepStorage, bytes: &[u8]) -> PcdCloud {
    let (dir, sweeps) = agent(storage, &[("0.bin", bytes.to_vec())]);
    sweeps.read(&id(), &dir.path().join("0.bin")).unwrap()
}

#[test]
fn interleaved_and_planar_differ_in_order_only() {
    let expected = [[1.0, 2.0, 3.0, 0.25], [5.0, 6.0, 7.0, 0.5]];
    let interleaved = floats(&[1.0, 2.0, 3.0, 0.25, 5.0, 6.0, 7.0, 0.5]);
    assert_eq!(read(SweepStorage::ByName, &interleaved).points.xyzi, expected);
    let planar = floats(&[1.0, 5.0, 2.0, 6.0, 3.0, 7.0, 0.25, 0.5]);
    assert_eq!(read(SweepStorage::Planar, &planar).points.xyzi, expected);
}

#[test]
fn raw_points_are_in_steps_of_five_millimetres() {
    let cloud = read(SweepStorage::NcltRaw, &[0, 0, 0x20, 0x4e, 0xff, 0xff, 51, 31]);
    assert_eq!(cloud.points.xyzi, [[-100.0, 0.0, 227.675, 0.2]]);
}

#[test]
fn a_cut_file_and_a_nan_are_named() {
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", vec![0; 17])]);
    let message = sweeps.read(&id(), &dir.path().join("0.bin")).unwrap_err().to_string();
    assert!(message.contains("17 bytes are not a whole number of points of 16 bytes"), "{message}");
    let mut bytes = vec![0; 16];
    bytes.extend(f32::NAN.to_le_bytes().repeat(4));
    let cloud = read(SweepStorage::ByName, &bytes);
    assert_eq!((cloud.points.len(), cloud.dropped, cloud.first_dropped), (1, 1, Some(Place::Point(1))));
}
