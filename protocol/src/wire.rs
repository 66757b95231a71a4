//! Encoding and decoding of messages.
//!
//! Encoding returns head and body separately: append the body to a network payload as it is, for example through
//! `bytes::Bytes::from_owner(encoded.body)`, and nothing large is copied. Decoding reads from as many pieces as the
//! network delivers and copies a tensor once, into aligned memory, checking checksum and values on the way.

use crc32fast::Hasher;

use crate::body::{PayloadReader, check_body};
use crate::checks::check_limit;
use crate::header::{HEADER_LEN, Header, Stamp};
use crate::message::{Message, MessageSource, MessageVisitor, Payload};
use crate::{Body, Limits, WireError, metadata};

/// A message as it is transmitted: `head`, then `body`, nothing between or after.
#[derive(Debug, Clone, PartialEq)]
pub struct Encoded {
    /// Header and metadata.
    pub head: Vec<u8>,
    /// The body, in its original memory.
    pub body: Body,
}

impl Encoded {
    /// Bytes on the wire, without the overhead of the transport.
    pub fn wire_bytes(&self) -> usize {
        self.head.len() + self.body.len()
    }

    /// The two pieces, in order.
    pub fn pieces(&self) -> [&[u8]; 2] {
        [&self.head, self.body.as_bytes()]
    }

    /// All in one piece; copies the body.
    pub fn to_vec(&self) -> Vec<u8> {
        self.pieces().concat()
    }
}

/// Encodes a message, moving its tensor without a copy.
///
/// The numbers of a body are not checked: every receiver checks them, and a pass over a feature map costs as much again
/// as its checksum. A NaN sent by an agent appears in the ledger as `not_finite`.
///
/// # Errors
/// [`WireError`] when the metadata exceed the limits of every receiver: a value out of bounds, an invalid pose, more
/// than `Limits::HARD_METADATA_BYTES`.
pub fn encode<M: Payload>(stamp: &Stamp, message: M) -> Result<Encoded, WireError> {
    let (metadata, body) = message.into_parts();
    let shape = M::check(&metadata, &Limits::SENDER)?;
    shape.check(body.len() as u64)?;
    // Room for the header, which is written last: it states lengths and checksum of the rest.
    let mut head = vec![0; HEADER_LEN];
    let metadata_len = metadata::append(M::KIND, &metadata, &mut head)?;
    let mut crc = Hasher::new();
    crc.update(head.get(HEADER_LEN..).unwrap_or_default());
    crc.update(body.as_bytes());
    let header = Header {
        kind: M::KIND,
        stamp: stamp.clone(),
        metadata_len,
        body_len: body.len() as u64,
        payload_crc: crc.finalize(),
    };
    if let Some(begin) = head.first_chunk_mut() {
        *begin = header.to_bytes();
    }
    Ok(Encoded { head, body })
}

/// [`encode`] for a message of any kind.
///
/// # Errors
/// As [`encode`].
pub fn encode_any(stamp: &Stamp, message: Message) -> Result<Encoded, WireError> {
    message.visit(StampEncoder(stamp))
}

/// Encoding of a message of any kind.
struct StampEncoder<'a>(&'a Stamp);

impl MessageVisitor for StampEncoder<'_> {
    type Output = Result<Encoded, WireError>;

    fn visit<M: Payload>(self, message: M) -> Self::Output {
        encode(self.0, message)
    }
}

/// Reads the header only: sender, kind, times, sizes. Touches the first 92 bytes only, so that it may be called where
/// the network must not wait; the payload is checked by [`decode`] only.
///
/// # Errors
/// [`WireError`] when there is no header of this version.
pub fn decode_header<'a>(pieces: impl IntoIterator<Item = &'a [u8]>) -> Result<Header, WireError> {
    let (mut bytes, mut found) = ([0; HEADER_LEN], 0);
    for (byte, from) in bytes.iter_mut().zip(pieces.into_iter().flatten()) {
        *byte = *from;
        found += 1;
    }
    let expected = HEADER_LEN as u64;
    if found < expected {
        return Err(WireError::Truncated { expected, found });
    }
    Header::from_bytes(&bytes)
}

/// Decodes a message of a known kind from its pieces.
///
/// # Errors
/// [`WireError`] for anything but a valid message of that kind within `limits`; [`WireError::drop_reason`] gives the
/// reason under which it is counted. No memory is allocated for sizes that are only claimed.
pub fn decode<'a, M: Payload>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &Limits,
) -> Result<(Header, M), WireError> {
    let mut opened = open(pieces, limits)?;
    opened.header.check_kind(M::KIND)?;
    let message = opened.read()?;
    Ok((opened.header, message))
}

/// Decodes a message of any kind.
///
/// # Errors
/// As [`decode`].
pub fn decode_any<'a>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &Limits,
) -> Result<(Header, Message), WireError> {
    let mut opened = open(pieces, limits)?;
    let message = Message::read(opened.header.kind, &mut opened)?;
    Ok((opened.header, message))
}

/// A message whose header and lengths have been checked.
struct Opened<'a, 'b> {
    header: Header,
    /// Holds exactly as many bytes as the header announces.
    reader: PayloadReader<'a>,
    limits: &'b Limits,
}

impl MessageSource for &mut Opened<'_, '_> {
    /// Reads the payload. The checksum is reported first: all other errors of a corrupted message are consequences.
    fn read<M: Payload>(self) -> Result<M, WireError> {
        let parts = self.read_parts::<M>();
        let (expected, found) = (self.reader.finish(), self.header.payload_crc);
        if expected != found {
            return Err(WireError::Checksum { expected, found });
        }
        let (metadata, body, valid) = parts?;
        // A second pass over the body, to name the first bad value: only for messages that are refused.
        if !valid {
            check_body(&body, self.limits.max_abs_value)?;
        }
        M::from_parts(metadata, body)
    }
}

impl Opened<'_, '_> {
    fn read_parts<M: Payload>(&mut self) -> Result<(M::Metadata, Body, bool), WireError> {
        let len = self.header.metadata_len as usize;
        let metadata: M::Metadata = metadata::decode(M::KIND, &self.reader.read_bytes(len))?;
        let shape = M::check(&metadata, self.limits)?;
        let most = self.limits.max_abs_value;
        let (body, valid) = self.reader.read_body(self.header.body_len, shape, most)?;
        Ok((metadata, body, valid))
    }
}

/// Reads the header and compares all lengths with each other and with the limits.
fn open<'a, 'b>(
    pieces: impl IntoIterator<Item = &'a [u8]>,
    limits: &'b Limits,
) -> Result<Opened<'a, 'b>, WireError> {
    let pieces: Vec<&[u8]> = pieces.into_iter().collect();
    let found: u64 = pieces.iter().map(|piece| piece.len() as u64).sum();
    let header = decode_header(pieces.iter().copied())?;
    let max = limits.max_metadata_bytes.min(Limits::HARD_METADATA_BYTES);
    check_limit("metadata bytes", header.metadata_len.into(), max.into())?;
    check_limit("body bytes", header.body_len, limits.max_body_bytes)?;
    let before_body = HEADER_LEN as u64 + u64::from(header.metadata_len);
    let expected = header.body_len.saturating_add(before_body);
    match found {
        _ if found < expected => Err(WireError::Truncated { expected, found }),
        _ if found > expected => Err(WireError::TrailingBytes { expected, found }),
        _ => Ok(Opened {
            header,
            reader: PayloadReader::new(pieces, HEADER_LEN),
            limits,
        }),
    }
}
