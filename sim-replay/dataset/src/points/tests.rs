use std::fs;

use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

use super::*;
use crate::pcd::PcdPlace;

fn id() -> CavId {
    CavId::new("0").unwrap()
}

fn floats(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

/// Files of one agent in a folder, and the reader of its sweeps.
fn agent(storage: SweepStorage, files: &[(&str, Vec<u8>)]) -> (tempfile::TempDir, Sweeps) {
    let dir = tempfile::tempdir().unwrap();
    for (name, bytes) in files {
        fs::write(dir.path().join(name), bytes).unwrap();
    }
    let paths: Vec<PathBuf> = files
        .iter()
        .map(|(name, _)| dir.path().join(name))
        .collect();
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
    assert_eq!(
        read(SweepStorage::ByName, &interleaved).points.xyzi,
        expected
    );
    let planar = floats(&[1.0, 5.0, 2.0, 6.0, 3.0, 7.0, 0.25, 0.5]);
    assert_eq!(read(SweepStorage::Planar, &planar).points.xyzi, expected);
}

#[test]
fn raw_points_are_in_steps_of_five_millimetres() {
    let cloud = read(
        SweepStorage::NcltRaw,
        &[0, 0, 0x20, 0x4e, 0xff, 0xff, 51, 31],
    );
    assert_eq!(cloud.points.xyzi, [[-100.0, 0.0, 227.675, 0.2]]);
}

#[test]
fn a_cut_file_and_a_nan_are_named() {
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", vec![0; 17])]);
    let message = sweeps
        .read(&id(), &dir.path().join("0.bin"))
        .unwrap_err()
        .to_string();
    assert!(
        message.contains("17 bytes are not a whole number of points of 16 bytes"),
        "{message}"
    );
    let mut bytes = vec![0; 16];
    bytes.extend(f32::NAN.to_le_bytes().repeat(4));
    let cloud = read(SweepStorage::ByName, &bytes);
    assert_eq!(
        (cloud.points.len(), cloud.dropped, cloud.first_dropped),
        (1, 1, Some(PcdPlace::Point(1)))
    );
}

/// Points all round like those of a LiDAR of 32 lasers, with any numbers after x, y, z.
pub(crate) fn turn(points: usize, behind: impl Fn(usize) -> Vec<f32>) -> Vec<u8> {
    (0..points)
        .flat_map(|index| {
            let (angle, range) = (index as f32 * 0.37, 5.0 + (index * 7919 % 400) as f32 * 0.1);
            let position = [
                range * angle.cos(),
                range * angle.sin(),
                -1.9 + (index % 32) as f32 * 0.1,
            ];
            floats(&[&position[..], &behind(index)].concat())
        })
        .collect()
}

fn form_of(bytes: &[u8]) -> (&'static str, usize) {
    let cloud = read(SweepStorage::ByName, bytes);
    (cloud.form, cloud.points.len())
}

const FOUR: &str = "4 floats per point: x y z intensity";
const FIVE: &str = "5 floats per point: x y z intensity ring";

/// Hundredths from 0 to 1.
fn hundredths(index: usize) -> f32 {
    (index % 101) as f32 / 100.0
}

#[test]
fn four_and_five_floats_are_distinguished_also_if_both_fit() {
    // 40 points of 20 bytes are 50 of 16.
    for points in [40, 400, 41, 35_000] {
        let with_ring = turn(points, |index| vec![17.0, (index % 32) as f32]);
        assert_eq!(form_of(&with_ring), (FIVE, points));
        let with_bytes = turn(points, |index| {
            vec![(index % 256) as f32, (index % 32) as f32]
        });
        assert_eq!(form_of(&with_bytes), (FIVE, points));
        let with_time = turn(points, |index| vec![hundredths(index), index as f32 * 1e-5]);
        assert_eq!(form_of(&with_time), (FIVE, points));
        let plain = turn(points, |index| vec![hundredths(index)]);
        assert_eq!(form_of(&plain), (FOUR, points));
        let bytes = turn(points, |index| vec![(index % 256) as f32]);
        assert_eq!(form_of(&bytes), (FOUR, points));
        let without_intensity = turn(points, |_| vec![0.0]);
        assert_eq!(form_of(&without_intensity), (FOUR, points));
    }
}

#[test]
fn the_first_sweeps_decide_for_all() {
    let five = turn(40, |index| vec![0.5, (index % 32) as f32]);
    let few = floats(&[1.0, 2.0, 3.0, 0.5, 7.0]);
    let files = [
        ("0.bin", vec![]),
        ("1.bin", five[..797].to_vec()),
        ("2.bin", five),
        ("4.bin", few),
    ];
    let (dir, sweeps) = agent(SweepStorage::ByName, &files);
    let read = |name: &str| sweeps.read(&id(), &dir.path().join(name));
    assert_eq!(read("4.bin").unwrap().points.xyzi, [[1.0, 2.0, 3.0, 0.5]]);
    assert_eq!(
        (
            read("0.bin").unwrap().points.len(),
            read("2.bin").unwrap().points.len()
        ),
        (0, 40)
    );
    let message = read("1.bin").unwrap_err().to_string();
    assert!(
        message.contains("797 bytes are not a whole number of points of 20 bytes"),
        "{message}"
    );
}

/// The error of the only sweep of an agent.
fn refusal(bytes: Vec<u8>) -> String {
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", bytes)]);
    let read = sweeps.read(&id(), &dir.path().join("0.bin"));
    read.unwrap_err().to_string()
}

#[test]
fn other_forms_are_refused_with_the_figure() {
    let doubles: Vec<u8> = (0..400)
        .flat_map(|index| (f64::from(index) * 0.317 - 60.0).to_le_bytes())
        .collect();
    let integers: Vec<u8> = (0..800_u32)
        .flat_map(|index| (index % 500).to_le_bytes())
        .collect();
    for bytes in [doubles, integers] {
        let message = refusal(bytes);
        assert!(
            message.contains("no sweep of x y z intensity or x y z intensity ring as f32: "),
            "{message}"
        );
        assert!(
            message.contains("% of the numbers are beyond 1e7 or below 1e-30, usual is none"),
            "{message}"
        );
    }
    for (count, behind) in [
        (3, vec![]),
        (6, vec![0.5, 3.0, 0.01]),
        (7, vec![0.5, 3.0, 0.01, 9.0]),
    ] {
        let message = refusal(turn(400, |_| behind.clone()));
        assert!(
            message.contains(&format!(
                "it looks like {count} floats per point, expected 4"
            )),
            "{message}"
        );
    }
}

/// Numbers that sensors store behind x, y, z: intensity, laser, time (s), reflectivity, ambient light, number of the
/// return, range (m).
fn additions(index: usize) -> [f32; 7] {
    [
        hundredths(index),
        (index % 32) as f32,
        0.01,
        (index * 37 % 256) as f32,
        900.0 + (index % 50) as f32,
        1.0,
        5.0 + (index * 7919 % 400) as f32 * 0.1,
    ]
}

/// The points of a file in random order.
fn shuffled(bytes: &[u8], numbers_per_point: usize) -> Vec<u8> {
    let mut points: Vec<&[u8]> = bytes.chunks_exact(4 * numbers_per_point).collect();
    points.shuffle(&mut ChaCha8Rng::seed_from_u64(7));
    points.concat()
}

#[test]
fn six_seven_eight_and_ten_floats_are_refused_in_any_order_of_the_points() {
    for count in [6, 7, 8, 10] {
        let in_order = turn(400, |index| additions(index)[..count - 3].to_vec());
        for bytes in [shuffled(&in_order, count), in_order] {
            let message = refusal(bytes);
            let expected = format!("it looks like {count} floats per point, expected 4");
            assert!(message.contains(&expected), "{message}");
        }
    }
}

/// A sweep with intensities of 0.5, and one other.
fn sweep_up_to(largest: f32) -> Vec<u8> {
    turn(40, |index| vec![if index == 7 { largest } else { 0.5 }])
}

/// The largest intensity of a sweep, and their divisor.
fn largest_intensity(sweeps: &Sweeps, path: &Path) -> (f32, f32) {
    let cloud = sweeps.read(&id(), path).unwrap();
    let largest = cloud
        .points
        .xyzi
        .iter()
        .map(|point| point[3])
        .fold(0.0, f32::max);
    (largest, cloud.intensity.unwrap().divisor)
}

#[test]
fn intensities_of_all_files_are_scaled_alike() {
    let (dir, sweeps) = agent(
        SweepStorage::ByName,
        &[("0.bin", sweep_up_to(1.0)), ("1.bin", sweep_up_to(51.0))],
    );
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("0.bin")),
        (1.0 / 255.0, 255.0)
    );
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("1.bin")),
        (0.2, 255.0)
    );
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", sweep_up_to(1.0))]);
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("0.bin")),
        (1.0, 1.0)
    );
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", sweep_up_to(1000.0))]);
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("0.bin")),
        (1000.0 / 1023.0, 1023.0)
    );
    let forced = OpenOptions {
        intensity_scale: "100".parse().unwrap(),
        ..OpenOptions::default()
    };
    let sweeps = Sweeps::new(SweepStorage::ByName, &forced).with_agent(id(), []);
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("0.bin")),
        (10.0, 100.0)
    );
}

#[test]
fn a_single_bright_point_does_not_decide_the_scale_of_a_file() {
    let bright = turn(200, |index| vec![if index == 7 { 1.02 } else { 0.5 }]);
    let (dir, sweeps) = agent(SweepStorage::ByName, &[("0.bin", bright)]);
    assert_eq!(
        largest_intensity(&sweeps, &dir.path().join("0.bin")),
        (1.02, 1.0)
    );
}

/// A file with the bytes of one field behind x, y, z.
fn pcd_of_one_point(name: &str, kind: char, bytes: &[u8]) -> Vec<u8> {
    let size = bytes.len();
    let head = format!(
        "FIELDS x y z {name}\nSIZE 4 4 4 {size}\nTYPE F F F {kind}\nWIDTH 1\nDATA binary\n"
    );
    [head.as_bytes(), &floats(&[1.0, 2.0, 3.0]), bytes].concat()
}

#[test]
fn a_packed_colour_and_a_byte_need_no_other_sweep() {
    let files = [
        ("0.pcd", pcd_of_one_point("rgb", 'F', &[9, 9, 1, 0])),
        ("1.pcd", pcd_of_one_point("Intensity", 'U', &[1])),
    ];
    let (dir, sweeps) = agent(SweepStorage::ByName, &files);
    for name in ["0.pcd", "1.pcd"] {
        let cloud = sweeps.read(&id(), &dir.path().join(name)).unwrap();
        assert_eq!(cloud.points.xyzi, [[1.0, 2.0, 3.0, 1.0 / 255.0]]);
    }
}
