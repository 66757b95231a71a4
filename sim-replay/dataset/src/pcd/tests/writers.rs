//! The variants that Open3D and PCL (`pcl_ros`) write, read bit by bit.

use super::file::{File, Number};
use super::*;

/// A file of a public writer, and the expected result.
pub(super) struct Variant {
    name: String,
    pub(super) bytes: Vec<u8>,
    points: Vec<[f32; 4]>,
    dropped: usize,
    field: Option<&'static str>,
}

/// Coordinates with all their bits, far from and near to zero.
fn coordinates(index: usize) -> [f32; 3] {
    let t = index as f32;
    [
        60.0 * (0.7 * t).cos() + 1e-3 * t,
        (0.7 * t).sin() * 1.5e-5,
        -1.9 + 0.113 * t,
    ]
}

/// Red of a point: all values from 0 to 255, with subnormal words among them.
fn red(index: usize) -> u8 {
    (index * 23 % 256) as u8
}

const POINTS: usize = 24;

/// Open3D's point clouds: positions as floats, then normals, then a packed colour; three encodings of four kinds.
fn open3d() -> Vec<Variant> {
    let mut variants = Vec::new();
    for (has_normals, has_colours) in [(false, false), (true, false), (false, true), (true, true)] {
        let mut names = vec!["x", "y", "z"];
        names.extend(
            has_normals
                .then_some(["normal_x", "normal_y", "normal_z"])
                .into_iter()
                .flatten(),
        );
        names.extend(has_colours.then_some("rgb"));
        let row = |index: usize| {
            let normal = [0.6f32, -0.0, 0.8].map(Number::F4);
            let colour = u32::from_be_bytes([0, red(index), 0, 0]);
            let mut row = coordinates(index).map(Number::F4).to_vec();
            row.extend(has_normals.then_some(normal).into_iter().flatten());
            row.extend(has_colours.then_some(Number::F4(f32::from_bits(colour))));
            row
        };
        let intensity = |index: usize| {
            if has_colours {
                f32::from(red(index)) / 255.0
            } else {
                0.0
            }
        };
        let points: Vec<[f32; 4]> = (0..POINTS)
            .map(|index| with(coordinates(index), intensity(index)))
            .collect();
        let file = File::of_rows(&names, (0..POINTS).map(row).collect());
        for (encoding, bytes) in ["ascii", "binary", "compressed"]
            .into_iter()
            .zip(file.in_all_encodings())
        {
            let name = format!("Open3D, {}, {encoding}", names.join(" "));
            let field = has_colours.then_some("rgb");
            variants.push(Variant {
                name,
                bytes,
                points: points.clone(),
                dropped: 0,
                field,
            });
        }
    }
    variants
}

/// Open3D's tensors: attributes of any type behind the positions, a blank at the end of each line.
fn open3d_tensors() -> Vec<Variant> {
    let kinds: [fn(u8) -> Number; 4] = [
        |value| Number::F4(f32::from(value)),
        |value| Number::F8(f64::from(value)),
        Number::U1,
        |value| Number::U2(u16::from(value)),
    ];
    let mut variants = Vec::new();
    for kind in kinds {
        let row = |index: usize| {
            let mut row = coordinates(index)
                .map(|value| Number::F8(f64::from(value)))
                .to_vec();
            row.push(kind(red(index)));
            row
        };
        let file = File::of_rows(
            &["x", "y", "z", "intensity"],
            (0..POINTS).map(row).collect(),
        );
        let points: Vec<[f32; 4]> = (0..POINTS)
            .map(|index| with(coordinates(index), f32::from(red(index))))
            .collect();
        for (encoding, bytes) in [
            ("ascii", file.ascii(" \n")),
            ("binary", file.binary()),
            ("compressed", file.compressed()),
        ] {
            let name = format!("Open3D tensor, {:?}, {encoding}", kind(1));
            variants.push(Variant {
                name,
                bytes,
                points: points.clone(),
                dropped: 0,
                field: Some("intensity"),
            });
        }
    }
    variants
}

/// A Velodyne's cloud as written by `pcl_ros`: padding to the offsets of the message, rays without a hit in an
/// organised cloud, files extended to whole pages. In packed and text files PCL leaves padding out.
fn pcl_ros() -> Vec<Variant> {
    let position = |index: usize| {
        if index % 7 == 3 {
            [f32::NAN; 3]
        } else {
            coordinates(index)
        }
    };
    let row = |index: usize, is_padded: bool| {
        let mut row = position(index).map(Number::F4).to_vec();
        row.extend(is_padded.then_some(Number::Padding(4)));
        row.push(Number::F4(f32::from(red(index))));
        row.extend(is_padded.then_some(Number::Padding(0)));
        row.extend([Number::U2(index as u16), Number::F4(0.1 * index as f32)]);
        row.extend(is_padded.then_some(Number::Padding(10)));
        row
    };
    let file = |is_padded: bool, height: usize| {
        let padded = ["x", "y", "z", "_", "intensity", "_", "ring", "time", "_"];
        let names: Vec<&str> = padded
            .into_iter()
            .filter(|name| is_padded || *name != "_")
            .collect();
        let rows = (0..POINTS).map(|index| row(index, is_padded)).collect();
        File::of_rows(&names, rows).in_rows_of_height(height)
    };
    let is_kept = |index: &usize| index % 7 != 3;
    let points: Vec<[f32; 4]> = (0..POINTS)
        .filter(is_kept)
        .map(|index| with(coordinates(index), f32::from(red(index))))
        .collect();
    let mut variants = Vec::new();
    for height in [1, 4] {
        let stretched = |mut bytes: Vec<u8>, page: usize| {
            bytes.resize(bytes.len().next_multiple_of(page) + page, 0);
            bytes
        };
        let files = [
            ("ascii", file(false, height).ascii("\n")),
            ("binary", file(true, height).binary()),
            (
                "binary of a page more",
                stretched(file(true, height).binary(), 4096),
            ),
            ("compressed", file(false, height).compressed()),
            (
                "compressed to whole pages",
                stretched(file(false, height).compressed(), 4096),
            ),
        ];
        for (encoding, bytes) in files {
            let name = format!("PCL, height {height}, {encoding}");
            let dropped = POINTS - points.len();
            variants.push(Variant {
                name,
                bytes,
                points: points.clone(),
                dropped,
                field: Some("intensity"),
            });
        }
    }
    variants
}

fn with([x, y, z]: [f32; 3], intensity: f32) -> [f32; 4] {
    [x, y, z, intensity]
}

pub(super) fn all() -> Vec<Variant> {
    open3d()
        .into_iter()
        .chain(open3d_tensors())
        .chain(pcl_ros())
        .collect()
}

#[test]
fn every_variant_is_read_bit_by_bit() {
    assert_eq!((open3d().len(), all().len()), (12, 12 + 12 + 10));
    for Variant {
        name,
        bytes,
        points,
        dropped,
        field,
    } in all()
    {
        let cloud = decode(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        let bits = |points: &[[f32; 4]]| {
            points
                .iter()
                .map(|point| point.map(f32::to_bits))
                .collect::<Vec<_>>()
        };
        assert_eq!(bits(&cloud.points.xyzi), bits(&points), "{name}");
        assert_eq!((cloud.dropped, cloud.labels), (dropped, None), "{name}");
        assert_eq!(
            cloud.intensity.map(|origin| origin.field).as_deref(),
            field,
            "{name}"
        );
    }
}

#[test]
fn lines_may_be_blank_and_numbers_spelled_as_c_does() {
    let head = "COLUMNS x y z reflectivity\nSIZE 4 4 4 4\nTYPE F F F F\nWIDTH 6\nDATA ascii\n";
    let lines = "1 2 3 4\r\n\r\n  \t1e0\t2.\t3 4 \nnan nan nan 0\n-nan(ind) 1 1 1\n1.#QNAN -inf inf 1\n\n1 2 3 4\n\n\n";
    let cloud = decode(format!("{head}{lines}").as_bytes()).unwrap();
    assert_eq!(
        (cloud.points.xyzi, cloud.dropped),
        (vec![[1.0, 2.0, 3.0, 4.0]; 3], 3)
    );
    assert_eq!(cloud.first_dropped, Some(PcdPlace::Line(9)));
}
