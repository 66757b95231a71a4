//! LZF, the compression of `DATA binary_compressed`.
//!
//! The stream is a row of blocks. A control byte below 32 is followed by that many literal bytes plus one. Any other
//! control byte repeats earlier output: its upper three bits are the length minus two (7: one more byte adds to it),
//! its lower five bits and one more byte are the distance back minus one.

/// Largest number of output bytes per input byte: three bytes of input repeat up to 264.
const MAX_RATIO: usize = 88;

const CUT_OFF: &str = "the packed bytes end inside a block";

/// Unpacks exactly `unpacked_len` bytes.
///
/// # Errors
/// A sentence if the bytes are not an LZF stream of that length.
pub(super) fn decompress(packed: &[u8], unpacked_len: usize) -> Result<Vec<u8>, String> {
    // Before the reservation: a false length must not claim the memory.
    let len = packed.len();
    if len.saturating_mul(MAX_RATIO) < unpacked_len {
        return Err(format!("{len} packed bytes cannot become {unpacked_len}"));
    }
    let mut output = Vec::with_capacity(unpacked_len);
    let mut input = packed;
    while let Some((&control, rest)) = input.split_first() {
        let control = usize::from(control);
        input = if control < 32 {
            let (literals, rest) = rest.split_at_checked(control + 1).ok_or(CUT_OFF)?;
            output.extend_from_slice(literals);
            rest
        } else {
            repeat(&mut output, rest, control)?
        };
        if output.len() > unpacked_len {
            break;
        }
    }
    match output.len() {
        found if found == unpacked_len => Ok(output),
        found => Err(format!("{found} bytes unpacked, {unpacked_len} stated")),
    }
}

fn repeat<'a>(output: &mut Vec<u8>, input: &'a [u8], control: usize) -> Result<&'a [u8], String> {
    let mut next = input.iter();
    let mut count = (control >> 5) + 2;
    // 7 in the three bits: one more byte of the length, before that of the distance.
    if count == 9 {
        count += byte(&mut next)?;
    }
    let distance = ((control & 31) << 8) + byte(&mut next)? + 1;
    let len = output.len();
    let start = len.checked_sub(distance).ok_or_else(|| {
        format!("a block repeats output {distance} bytes back, but only {len} bytes precede it")
    })?;
    // The repeated range may overlap the output: what is there of it is copied until that suffices.
    let mut left = count;
    while left > 0 {
        let copied = left.min(output.len() - start);
        output.extend_from_within(start..start + copied);
        left -= copied;
    }
    Ok(next.as_slice())
}

fn byte(input: &mut std::slice::Iter<'_, u8>) -> Result<usize, String> {
    let byte = input.next().ok_or(CUT_OFF)?;
    Ok(usize::from(*byte))
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Moves the pending bytes to the packed ones, as literals.
    fn flush(packed: &mut Vec<u8>, pending: &mut Vec<u8>) {
        for block in pending.chunks(32) {
            packed.push(block.len() as u8 - 1);
            packed.extend_from_slice(block);
        }
        pending.clear();
    }

    /// A simple packer: greedy over the last 8 KiB. Slow, but sufficient for test files.
    pub(in crate::pcd) fn compress(data: &[u8]) -> Vec<u8> {
        let mut packed = Vec::new();
        let mut pending: Vec<u8> = Vec::new();
        let mut at = 0;
        while at < data.len() {
            let best = (at.saturating_sub(512)..at)
                .map(|start| {
                    let length = (0..264.min(data.len() - at))
                        .take_while(|&i| data[start + i] == data[at + i])
                        .count();
                    (length, start)
                })
                .max();
            match best.filter(|&(length, _)| length >= 3) {
                Some((length, start)) => {
                    flush(&mut packed, &mut pending);
                    let distance = at - start - 1;
                    let code = length - 2;
                    packed.push(((code.min(7) << 5) | (distance >> 8)) as u8);
                    if code >= 7 {
                        packed.push((code - 7) as u8);
                    }
                    packed.push(distance as u8);
                    at += length;
                }
                None => {
                    pending.push(data[at]);
                    at += 1;
                }
            }
        }
        flush(&mut packed, &mut pending);
        packed
    }

    proptest! {
        #[test]
        fn packed_bytes_come_back(data in prop::collection::vec(0..4u8, 0..1500)) {
            let packed = compress(&data);
            prop_assert_eq!(decompress(&packed, data.len()).unwrap(), data);
        }

        #[test]
        fn random_bytes_never_panic(packed in prop::collection::vec(any::<u8>(), 0..200), stated in 0..20_000usize) {
            if let Ok(output) = decompress(&packed, stated) {
                prop_assert_eq!(output.len(), stated);
            }
        }
    }

    #[test]
    fn an_overlapping_repeat_is_a_run() {
        // Literal 'a', then 9 + 4 times what lies one byte back.
        assert_eq!(decompress(&[0, b'a', 0xe0, 4, 0], 14).unwrap(), [b'a'; 14]);
    }

    #[test]
    fn an_impossible_stream_is_refused() {
        let cases: [(&[u8], usize, &str); 4] = [
            (
                &[0, b'a'],
                1_000_000,
                "2 packed bytes cannot become 1000000",
            ),
            (&[3, b'a'], 4, CUT_OFF),
            (
                &[0, b'a', 0x20, 9],
                4,
                "a block repeats output 10 bytes back, but only 1 bytes precede it",
            ),
            (&[0, b'a'], 2, "1 bytes unpacked, 2 stated"),
        ];
        for (packed, stated, expected) in cases {
            assert_eq!(decompress(packed, stated).unwrap_err(), expected);
        }
    }
}
