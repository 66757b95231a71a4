//! The two doors between messages and bytes.
//!
//! Encoding gives head and body apart: append the body to a network payload as it is, for example through
//! `bytes::Bytes::from_owner(encoded.body)`, and nothing large is ever copied. Decoding reads from as many pieces as the
//! network delivers and copies a tensor once, into aligned memory, checking checksum and values on the way.

use crc32fast::Hasher;

use crate::Body;
use crate::Limits;
use crate::WireError;
use crate::body::{PayloadReader, check_body};
use crate::header::{HEADER_LEN, Header, Kind, Stamp};
use crate::message::{
    Bev, Boxes, Control, Descriptor, Detections, Gnss, Lidar, Message, Payload, Points, PoseEstimate, Radar, Stats,
    Truth, for_message,
};
use crate::metadata;

/// A message as it goes on the wire: `head`, then `body`, nothing between or after.
#[derive(Debug, Clone, PartialEq)]
pub struct Encoded {
    /// Header and metadata.
    pub head: Vec<u8>,
    /// The body, in the memory the message had it in.
    pub body: Body,
}

impl Encoded {
    /// Bytes on the wire, without what the transport adds.
    #[must_use]
    pub fn wire_bytes(&self) -> usize {
        self.head.len() + self.body.len()
    }

    /// The two pieces, in order.
    #[must_use]
    pub fn pieces(&self) -> [&[u8]; 2] {
        [&self.head, self.body.as_bytes()]
    }

    /// All in one piece; copies the body.
    #[must_use]
    pub fn to_vec(&self) -> Vec<u8> {
        self.pieces().concat()
    }
}

/// Encodes a message, taking its tensor along without a copy.
///
/// The numbers of a body are not looked at: every receiver does so anyway, and a pass over a map costs as much again as
/// its checksum. An agent that sends a NaN finds it in the ledger as `not_finite`.
///
/// # Errors
/// [`WireError`] when the metadata hold what no receiver takes: a value out of bounds, a pose that is none, more than
/// [`Limits::HARD_METADATA_BYTES`].
pub fn encode<M: Payload>(stamp: &Stamp, message: M) -> Result<Encoded, WireError> {
    let (metadata, body) = message.into_parts();
    let shape = M::check(&metadata, &Limits::SENDER)?;
    shape.check(body.len() as u64)?;
    let mut head = vec![0; HEADER_LEN];
    let metadata_len = metadata::append(M::KIND, &metadata, &mut head)?;
    let mut crc = Hasher::new();
    crc.update(&head[HEADER_LEN..]);
    crc.update(body.as_bytes());
    let header = Header {
        kind: M::KIND,
        stamp: stamp.clone(),
        metadata_len,
        body_len: body.len() as u64,
        payload_crc: crc.finalize(),
    };
    head[..HEADER_LEN].copy_from_slice(&header.to_bytes());
    Ok(Encoded { head, body })
}

/// [`encode`] for a message of whatever kind.
///
/// # Errors
/// As [`encode`].
pub fn encode_any(stamp: &Stamp, message: Message) -> Result<Encoded, WireError> {
    for_message!(message, message => encode(stamp, message))
}

/// Reads the header alone: who, what, when, how large. Touches the first 92 bytes only, so that it may be called where
/// the network must not wait; whether the payload is sound, only [`decode`] tells.
///
/// # Errors
/// [`WireError`] when there is no header of this version.
pub fn decode_header<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> Result<Header, WireError> {
    let mut bytes = [0; HEADER_LEN];
    let mut filled = 0;
    for piece in pieces {
        let take = piece.len().min(HEADER_LEN - filled);
        bytes[filled..filled + take].copy_from_slice(&piece[..take]);
        filled += take;
        if filled == HEADER_LEN {
            return Header::from_bytes(&bytes);
        }
    }
    Err(WireError::Truncated { expected: HEADER_LEN as u64, found: filled as u64 })
}

/// Decodes a message of a known kind from the pieces it lies in.
///
/// # Errors
/// [`WireError`] for anything but a sound message of that kind within `limits`; [`WireError::drop_reason`] says how to
/// count it. No memory is taken for sizes that are only claimed.
pub fn decode<'a, M: Payload>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &Limits,
) -> Result<(Header, M), WireError> {
    let (header, reader) = open(pieces, limits)?;
    if header.kind != M::KIND {
        return Err(WireError::Kind { expected: M::KIND, found: header.kind });
    }
    let message = decode_payload(&header, reader, limits)?;
    Ok((header, message))
}

/// Decodes a message of whatever kind.
///
/// # Errors
/// As [`decode`].
pub fn decode_any<'a>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &Limits,
) -> Result<(Header, Message), WireError> {
    fn read<M: Payload>(header: &Header, reader: PayloadReader<'_>, limits: &Limits) -> Result<M, WireError> {
        decode_payload(header, reader, limits)
    }
    let (header, reader) = open(pieces, limits)?;
    let message = match header.kind {
        Kind::Lidar => Message::Lidar(read::<Lidar>(&header, reader, limits)?),
        Kind::Radar => Message::Radar(read::<Radar>(&header, reader, limits)?),
        Kind::Gnss => Message::Gnss(read::<Gnss>(&header, reader, limits)?),
        Kind::Pose => Message::Pose(read::<PoseEstimate>(&header, reader, limits)?),
        Kind::Bev => Message::Bev(read::<Bev>(&header, reader, limits)?),
        Kind::Boxes => Message::Boxes(read::<Boxes>(&header, reader, limits)?),
        Kind::Points => Message::Points(read::<Points>(&header, reader, limits)?),
        Kind::Descriptor => Message::Descriptor(read::<Descriptor>(&header, reader, limits)?),
        Kind::Detections => Message::Detections(read::<Detections>(&header, reader, limits)?),
        Kind::Truth => Message::Truth(read::<Truth>(&header, reader, limits)?),
        Kind::Control => Message::Control(read::<Control>(&header, reader, limits)?),
        Kind::Stats => Message::Stats(read::<Stats>(&header, reader, limits)?),
    };
    Ok((header, message))
}

/// Reads the header and compares all lengths with each other and with the limits.
fn open<'a>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &Limits,
) -> Result<(Header, PayloadReader<'a>), WireError> {
    let pieces: Vec<&[u8]> = pieces.into_iter().collect();
    let found = pieces.iter().fold(0u64, |sum, piece| sum + piece.len() as u64);
    let header = decode_header(pieces.iter().copied())?;
    let Header { metadata_len, body_len, .. } = header;
    let max = limits.max_metadata_bytes.min(Limits::HARD_METADATA_BYTES);
    if metadata_len > max {
        return Err(WireError::Limit { what: "metadata bytes", max: max.into(), found: metadata_len.into() });
    }
    if body_len > limits.max_body_bytes {
        return Err(WireError::Limit { what: "body bytes", max: limits.max_body_bytes, found: body_len });
    }
    let expected = body_len.saturating_add(HEADER_LEN as u64 + u64::from(metadata_len));
    match found {
        _ if found < expected => Err(WireError::Truncated { expected, found }),
        _ if found > expected => Err(WireError::TrailingBytes { expected, found }),
        _ => Ok((header, PayloadReader::new(pieces, HEADER_LEN))),
    }
}

/// Reads the payload; `reader` holds exactly as many bytes as the header announces.
///
/// The checksum speaks first: whatever else is wrong with a message that was changed on the way is no news.
fn decode_payload<M: Payload>(header: &Header, mut reader: PayloadReader<'_>, limits: &Limits) -> Result<M, WireError> {
    let parts = read_parts::<M>(header, &mut reader, limits);
    let expected = reader.finish();
    if expected != header.payload_crc {
        return Err(WireError::Checksum { expected, found: header.payload_crc });
    }
    let (metadata, body, sound) = parts?;
    if !sound {
        check_body(&body, limits.max_abs_value)?;
    }
    M::from_parts(metadata, body)
}

fn read_parts<M: Payload>(
    header: &Header,
    reader: &mut PayloadReader<'_>,
    limits: &Limits,
) -> Result<(M::Metadata, Body, bool), WireError> {
    let metadata: M::Metadata = metadata::decode(M::KIND, &reader.read_bytes(header.metadata_len as usize))?;
    let shape = M::check(&metadata, limits)?;
    let (body, sound) = reader.read_body(header.body_len, shape, limits.max_abs_value)?;
    Ok((metadata, body, sound))
}
