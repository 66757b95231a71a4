//! Point clouds of all layouts, written by a writer of the test's own.

use proptest::prelude::*;
use re_cdr::{BigEndian, ByteOrder, CdrWriter, LittleEndian};

use super::*;

const LIMITS: Limits = Limits {
    max_points: 1 << 20,
    max_abs_value: 1e6,
    ..Limits::DEFAULT
};

/// A cloud as a driver lays it out.
#[derive(Debug, Clone)]
struct Cloud {
    stamp: (i32, u32),
    height: u32,
    width: u32,
    /// Name, offset and datatype.
    fields: Vec<(&'static str, u32, u8)>,
    is_big_endian: bool,
    point_step: u32,
    row_step: u32,
    /// x, y, z, intensity of all points, row by row.
    points: Vec<[f64; 4]>,
}

impl Cloud {
    /// One row of x, y, z, intensity in single precision.
    fn plain(points: &[[f64; 4]]) -> Self {
        let width = points.len() as u32;
        Self {
            stamp: (1, 5),
            height: 1,
            width,
            fields: vec![("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7)],
            is_big_endian: false,
            point_step: 16,
            row_step: 16 * width,
            points: points.to_vec(),
        }
    }

    fn data(&self) -> Vec<u8> {
        let mut data = vec![0xee; self.row_step as usize * self.height as usize];
        for (index, point) in self.points.iter().enumerate() {
            let (row, column) = (index / self.width as usize, index % self.width as usize);
            let begin = row * self.row_step as usize + column * self.point_step as usize;
            for (name, offset, datatype) in &self.fields {
                let axis = ["x", "y", "z"]
                    .iter()
                    .position(|known| known.eq_ignore_ascii_case(name));
                let is_intensity = [&INTENSITY_FIELDS[..], &COLOUR_FIELDS]
                    .concat()
                    .iter()
                    .any(|known| known.eq_ignore_ascii_case(name));
                let Some(axis) = axis.or(is_intensity.then_some(3)) else {
                    continue;
                };
                let value = &mut data[begin + *offset as usize..];
                match self.is_big_endian {
                    true => write_value::<BigEndian>(value, *datatype, point[axis]),
                    false => write_value::<LittleEndian>(value, *datatype, point[axis]),
                }
            }
        }
        data
    }

    fn bytes<BO: ByteOrder>(&self, header: [u8; 4]) -> Vec<u8> {
        let mut bytes = header.to_vec();
        let mut cdr = CdrWriter::<BO>::new(&mut bytes);
        cdr.write_i32(self.stamp.0);
        cdr.write_u32(self.stamp.1);
        cdr.write_string("velodyne");
        cdr.write_u32(self.height);
        cdr.write_u32(self.width);
        cdr.write_sequence_length(self.fields.len());
        for (name, offset, datatype) in &self.fields {
            cdr.write_string(name);
            cdr.write_u32(*offset);
            cdr.write_u8(*datatype);
            cdr.write_u32(1);
        }
        cdr.write_bool(self.is_big_endian);
        cdr.write_u32(self.point_step);
        cdr.write_u32(self.row_step);
        cdr.write_bytes(&self.data());
        cdr.write_bool(false);
        bytes
    }

    fn read(&self) -> Result<RosSweep, ReadError> {
        read_point_cloud(&self.bytes::<LittleEndian>([0, 1, 0, 0]), &LIMITS)
    }
}

fn write_value<BO: ByteOrder>(place: &mut [u8], datatype: u8, value: f64) {
    match datatype {
        1 => place[0] = (value as i8).cast_unsigned(),
        2 => place[0] = value as u8,
        3 => BO::write_i16(place, value as i16),
        4 => BO::write_u16(place, value as u16),
        5 => BO::write_i32(place, value as i32),
        6 => BO::write_u32(place, value as u32),
        7 => BO::write_f32(place, value as f32),
        _ => BO::write_f64(place, value),
    }
}

#[test]
fn what_is_written_for_ros_is_read_back() {
    let points = PointCloud {
        xyzi: vec![[1.5, -2.0, 0.25, 0.5], [-70.0, 3.0, -1.8, 1.0]],
    };
    let bytes = crate::encode::point_cloud(1_700_000_000_123_456_789, "cav_1/lidar", &points);
    let sweep = read_point_cloud(&bytes, &LIMITS).unwrap();
    let expected = RosSweep {
        capture_nanos: 1_700_000_000_123_456_789,
        frame_id: "cav_1/lidar".into(),
        points,
        intensity: Some(("intensity".into(), IntensityKind::Number)),
        without_return: 0,
        too_far: 0,
    };
    assert_eq!(sweep, expected);
}

/// Intensity of the only point of a cloud, and its field as it is found.
fn read_intensity(
    name: &'static str,
    datatype: u8,
    value: f64,
) -> (f32, Option<(String, IntensityKind)>) {
    let fields = vec![("X", 0, 7), ("y", 4, 7), ("z", 8, 7), (name, 12, datatype)];
    let cloud = Cloud {
        fields,
        ..Cloud::plain(&[[1.0, 2.0, 3.0, value]])
    };
    let sweep = cloud.read().unwrap();
    (sweep.points.xyzi[0][3], sweep.intensity)
}

#[test]
fn intensities_are_found_by_the_names_that_files_have() {
    for name in ["Intensity", "i", "reflectivity", "signal"] {
        let expected = Some((name.to_owned(), IntensityKind::Number));
        assert_eq!(read_intensity(name, 7, 255.0), (255.0, expected));
    }
    let byte = Some(("intensity".to_owned(), IntensityKind::Byte));
    assert_eq!(read_intensity("intensity", 2, 7.0), (7.0, byte));
    let red = Some(("rgb".to_owned(), IntensityKind::RedByte));
    let colour = f64::from(0x00c2_0102);
    assert_eq!(read_intensity("rgb", 6, colour), (194.0, red));
    assert_eq!(read_intensity("ring", 7, 9.0), (0.0, None));
}

#[test]
fn points_without_return_or_out_of_range_are_left_out_and_counted() {
    let nan = f64::NAN;
    let far = [1e7, 0.0, 0.0, 0.0];
    let mut cloud = Cloud::plain(&[
        [1.0, 2.0, 3.0, nan],
        [nan; 4],
        far,
        [f64::INFINITY, 0.0, 0.0, 0.0],
        [4.0, 5.0, 6.0, 7.0],
        [nan; 4],
    ]);
    (cloud.height, cloud.width, cloud.row_step) = (2, 3, 64);
    let sweep = cloud.read().unwrap();
    assert_eq!(
        sweep.points.xyzi,
        [[1.0, 2.0, 3.0, 0.0], [4.0, 5.0, 6.0, 7.0]]
    );
    assert_eq!(
        (sweep.without_return, sweep.too_far, sweep.capture_nanos),
        (3, 1, 1_000_000_005)
    );
}

#[test]
fn layouts_of_drivers_are_read() {
    let points = [[1.0, 2.0, 3.0, 100.0], [4.0, 5.0, 6.0, 200.0]];
    let plain = Cloud::plain(&points);
    let expected = points.map(|point| point.map(|value| value as f32));
    let clouds = [
        // PCL: 16 bytes of coordinates, intensity, ring, padding.
        Cloud {
            fields: vec![
                ("x", 0, 7),
                ("y", 4, 7),
                ("z", 8, 7),
                ("intensity", 16, 7),
                ("ring", 20, 4),
            ],
            point_step: 32,
            row_step: 64,
            ..plain.clone()
        },
        // Intensity of 8 bits first, coordinates of 64 bits, unaligned.
        Cloud {
            fields: vec![("intensity", 0, 2), ("z", 1, 8), ("y", 9, 8), ("x", 17, 8)],
            point_step: 25,
            row_step: 50,
            ..plain.clone()
        },
        // No step of rows for the only row.
        Cloud {
            row_step: 32,
            ..plain.clone()
        },
        Cloud {
            is_big_endian: true,
            ..plain.clone()
        },
    ];
    for cloud in clouds {
        assert_eq!(cloud.read().unwrap().points.xyzi, expected, "{cloud:?}");
        let bytes = cloud.bytes::<BigEndian>([0, 0, 0, 0]);
        assert_eq!(
            read_point_cloud(&bytes, &LIMITS).unwrap().points.xyzi,
            expected,
            "{cloud:?}"
        );
    }
    let without = Cloud {
        fields: plain.fields[..3].to_vec(),
        ..plain
    };
    assert!(
        without
            .read()
            .unwrap()
            .points
            .xyzi
            .iter()
            .all(|point| point[3] == 0.0)
    );
}

/// The cloud with another field in that place: name, offset and datatype.
fn with_field(cloud: &Cloud, index: usize, field: (&'static str, u32, u8)) -> Cloud {
    let mut fields = cloud.fields.clone();
    fields[index] = field;
    Cloud {
        fields,
        ..cloud.clone()
    }
}

#[test]
fn a_wrong_message_is_named_with_field_and_values() {
    let plain = Cloud::plain(&[[1.0, 2.0, 3.0, 4.0]; 3]);
    for (cloud, expected) in [
        (
            Cloud {
                stamp: (-1, 0),
                ..plain.clone()
            },
            "header.stamp is -1 s and 0 ns",
        ),
        (
            Cloud {
                stamp: (1, 1_000_000_000),
                ..plain.clone()
            },
            "1000000000 ns",
        ),
        (
            with_field(&plain, 1, ("range", 4, 7)),
            r#"no field "y" among ["x", "range", "z", "intensity"]"#,
        ),
        (
            with_field(&plain, 2, ("z", 8, 4)),
            r#"field "z" has datatype 4 and count 1, not datatype 7 or 8"#,
        ),
        (
            with_field(&plain, 3, ("intensity", 8, 9)),
            r#"field "intensity" has datatype 9"#,
        ),
        (
            Cloud {
                point_step: 15,
                ..plain.clone()
            },
            "point_step is 15, not at least 16",
        ),
        (
            Cloud {
                width: 4,
                ..plain.clone()
            },
            "length of data is 48, not at least 64",
        ),
        (
            Cloud {
                height: 3,
                width: 2,
                row_step: 31,
                points: Vec::new(),
                ..plain.clone()
            },
            "row_step is 31",
        ),
        (
            Cloud {
                height: 1 << 16,
                width: 17,
                row_step: 0,
                points: Vec::new(),
                ..plain.clone()
            },
            "1114112, at most 1048576",
        ),
    ] {
        let error = cloud.read().unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let bytes = plain.bytes::<LittleEndian>([0, 1, 0, 0]);
    let error = read_point_cloud(&bytes[..bytes.len() - 10], &LIMITS)
        .unwrap_err()
        .to_string();
    assert!(error.starts_with("data at byte "), "{error}");
    for bytes in [&[][..], &[0, 1], &[0, 3, 0, 0, 1], &[9; 40]] {
        let error = read_point_cloud(bytes, &LIMITS).unwrap_err().to_string();
        assert!(error.starts_with("encoding "), "{bytes:?}: {error}");
    }
}

/// Any order, offsets, types, byte order and padding.
fn any_cloud() -> impl Strategy<Value = Cloud> {
    let types = (prop::bool::ANY, prop::bool::ANY, prop::bool::ANY, 1_u8..=8);
    let paddings = prop::array::uniform5(0_u32..6);
    let order = Just([0_usize, 1, 2, 3]).prop_shuffle();
    (
        types,
        paddings,
        order,
        1_u32..5,
        1_u32..6,
        any::<bool>(),
        0_u32..20,
    )
        .prop_flat_map(
            |((x, y, z, intensity), paddings, order, height, width, is_big_endian, row_padding)| {
                let [x, y, z] = [x, y, z].map(|is_double| if is_double { 8 } else { 7 });
                let datatypes = [x, y, z, intensity];
                let mut fields = Vec::new();
                let mut end = 0;
                for (index, padding) in order.into_iter().zip(paddings) {
                    let offset = end + padding;
                    fields.push((
                        ["x", "y", "z", "intensity"][index],
                        offset,
                        datatypes[index],
                    ));
                    end = offset + Datatype::from_repr(datatypes[index]).unwrap().size();
                }
                let point_step = end + paddings[4];
                let value = -127_i32..=127;
                let intensity = 0_i32..=127;
                let point = (value.clone(), value.clone(), value, intensity);
                let point = point.prop_map(|(x, y, z, i)| [x, y, z, i].map(f64::from));
                prop::collection::vec(point, (height * width) as usize).prop_map(move |points| {
                    Cloud {
                        stamp: (7, 8),
                        height,
                        width,
                        fields: fields.clone(),
                        is_big_endian,
                        point_step,
                        row_step: width * point_step + row_padding,
                        points,
                    }
                })
            },
        )
}

proptest! {
    #[test]
    fn every_layout_gives_the_same_points(cloud in any_cloud()) {
        let expected: Vec<[f32; 4]> = cloud.points.iter().map(|point| point.map(|value| value as f32)).collect();
        let sweeps = [cloud.bytes::<LittleEndian>([0, 1, 0, 0]), cloud.bytes::<BigEndian>([0, 0, 0, 0])];
        for bytes in sweeps {
            prop_assert_eq!(&read_point_cloud(&bytes, &LIMITS).unwrap().points.xyzi, &expected);
        }
    }

    #[test]
    fn changed_bytes_are_refused_or_read_within_the_limits(
        cloud in any_cloud(),
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6),
        cut in any::<prop::sample::Index>(),
    ) {
        let mut bytes = cloud.bytes::<LittleEndian>([0, 1, 0, 0]);
        for (place, byte) in changes {
            let place = place.index(bytes.len());
            bytes[place] = byte;
        }
        for bytes in [&bytes[..], &bytes[..cut.index(bytes.len())]] {
            if let Ok(sweep) = read_point_cloud(bytes, &LIMITS) {
                prop_assert!(sweep.points.xyzi.iter().flatten().all(|value| value.abs() <= LIMITS.max_abs_value));
                prop_assert!(sweep.points.len() <= bytes.len());
            }
        }
    }
}
