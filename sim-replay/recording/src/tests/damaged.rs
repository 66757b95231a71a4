//! Recordings that are cut, damaged or rewritten by another program.

use mcap::{Compression, WriteOptions};
use proptest::collection::vec;
use proptest::prelude::*;

use super::*;

/// The same messages as written by another program.
fn rewritten(recording: &Recording, options: WriteOptions) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut writer = options.create(&mut bytes).unwrap();
    for messages in recording.file.all() {
        messages
            .unwrap()
            .iter()
            .for_each(|message| writer.write(message).unwrap());
    }
    writer.finish().unwrap();
    drop(writer);
    bytes.into_inner()
}

/// Compressed by lz4, some messages per chunk.
fn lz4() -> WriteOptions {
    WriteOptions::new()
        .compression(Some(Compression::Lz4))
        .chunk_size(Some(2_000))
}

/// Without chunks.
fn unchunked() -> WriteOptions {
    WriteOptions::new().compression(None).use_chunks(false)
}

#[test]
fn a_recording_that_another_program_has_rewritten_is_read_alike() {
    for options in [lz4(), unchunked()] {
        let folder = tempfile::tempdir().unwrap();
        let own = Recording::open(&write(
            folder.path(),
            &recorded(3, 100, RecordingOptions::default()),
        ))
        .unwrap();
        let (own_messages, bytes) = (messages_of(&own), rewritten(&own, options));
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        assert_eq!(recording.damage(), []);
        assert_eq!(messages_of(&recording), own_messages);
        let expected: Vec<_> = (0..3).flat_map(|tick| tick_messages(tick, 100)).collect();
        assert_eq!(recording.entries().len(), expected.len());
        for (entry, (key, payload)) in recording.entries().iter().zip(&expected) {
            assert_eq!(
                (&entry.key, &recording.read(entry).unwrap()),
                (key, payload)
            );
        }
        assert_eq!(
            dataset::open(folder.path()).unwrap().scenarios[0]
                .ticks
                .len(),
            3,
            "and is a scene"
        );
    }
}

/// Starts of the chunks of a file.
fn chunk_places(bytes: &[u8]) -> Vec<usize> {
    let mut at = mcap::MAGIC.len();
    let mut places = Vec::new();
    while bytes[at] != mcap::records::op::DATA_END {
        if bytes[at] == mcap::records::op::CHUNK {
            places.push(at);
        }
        at += 9 + u64::from_le_bytes(bytes[at + 1..at + 9].try_into().unwrap()) as usize;
    }
    places
}

#[test]
fn chunks_after_a_damaged_one_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let sound = recorded(4, 100, RecordingOptions::default());
    let chunks = chunk_places(&sound);
    // In its records, in the length of its record, in its kind; chunk 1 of 4.
    for (place, bit) in [(100, 1), (2, 1), (7, 0x40), (0, 0x80)] {
        let mut bytes = sound.clone();
        bytes[chunks[1] + place] ^= bit;
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        let [damage] = recording.damage() else {
            panic!("{place}: {:?}", recording.damage())
        };
        assert_eq!(damage.begin_bytes as usize, chunks[1], "{place}: {damage}");
        assert_eq!(
            damage.lost_bytes as usize,
            chunks[2] - chunks[1],
            "{place}: {damage}"
        );
        // They arrived a nanosecond apart.
        assert_eq!(
            (damage.from_s, damage.to_s),
            (Some(0.0), Some(2e-9)),
            "{place}: {damage}"
        );
        let expected: Vec<_> = [0, 2, 3]
            .into_iter()
            .flat_map(|tick| tick_messages(tick, 100))
            .collect();
        let read: Vec<_> = recording
            .entries()
            .iter()
            .map(|entry| (entry.key.clone(), recording.read(entry).unwrap()))
            .collect();
        assert_eq!(read, expected, "{place}");
        let report = recover(
            recording.path(),
            &folder.path().join(format!("{place}.mcap")),
            Default::default(),
        )
        .unwrap();
        assert_eq!((report.messages, report.damage.len()), (3 * 5, 1));
    }
}

#[test]
fn channels_that_a_damaged_chunk_describes_are_known_from_the_summary() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = recorded(3, 10, RecordingOptions::default());
    let first = chunk_places(&bytes)[0];
    bytes[first + 100] ^= 1;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    assert_eq!(
        (recording.entries().len(), recording.damage().len()),
        (2 * 5, 1)
    );
    // Without a summary their names are unknown, which is reported.
    let cut = &bytes[..bytes.len() - 8];
    let error = Recording::open(&write(folder.path(), cut))
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("none of its messages can be read") && !error.contains("no channel"),
        "{error}"
    );
}

#[test]
fn only_the_damaged_message_outside_of_chunks_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let own = Recording::open(&write(
        folder.path(),
        &recorded(3, 10, RecordingOptions::default()),
    ))
    .unwrap();
    let sound = rewritten(&own, unchunked());
    let payloads: Vec<usize> = (0..sound.len() - 4)
        .filter(|at| sound[*at..].starts_with(b"V2VL"))
        .collect();
    assert_eq!(payloads.len(), 15);
    // The length of its record, which precedes 22 bytes of times and numbers.
    let mut bytes = sound.clone();
    bytes[payloads[4] - 22 - 7] ^= 2;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    assert_eq!(
        (recording.entries().len(), recording.damage().len()),
        (14, 1),
        "{:?}",
        recording.damage()
    );
    // A bit without any other checksum: the time of arrival.
    let mut bytes = sound;
    bytes[payloads[4] - 10] ^= 2;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    let [damage] = recording.damage() else {
        panic!("{:?}", recording.damage())
    };
    assert!(
        recording.entries().len() == 15 && damage.reason.contains("checksum of the data"),
        "{damage}"
    );
}

#[test]
fn a_chunk_that_asks_for_a_huge_window_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let options = RecordingOptions {
        zstd_level: Some(1),
        contents: Contents::Messages,
    };
    let mut bytes = recorded(3, 100, options);
    let frame = bytes
        .windows(4)
        .position(|bytes| bytes == [0x28, 0xb5, 0x2f, 0xfd])
        .unwrap();
    // The window descriptor of the frame: 2 GiB. zstd itself allows a stream 128 MiB, and checks before it allocates.
    assert_eq!(bytes[frame + 4] & 0x20, 0, "a frame with a window");
    bytes[frame + 5] = 21 << 3;
    let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
    let [damage] = recording.damage() else {
        panic!("{:?}", recording.damage())
    };
    assert!(damage.reason.contains("too much memory"), "{damage}");
    assert_eq!(
        recording.entries().len(),
        2 * 5,
        "the other chunks are read"
    );
}

#[test]
fn chunks_that_unpack_to_far_more_than_the_file_are_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let options = WriteOptions::new()
        .compression(Some(Compression::Zstd))
        .emit_summary_records(false);
    let mut bytes = std::io::Cursor::new(Vec::new());
    let mut writer = options.create(&mut bytes).unwrap();
    let message = mcap::Message {
        channel: std::sync::Arc::new(mcap::Channel {
            id: 0,
            topic: "zeros".into(),
            schema: None,
            message_encoding: "cdr".into(),
            metadata: std::collections::BTreeMap::new(),
        }),
        sequence: 0,
        log_time: 1,
        publish_time: 1,
        data: std::borrow::Cow::Owned(vec![0; 20 << 20]),
    };
    writer.write(&message).unwrap();
    writer.finish().unwrap();
    drop(writer);
    let bytes = bytes.into_inner();
    let begin = chunk_places(&bytes)[0];
    let len = 9 + u64::from_le_bytes(bytes[begin + 1..begin + 9].try_into().unwrap()) as usize;
    let (head, chunk) = (&bytes[..begin], &bytes[begin..begin + len]);
    let file = [head, &chunk.repeat(10), &bytes[begin + len..]].concat();
    let mut read = 0;
    let file = McapFile::open(&write(folder.path(), &file), &mut |_, _| {
        read += 1;
        true
    })
    .unwrap();
    // 64 MiB, and 300 times a file of some kilobytes.
    assert!((4..8).contains(&read), "{read} of 10 messages");
    let damage = file
        .damage()
        .iter()
        .map(ToString::to_string)
        .collect::<Vec<_>>();
    assert!(
        damage[0].contains("at most are read of a file of this size"),
        "{damage:?}"
    );
}

#[test]
fn a_record_that_reaches_beyond_its_chunk_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let mut bytes = recorded(
        1,
        100,
        RecordingOptions {
            zstd_level: None,
            contents: Contents::Messages,
        },
    );
    let number =
        |bytes: &[u8], at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
    // Two times are followed by the unpacked length, the checksum (0: none), an empty name of the compression, the
    // length.
    let chunk = chunk_places(&bytes)[0] + 9;
    bytes[chunk + 24..chunk + 28].fill(0);
    assert_eq!(bytes[chunk + 28..chunk + 32], [0; 4]);
    let shorter = number(&bytes, chunk + 32) - 4;
    bytes[chunk + 32..chunk + 40].copy_from_slice(&shorter.to_le_bytes());
    let error = Recording::open(&write(folder.path(), &bytes)).unwrap_err();
    assert!(
        error
            .to_string()
            .contains("differs in length from its contents"),
        "{error}"
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn a_cut_recording_reads_up_to_its_last_whole_chunk(at in 0.0_f64..1.0, packed: bool) {
        let options = RecordingOptions { zstd_level: packed.then_some(1), contents: Contents::All };
        let whole = recorded(4, 40, options);
        let folder = tempfile::tempdir().unwrap();
        let cut = (at * whole.len() as f64) as usize;
        let all: Vec<_> = (0..4).flat_map(|tick| tick_messages(tick, 40)).collect();
        match Recording::open(&write(folder.path(), &whole[..cut])) {
            Err(error) => prop_assert!(matches!(error, RecordingError::NotOurs { .. }), "{}", error),
            Ok(recording) => {
                let count = recording.entries().len();
                prop_assert_eq!(count % 5, 0, "whole chunks, which are whole ticks here");
                for (entry, (key, payload)) in recording.entries().iter().zip(&all) {
                    prop_assert_eq!(&entry.key, key);
                    prop_assert_eq!(&recording.read(entry).unwrap(), payload);
                }
                if let Some(damage) = recording.damage().last() {
                    prop_assert_eq!(damage.begin_bytes + damage.lost_bytes, cut as u64);
                } else {
                    prop_assert_eq!(count, 20);
                }
            }
        }
    }

    #[test]
    fn one_bit_costs_one_chunk_at_most_and_is_noticed(at in 0.0_f64..1.0, bit in 0_u8..8, compression in 0..3) {
        let zstd_level = (compression == 1).then_some(1);
        let mut bytes = recorded(4, 40, RecordingOptions { zstd_level, ..RecordingOptions::default() });
        let folder = tempfile::tempdir().unwrap();
        if compression == 2 {
            bytes = rewritten(&Recording::open(&write(folder.path(), &bytes)).unwrap(), lz4());
        }
        let at = (at * bytes.len() as f64) as usize;
        bytes[at] ^= 1 << bit;
        let all: Vec<_> = (0..4).flat_map(|tick| tick_messages(tick, 40)).collect();
        let recording = Recording::open(&write(folder.path(), &bytes)).unwrap();
        let read: Vec<_> =
            recording.entries().iter().map(|entry| (entry.key.clone(), recording.read(entry).unwrap())).collect();
        prop_assert!(read.len() >= all.len() - 5, "{:?}", recording.damage());
        prop_assert!(read.len() == all.len() || !recording.damage().is_empty());
        let mut left = all.iter();
        prop_assert!(read.iter().all(|message| left.any(|written| written == message)), "in the order of the file");
    }

    #[test]
    fn random_damage_never_panics(places in vec((0.0_f64..1.0, any::<u8>()), 1..40), without_chunks: bool) {
        let mut bytes = recorded(3, 10, RecordingOptions::default());
        let folder = tempfile::tempdir().unwrap();
        if without_chunks {
            bytes = rewritten(&Recording::open(&write(folder.path(), &bytes)).unwrap(), unchunked());
        }
        for (at, byte) in places {
            let at = (at * bytes.len() as f64) as usize;
            bytes[at] = byte;
        }
        if let Ok(recording) = Recording::open(&write(folder.path(), &bytes)) {
            prop_assert!(recording.entries().iter().all(|entry| recording.read(entry).is_ok()));
        }
    }
}
