//! Runs many damaged inputs through one reader and reports the outcome.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

use peak_alloc::PeakAlloc;
use support::random::SplitMix64;

use super::{damage, readers, seeds, wire_target};

/// Report on one format.
#[derive(Debug, Clone)]
pub struct Report {
    /// Name of the format.
    pub name: &'static str,
    /// Number of damaged inputs.
    pub cases: u64,
    /// Number of accepted inputs: the damage left them valid.
    pub accepted: u64,
    /// Seeds of the cases that panicked.
    pub panics: Vec<u64>,
    /// Largest memory of one case beyond that before it.
    pub peak_bytes: usize,
    /// Total time.
    pub took: Duration,
}

/// Runs damaged messages from `seed` on.
///
/// # Panics
/// When a valid one is not accepted undamaged: then nothing after the first check would be tested.
#[must_use]
pub fn messages(cases: u64, seed: u64, meter: &PeakAlloc) -> Report {
    let damage = wire_target::damage_message;
    one(
        ("messages", &seeds::messages()),
        cases,
        seed,
        meter,
        damage,
        &wire_target::read,
    )
}

/// Runs damaged files of every format from `seed` on, one format after the other as reports are requested.
///
/// # Panics
/// As [`messages`].
pub fn files(
    scratch: &Path,
    cases: u64,
    seed: u64,
    meter: &PeakAlloc,
) -> impl Iterator<Item = Report> {
    readers::all(scratch).into_iter().map(move |reader| {
        let read = |bytes: &[u8]| reader.try_read(bytes);
        one(
            (reader.name, &reader.seeds),
            cases,
            seed,
            meter,
            damage,
            &read,
        )
    })
}

/// Every format with its valid inputs.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn formats(scratch: &Path) -> Vec<(&'static str, Vec<Vec<u8>>)> {
    let files = readers::all(scratch)
        .into_iter()
        .map(|reader| (reader.name, reader.seeds));
    std::iter::once(("messages", seeds::messages()))
        .chain(files)
        .collect()
}

fn one(
    (name, sound): (&'static str, &[Vec<u8>]),
    cases: u64,
    seed: u64,
    meter: &PeakAlloc,
    damage: fn(&mut Vec<u8>, &[u8], &mut SplitMix64),
    read: &dyn Fn(&[u8]) -> bool,
) -> Report {
    for (number, bytes) in sound.iter().enumerate() {
        assert!(read(bytes), "{name}: sound input {number} is refused");
    }
    let (begun, mut accepted, mut panics, mut peak_bytes) = (Instant::now(), 0, Vec::new(), 0);
    for case in 0..cases {
        let mut random = SplitMix64::derived(seed, &[case]);
        let mut bytes = sound[random.below(sound.len())].clone();
        damage(&mut bytes, &sound[random.below(sound.len())], &mut random);
        meter.reset_peak_usage();
        let held = meter.current_usage();
        match catch_unwind(AssertUnwindSafe(|| read(&bytes))) {
            Ok(was_accepted) => accepted += u64::from(was_accepted),
            Err(_) => panics.push(case),
        }
        peak_bytes = peak_bytes.max(meter.peak_usage().saturating_sub(held));
    }
    Report {
        name,
        cases,
        accepted,
        panics,
        peak_bytes,
        took: begun.elapsed(),
    }
}
