//! Reading of ROS 2 messages in CDR: encapsulation header, byte order, header of the message, errors by field.

use protocol::Pose;
use re_cdr::{BigEndian, ByteOrder, CdrReader, LittleEndian};

/// Error of a message that cannot be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum ReadError {
    /// The encapsulation header names another encoding.
    #[error("encoding {found:?}, not 00 00 or 00 01 (CDR)")]
    Encoding {
        /// First bytes of the message.
        found: Vec<u8>,
    },
    /// The message ends early, or a text or flag in it is malformed.
    #[error("{field} at byte {at} of {len}: {cause}")]
    Cdr {
        /// Field that is read.
        field: &'static str,
        /// Position, bytes after the encapsulation header.
        at: usize,
        /// Length of the message.
        len: usize,
        /// Error of the decoder.
        cause: String,
    },
    /// The capture time is before 1970 or has more than 10^9 nanoseconds.
    #[error("header.stamp is {sec} s and {nanosec} ns, not a time from 1970 on")]
    Stamp {
        /// Seconds.
        sec: i32,
        /// Nanoseconds.
        nanosec: u32,
    },
}

/// A message after its encapsulation header, in either byte order.
pub(crate) enum Body<'a> {
    BigEndian(Reader<'a, BigEndian>),
    LittleEndian(Reader<'a, LittleEndian>),
}

impl<'a> Body<'a> {
    /// The body of a message with its encapsulation header.
    pub(crate) fn of(bytes: &'a [u8]) -> Result<Self, ReadError> {
        // Values are aligned from the end of this header on, so the reader begins there.
        match bytes.split_first_chunk() {
            Some(([0, 0, _, _], body)) => Ok(Self::BigEndian(Reader::new(body))),
            Some(([0, 1, _, _], body)) => Ok(Self::LittleEndian(Reader::new(body))),
            _ => Err(ReadError::Encoding {
                found: bytes.iter().take(4).copied().collect(),
            }),
        }
    }
}

/// `std_msgs/Header`.
pub(crate) struct Header<'a> {
    /// Stamp, nanoseconds.
    pub(crate) nanos: u64,
    /// Frame of the message.
    pub(crate) frame_id: &'a str,
}

/// Reader of one message in byte order `BO`.
pub(crate) struct Reader<'a, BO> {
    cdr: CdrReader<'a, BO>,
    len: usize,
}

impl<'a, BO: ByteOrder> Reader<'a, BO> {
    fn new(body: &'a [u8]) -> Self {
        Self {
            cdr: CdrReader::new(body),
            len: body.len(),
        }
    }

    /// Reads a value; an error names `field`.
    pub(crate) fn read<T>(
        &mut self,
        field: &'static str,
        read: impl FnOnce(&mut CdrReader<'a, BO>) -> re_cdr::Result<T>,
    ) -> Result<T, ReadError> {
        let at = self.cdr.position();
        let len = self.len;
        read(&mut self.cdr).map_err(|cause| ReadError::Cdr {
            field,
            at,
            len,
            cause: cause.to_string(),
        })
    }

    pub(crate) fn u32(&mut self, field: &'static str) -> Result<u32, ReadError> {
        self.read(field, CdrReader::read_u32)
    }

    /// `float64[N]`, or a structure of as many.
    pub(crate) fn f64s<const N: usize>(
        &mut self,
        field: &'static str,
    ) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.read(field, CdrReader::read_f64)?;
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

    /// `std_msgs/Header`.
    pub(crate) fn header(&mut self) -> Result<Header<'a>, ReadError> {
        let sec = self.read("header.stamp.sec", CdrReader::read_i32)?;
        let nanosec = self.u32("header.stamp.nanosec")?;
        let seconds = u64::try_from(sec).ok().filter(|_| nanosec < 1_000_000_000);
        let seconds = seconds.ok_or(ReadError::Stamp { sec, nanosec })?;
        let frame_id = self.read("header.frame_id", CdrReader::read_str)?;
        let nanos = seconds * 1_000_000_000 + u64::from(nanosec);
        Ok(Header { nanos, frame_id })
    }
}
