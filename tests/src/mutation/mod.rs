//! Random damage to inputs, reproducible by seed: for the tests, the long run of `cargo bench -p tests --bench
//! mutation` and the targets in `fuzz/`.

pub mod readers;
pub mod run;
pub mod seeds;
pub mod wire_target;

use support::random::SplitMix64;

/// Largest damaged input, bytes: a reader that needs much memory for so little trusts a length in the input.
pub const MAX_BYTES: usize = 1 << 16;

/// Whole numbers that lengths and counts are set to.
const EXTREMES: [u64; 12] = [
    0,
    1,
    0x7f,
    0xff,
    0x7fff,
    0xffff,
    0x7fff_ffff,
    0xffff_ffff,
    1 << 42,
    i64::MAX as u64,
    u64::MAX - 1,
    u64::MAX,
];
/// Invalid numbers, or numbers far from any valid one.
const NUMBERS: [f64; 8] = [
    f64::NAN,
    f64::INFINITY,
    f64::NEG_INFINITY,
    1e30,
    -1e30,
    1e-320,
    -0.0,
    4_294_967_296.0,
];
/// Texts in place of a number.
const TEXTS: [&str; 12] = [
    "nan",
    "inf",
    "-inf",
    "1e30",
    "-1e400",
    "0",
    "-1",
    "18446744073709551616",
    "0x7f",
    "1e-400",
    "",
    "4398046511104",
];

/// A folder for files that are overwritten often: in memory if the system has a place for that, to spare the disk.
///
/// # Panics
/// When a file cannot be written.
#[must_use]
pub fn scratch() -> tempfile::TempDir {
    let in_memory = tempfile::tempdir_in("/dev/shm");
    in_memory
        .or_else(|_| tempfile::tempdir())
        .expect("a temporary folder")
}

/// Damages `bytes` in one to four ways; `other` is a valid input to take pieces from.
pub fn damage(bytes: &mut Vec<u8>, other: &[u8], random: &mut SplitMix64) {
    let is_text = bytes
        .iter()
        .take(256)
        .all(|byte| byte.is_ascii_graphic() || byte.is_ascii_whitespace());
    for _ in 0..=random.below(4) {
        if is_text && random.chance(0.6) {
            damage_text(bytes, random);
        } else {
            damage_bytes(bytes, other, random);
        }
        bytes.truncate(MAX_BYTES);
    }
}

fn damage_bytes(bytes: &mut Vec<u8>, other: &[u8], random: &mut SplitMix64) {
    let at = random.below(bytes.len().max(1));
    match random.below(10) {
        0 | 1 => flip(bytes, at, random),
        2 => bytes.truncate(at),
        3 => overwrite(bytes, at, &extreme(random)),
        4 => overwrite(bytes, at, &number(random)),
        5 => drop(bytes.drain(piece(bytes.len(), random))),
        6 => {
            // A repeated section.
            let twice = bytes[piece(bytes.len(), random)].to_vec();
            splice(bytes, at, &twice);
        }
        7 => splice(bytes, at, &other[piece(other.len(), random)]),
        8 => {
            let taken = other[piece(other.len(), random)].to_vec();
            overwrite(bytes, at, &taken);
        }
        _ => {
            let noise: Vec<u8> = (0..random.below(64))
                .map(|_| random.below(256) as u8)
                .collect();
            splice(bytes, at, &noise);
        }
    }
}

fn damage_text(bytes: &mut Vec<u8>, random: &mut SplitMix64) {
    let is_number = |byte: &u8| byte.is_ascii_digit() || b"+-.eE".contains(byte);
    match random.below(5) {
        0..=2 => {
            // Replaces the number at or after a random place.
            let from = random.below(bytes.len().max(1));
            let Some(begin) = bytes[from..]
                .iter()
                .position(u8::is_ascii_digit)
                .map(|ahead| from + ahead)
            else {
                return;
            };
            let end = bytes[begin..]
                .iter()
                .position(|byte| !is_number(byte))
                .map_or(bytes.len(), |len| begin + len);
            let text = TEXTS[random.below(TEXTS.len())];
            bytes.splice(begin..end, text.bytes());
        }
        3 => {
            // Repeats or removes a line.
            let at = random.below(bytes.len().max(1));
            let begin = bytes[..at]
                .iter()
                .rposition(|byte| *byte == b'\n')
                .map_or(0, |end| end + 1);
            let end = bytes[at..]
                .iter()
                .position(|byte| *byte == b'\n')
                .map_or(bytes.len(), |len| at + len + 1);
            let line = bytes[begin..end].to_vec();
            if random.chance(0.5) {
                splice(bytes, begin, &line)
            } else {
                drop(bytes.drain(begin..end))
            }
        }
        _ => {
            let open: &[u8] = [
                &b"["[..],
                b"{a: ",
                b"<a>",
                b"- ",
                b"!!python/tuple [",
                b"&a *a ",
            ][random.below(6)];
            splice(
                bytes,
                random.below(bytes.len().max(1)),
                &open.repeat(1 + random.below(300)),
            );
        }
    }
}

fn flip(bytes: &mut [u8], at: usize, random: &mut SplitMix64) {
    if let Some(byte) = bytes.get_mut(at) {
        *byte ^= 1 << random.below(8);
    }
}

fn overwrite(bytes: &mut [u8], at: usize, by: &[u8]) {
    bytes
        .iter_mut()
        .skip(at)
        .zip(by)
        .for_each(|(byte, by)| *byte = *by);
}

fn splice(bytes: &mut Vec<u8>, at: usize, more: &[u8]) {
    let at = at.min(bytes.len());
    bytes.splice(at..at, more.iter().copied());
}

fn piece(len: usize, random: &mut SplitMix64) -> std::ops::Range<usize> {
    let begin = random.below(len.max(1)).min(len);
    let most = if random.chance(0.8) { 32 } else { len };
    begin..(begin + random.below(most.max(1))).min(len)
}

fn extreme(random: &mut SplitMix64) -> Vec<u8> {
    let bytes = EXTREMES[random.below(EXTREMES.len())].to_le_bytes();
    bytes[..1 << random.below(4)].to_vec()
}

fn number(random: &mut SplitMix64) -> Vec<u8> {
    let number = NUMBERS[random.below(NUMBERS.len())];
    if random.chance(0.5) {
        number.to_le_bytes().to_vec()
    } else {
        (number as f32).to_le_bytes().to_vec()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_seed_does_the_same_damage_and_hardly_ever_none() {
        let sound: Vec<u8> = (0..500).map(|place| (place * 7 % 251) as u8).collect();
        let damaged = |seed| {
            let (mut bytes, mut random) = (sound.clone(), SplitMix64::new(seed));
            damage(&mut bytes, b"something else", &mut random);
            bytes
        };
        assert_eq!(damaged(5), damaged(5));
        assert!((0..200).filter(|seed| damaged(*seed) == sound).count() < 40);
        let mut empty = Vec::new();
        (0..200).for_each(|seed| damage(&mut empty, b"", &mut SplitMix64::new(seed)));
    }
}
