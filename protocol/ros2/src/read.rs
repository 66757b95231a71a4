//! Reading of ROS 2 messages in CDR: encapsulation header, byte order, header of the message, errors by field.

use protocol::Pose;
use re_cdr::{BigEndian, CdrReader, LittleEndian};

/// Error of a message that cannot be read: names the encoding, or the field with its position or value.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct ReadError(pub(crate) String);

/// Reader of one message after its encapsulation header, in the byte order that the header states.
pub(crate) struct Reader<'a> {
    cdr: AnyCdr<'a>,
    len: usize,
}

enum AnyCdr<'a> {
    BigEndian(CdrReader<'a, BigEndian>),
    LittleEndian(CdrReader<'a, LittleEndian>),
}

impl<'a> Reader<'a> {
    /// Reader of a message with its encapsulation header.
    pub(crate) fn of(bytes: &'a [u8]) -> Result<Self, ReadError> {
        // Values are aligned from the end of this header on, so the reader begins there.
        let (cdr, len) = match bytes.split_first_chunk() {
            Some(([0, 0, _, _], body)) => (AnyCdr::BigEndian(CdrReader::new(body)), body.len()),
            Some(([0, 1, _, _], body)) => (AnyCdr::LittleEndian(CdrReader::new(body)), body.len()),
            _ => {
                let found: Vec<u8> = bytes.iter().take(4).copied().collect();
                let problem = format!("encoding {found:?}, not 00 00 or 00 01 (CDR)");
                return Err(ReadError(problem));
            }
        };
        Ok(Self { cdr, len })
    }

    /// Reads a value in the byte order of the message, which is part of the type of a [`CdrReader`]: the same method is
    /// given once for each order. An error names `field`.
    fn read<T>(
        &mut self,
        field: &'static str,
        if_big_endian: impl FnOnce(&mut CdrReader<'a, BigEndian>) -> re_cdr::Result<T>,
        if_little_endian: impl FnOnce(&mut CdrReader<'a, LittleEndian>) -> re_cdr::Result<T>,
    ) -> Result<T, ReadError> {
        let (at, read) = match &mut self.cdr {
            AnyCdr::BigEndian(cdr) => (cdr.position(), if_big_endian(cdr)),
            AnyCdr::LittleEndian(cdr) => (cdr.position(), if_little_endian(cdr)),
        };
        let len = self.len;
        read.map_err(|cause| ReadError(format!("{field} at byte {at} of {len}: {cause}")))
    }

    pub(crate) fn u8(&mut self, field: &'static str) -> Result<u8, ReadError> {
        self.read(field, CdrReader::read_u8, CdrReader::read_u8)
    }

    pub(crate) fn u32(&mut self, field: &'static str) -> Result<u32, ReadError> {
        self.read(field, CdrReader::read_u32, CdrReader::read_u32)
    }

    pub(crate) fn str(&mut self, field: &'static str) -> Result<&'a str, ReadError> {
        self.read(field, CdrReader::read_str, CdrReader::read_str)
    }

    /// `uint8[]`.
    pub(crate) fn bytes(&mut self, field: &'static str) -> Result<&'a [u8], ReadError> {
        let (big, little) = (CdrReader::read_byte_sequence, CdrReader::read_byte_sequence);
        self.read(field, big, little)
    }

    /// `float64[N]`, or a structure of as many.
    pub(crate) fn f64s<const N: usize>(
        &mut self,
        field: &'static str,
    ) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.read(field, CdrReader::read_f64, CdrReader::read_f64)?;
        }
        Ok(values)
    }

    /// `geometry_msgs/Pose` or `Transform`.
    pub(crate) fn pose(&mut self, field: &'static str) -> Result<Pose, ReadError> {
        let [x, y, z, qx, qy, qz, qw] = self.f64s(field)?;
        Ok(Pose {
            translation_m: [x, y, z],
            // ROS writes w last, `Pose` has it first.
            rotation_wxyz: [qw, qx, qy, qz],
        })
    }

    /// `std_msgs/Header`: stamp (nanoseconds) and frame of the message.
    pub(crate) fn header(&mut self) -> Result<(u64, &'a str), ReadError> {
        let field = "header.stamp.sec";
        let sec = self.read(field, CdrReader::read_i32, CdrReader::read_i32)?;
        let nanosec = self.u32("header.stamp.nanosec")?;
        let seconds = u64::try_from(sec).ok().filter(|_| nanosec < 1_000_000_000);
        let problem =
            || format!("header.stamp is {sec} s and {nanosec} ns, not a time from 1970 on");
        let seconds = seconds.ok_or_else(|| ReadError(problem()))?;
        let frame_id = self.str("header.frame_id")?;
        Ok((seconds * 1_000_000_000 + u64::from(nanosec), frame_id))
    }
}
