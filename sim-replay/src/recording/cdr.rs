//! Classic CDR, little-endian, as ROS 2 writes its messages.
//!
//! Four bytes of header, then the fields in order, each aligned to its own size, counted from the byte behind the header
//! (OMG, "Common Object Request Broker Architecture", 15.3; DDS-XTYPES calls it XCDR1). A string is its length with the
//! final NUL, the bytes and the NUL; a sequence its length and its elements.

/// Header: plain CDR, little-endian, no options.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// A message in the making.
#[derive(Debug, Clone)]
pub struct CdrWriter {
    bytes: Vec<u8>,
}

impl Default for CdrWriter {
    fn default() -> Self {
        Self::with_capacity(0)
    }
}

impl CdrWriter {
    /// An empty message with room for `capacity` bytes.
    #[must_use]
    pub fn with_capacity(capacity: usize) -> Self {
        let mut bytes = Vec::with_capacity(HEADER.len() + capacity);
        bytes.extend(HEADER);
        Self { bytes }
    }

    /// The message.
    #[must_use]
    pub fn finish(self) -> Vec<u8> {
        self.bytes
    }

    /// Appends a byte.
    pub fn u8(&mut self, value: u8) {
        self.bytes.push(value);
    }

    /// Appends a truth value.
    pub fn bool(&mut self, value: bool) {
        self.u8(value.into());
    }

    /// Appends 32 bits without sign.
    pub fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    /// Appends 32 bits with sign.
    pub fn i32(&mut self, value: i32) {
        self.put(value.to_le_bytes());
    }

    /// Appends a single-precision number.
    pub fn f32(&mut self, value: f32) {
        self.put(value.to_le_bytes());
    }

    /// Appends a double-precision number.
    pub fn f64(&mut self, value: f64) {
        self.put(value.to_le_bytes());
    }

    /// Appends a text.
    pub fn string(&mut self, text: &str) {
        self.len(text.len() + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
    }

    /// Appends a sequence of bytes.
    pub fn bytes(&mut self, bytes: &[u8]) {
        self.len(bytes.len());
        self.bytes.extend(bytes);
    }

    /// Begins a sequence of `count` elements, which the caller appends.
    ///
    /// # Panics
    /// When there are 2^32 or more of them: no message of ours holds as many.
    pub fn len(&mut self, count: usize) {
        self.u32(u32::try_from(count).expect("messages are bounded far below this"));
    }

    fn put<const N: usize>(&mut self, bytes: [u8; N]) {
        let behind_header = self.bytes.len() - HEADER.len();
        let padding = behind_header.next_multiple_of(N) - behind_header;
        self.bytes.resize(self.bytes.len() + padding, 0);
        self.bytes.extend(bytes);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_stands_on_a_multiple_of_its_size() {
        let mut cdr = CdrWriter::default();
        cdr.u8(7);
        cdr.f64(1.0);
        cdr.bool(true);
        cdr.u32(0x0403_0201);
        cdr.u8(9);
        cdr.i32(-1);
        let mut expected = vec![0, 1, 0, 0, 7, 0, 0, 0, 0, 0, 0, 0];
        expected.extend(1.0_f64.to_le_bytes());
        expected.extend([1, 0, 0, 0, 1, 2, 3, 4, 9, 0, 0, 0, 255, 255, 255, 255]);
        assert_eq!(cdr.finish(), expected);
    }

    /// The payload of `std_msgs/Header{stamp: {sec: 1, nanosec: 2}, frame_id: "map"}` as ROS 2 writes it.
    #[test]
    fn texts_end_with_a_nul_that_counts() {
        let mut cdr = CdrWriter::default();
        cdr.i32(1);
        cdr.u32(2);
        cdr.string("map");
        assert_eq!(cdr.finish(), [0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 4, 0, 0, 0, b'm', b'a', b'p', 0]);
    }

    #[test]
    fn an_empty_sequence_is_its_length_alone() {
        let mut cdr = CdrWriter::default();
        cdr.bytes(&[]);
        cdr.string("");
        assert_eq!(cdr.finish(), [0, 1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0]);
    }
}
