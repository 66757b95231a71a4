//! Damaged inputs through every reader: no panic, and no memory allocated for a length that only a header claims.
//! `cargo bench -p tests --bench mutation` is the long run.

use dataset::pcd;
use tests::locks::exclusive_lock;
use tests::mutation::readers::all as all_readers;
use tests::mutation::run::{Report, files, formats, messages};
use tests::mutation::scratch;
use tests::mutation::wire_target::{self, LIMITS};

use crate::MEMORY;

fn check(reports: impl IntoIterator<Item = Report>) {
    for report in reports {
        eprintln!("{report:?}");
        assert!(
            report.panics.is_empty(),
            "{}: cases {:?} panicked",
            report.name,
            report.panics
        );
        assert!(
            report.accepted < report.cases,
            "{}: nothing is refused",
            report.name
        );
        assert!(
            report.peak_bytes as u64 <= 2 * LIMITS.max_body_bytes,
            "{}: {} bytes",
            report.name,
            report.peak_bytes
        );
    }
}

/// Peak of memory during `read`, bytes; the least of three runs, as the test harness has threads of its own.
fn peak_bytes(read: impl Fn()) -> usize {
    let once = |_| {
        MEMORY.reset_peak_usage();
        let held = MEMORY.current_usage();
        read();
        MEMORY.peak_usage().saturating_sub(held)
    };
    (0..3).map(once).min().unwrap_or_default()
}

#[test]
fn damaged_messages_are_refused_or_sound() {
    let _exclusive = exclusive_lock();
    check([messages(100_000, 1, &MEMORY)]);
}

#[test]
fn damaged_files_are_refused_or_sound() {
    let _exclusive = exclusive_lock();
    let scratch = scratch();
    check(files(scratch.path(), 3_000, 1, &MEMORY));
}

#[test]
fn every_format_has_a_fuzz_target_with_sound_seeds() {
    let _exclusive = exclusive_lock();
    let scratch = scratch();
    let fuzz = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).with_file_name("fuzz");
    let targets = std::fs::read_to_string(fuzz.join("Cargo.toml")).unwrap();
    let readers = all_readers(scratch.path());
    for (name, seeds) in formats(scratch.path()) {
        let target = name.replace(' ', "_");
        assert!(
            targets.contains(&format!("name = \"{target}\"\n")),
            "{target} is no target"
        );
        for number in 0..seeds.len() {
            let bytes = std::fs::read(
                fuzz.join("seeds")
                    .join(&target)
                    .join(format!("{number:02}")),
            )
            .unwrap();
            let reader = readers.iter().find(|reader| reader.name == name);
            let is_sound = reader.map_or_else(
                || wire_target::read(&bytes),
                |reader| reader.try_read(&bytes),
            );
            assert!(is_sound, "{target} {number}");
        }
    }
}

#[test]
fn a_cloud_takes_memory_by_its_bytes_and_not_by_its_header() {
    let _exclusive = exclusive_lock();
    for data in ["ascii", "binary", "binary_compressed"] {
        for (sizes, counts) in [("1 1 1 1", "1 1 1 0"), ("4 4 4 8", "1 1 1 65536")] {
            let mut file =
                format!("FIELDS x y z _\nSIZE {sizes}\nTYPE U U U U\nCOUNT {counts}\nWIDTH 50000000\nDATA {data}\n")
                    .into_bytes();
            // Lengths of compressed data, if it is compressed: a few bytes that claim to become 150 MB.
            file.extend(8_u32.to_le_bytes());
            file.extend(150_000_000_u32.to_le_bytes());
            file.extend([0; 8]);
            let peak_bytes = peak_bytes(|| assert!(pcd::decode(&file).is_err()));
            assert!(peak_bytes < 65_536, "{data}: {peak_bytes} bytes");
        }
    }
}

#[test]
fn a_message_of_15_bytes_that_claims_2_to_the_42_takes_no_memory() {
    let _exclusive = exclusive_lock();
    let mut bytes = [0; 15];
    bytes[..8].copy_from_slice(&(1_u64 << 42).to_le_bytes());
    let peak_bytes = peak_bytes(|| assert!((0..1000).all(|_| !wire_target::read(&bytes))));
    assert!(peak_bytes < 4096, "{peak_bytes} bytes");
}
