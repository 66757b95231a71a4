//! Fuzz target of wire messages; in most cases a damaged message is sealed again, so that it passes the checksums.
#![no_main]

use libfuzzer_sys::{fuzz_mutator, fuzz_target, fuzzer_mutate};
use support::random::SplitMix64;
use tests::mutation::wire_target::{damage_message, read, reseal};

fuzz_target!(|bytes: &[u8]| {
    read(bytes);
});

fuzz_mutator!(|bytes: &mut [u8], size: usize, most: usize, seed: u32| {
    let mut random = SplitMix64::new(seed.into());
    if random.chance(0.5) {
        let mut changed = bytes[..size].to_vec();
        damage_message(&mut changed, &bytes[..size], &mut random);
        changed.truncate(most);
        bytes[..changed.len()].copy_from_slice(&changed);
        return changed.len();
    }
    let size = fuzzer_mutate(bytes, size, most);
    reseal(&mut bytes[..size], random.chance(0.5));
    size
});
