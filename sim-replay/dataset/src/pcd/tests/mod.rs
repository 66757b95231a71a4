//! Files as written by common writers, complete and damaged.

mod file;
mod writers;

use std::sync::LazyLock;

use proptest::prelude::*;

use super::*;
use file::{File, Number};

/// A file of each kind to damage: our own, and those of PCL and Open3D with their trailing bytes.
static SAMPLES: LazyLock<Vec<Vec<u8>>> = LazyLock::new(|| {
    let cloud = PointCloud {
        xyzi: (0..20)
            .map(|i| [i as f32, -1.5, 0.25, 1.0 - i as f32 / 64.0])
            .collect(),
    };
    let ours = [Encoding::Ascii, Encoding::Binary]
        .into_iter()
        .flat_map(|encoding| {
            [IntensityField::Intensity, IntensityField::Red].map(|field| (encoding, field))
        })
        .map(|(encoding, field)| encode(&cloud, encoding, field));
    ours.chain([binary::tests::compressed(&cloud)])
        .chain(writers::all().into_iter().map(|variant| variant.bytes))
        .collect()
});

#[test]
fn every_truncation_is_an_error_or_cuts_unneeded_bytes() {
    for file in SAMPLES.iter() {
        let whole = decode(file).unwrap();
        let is_text = file.windows(10).any(|window| window == b"DATA ascii");
        for length in 0..file.len() {
            let Ok(cloud) = decode(&file[..length]) else {
                continue;
            };
            // Digits of the last number may be cut; bytes after the points are not needed.
            let (all, kept) = (
                whole.points.len() + whole.dropped,
                cloud.points.len() + cloud.dropped,
            );
            assert_eq!(kept, all, "{length} of {}", file.len());
            let last_token = file.len()
                - file
                    .iter()
                    .rev()
                    .skip(2)
                    .position(|&byte| byte == b' ')
                    .unwrap_or(0)
                - 2;
            assert!(
                if is_text {
                    length >= last_token - 1
                } else {
                    same_bits(&cloud, &whole)
                },
                "{length} of {}",
                file.len()
            );
        }
    }
}

fn same_bits(a: &PcdCloud, b: &PcdCloud) -> bool {
    let bits = |cloud: &PcdCloud| {
        cloud
            .points
            .xyzi
            .iter()
            .map(|point| point.map(f32::to_bits))
            .collect::<Vec<_>>()
    };
    bits(a) == bits(b)
}

proptest! {
    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..600)) {
        let _ = decode(&bytes);
    }

    #[test]
    fn damage_never_panics_nor_reserves_more_than_the_file_explains(
        which in any::<prop::sample::Index>(),
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in any::<prop::sample::Index>(),
        (at, inserted) in (any::<prop::sample::Index>(), prop::collection::vec(any::<u8>(), 0..9)),
    ) {
        let mut file = which.get(&SAMPLES).clone();
        for (at, value) in flips {
            let at = at.index(file.len());
            file[at] = value;
        }
        let at = at.index(file.len());
        file.splice(at..at, inserted);
        if cut.index(4) == 0 {
            file.truncate(cut.index(file.len()));
        }
        if let Ok(cloud) = decode(&file) {
            // A byte of LZF expands to 88 at most, and three bytes of a point to 16.
            prop_assert!(cloud.points.xyzi.capacity() <= 88 * file.len());
        }
    }

    #[test]
    fn any_body_under_a_sound_header_never_panics(
        kind in prop::sample::select(vec!["ascii", "binary", "binary_compressed"]),
        points in prop::sample::select(vec![0u64, 1, 7, 1 << 20, 1 << 40, u64::MAX]),
        counts in prop::sample::select(vec!["1 1 1 1 0", "1 1 1 1 65536"]),
        body in prop::collection::vec(any::<u8>(), 0..300),
    ) {
        let mut file = format!(
            "VERSION 0.7\nFIELDS x y z rgb _\nSIZE 4 4 4 4 8\nTYPE F F F F U\nCOUNT {counts}\nWIDTH {points}\n\
             HEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n"
        ).into_bytes();
        file.extend(body);
        let _ = decode(&file);
    }
}

#[test]
fn the_message_names_line_and_field() {
    let error = PcdError::at(9, "POINTS", "3, but WIDTH x HEIGHT is 4");
    assert_eq!(
        error.to_string(),
        "line 9: POINTS: 3, but WIDTH x HEIGHT is 4"
    );
}

#[test]
fn numbers_of_all_types_are_read_from_all_encodings() {
    let numbers = [
        Number::F4(-1.25),
        Number::F8(7.5),
        Number::U1(200),
        Number::U2(40_000),
        Number::U4(70_000),
        Number::I1(-3),
        Number::I2(-300),
        Number::I4(-70_000),
    ];
    let expected = [
        -1.25, 7.5, 200.0, 40_000.0, 70_000.0, -3.0, -300.0, -70_000.0,
    ];
    for (number, expected) in numbers.into_iter().zip(expected) {
        let one = Number::F4(1.0);
        let file = File::new(
            &[
                ("x", number),
                ("y", one),
                ("z", number),
                ("Intensity", number),
            ],
            3,
        );
        for bytes in file.in_all_encodings() {
            let cloud = decode(&bytes).unwrap();
            assert_eq!(cloud.points.xyzi, [[expected, 1.0, expected, expected]; 3]);
            assert_eq!(cloud.intensity.unwrap().field, "Intensity");
        }
    }
}
