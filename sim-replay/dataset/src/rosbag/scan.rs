//! Scan of a bag: topics, and messages with their positions.

use std::borrow::Cow;

/// Encoding of the messages of ROS 2.
const CDR: &str = "cdr";

/// A topic of a bag.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct BagTopic {
    pub(super) name: String,
    /// `sensor_msgs/msg/PointCloud2` for example.
    pub(super) type_name: String,
    /// `cdr`, if it is one of ROS 2.
    pub(super) encoding: String,
}

impl BagTopic {
    /// True if its messages are in the encoding of ROS 2.
    pub(super) fn is_cdr(&self) -> bool {
        self.encoding == CDR
    }
}

/// A message while a bag is scanned.
pub(super) struct BagMessage<'a> {
    pub(super) topic: &'a BagTopic,
    /// Time at which it was recorded, nanoseconds.
    pub(super) recorded_nanos: u64,
    /// Its bytes in CDR, or the reason why it cannot be unpacked.
    pub(super) data: Result<Cow<'a, [u8]>, String>,
    pub(super) place: MessagePlace,
}

/// Position of a message in a bag.
#[derive(Debug, Clone, Copy)]
pub(super) struct MessagePlace {
    /// Index of the file.
    pub(super) file: usize,
    pub(super) at: At,
}

/// Position of a message in its file.
#[derive(Debug, Clone, Copy)]
pub(super) enum At {
    Mcap(recording::McapPlace),
    /// Number of the row in the table of messages.
    Row(i64),
}

/// Receives what a scan finds.
pub(super) trait Scan {
    /// Takes note of a topic; true if its messages are wanted.
    fn declare(&mut self, topic: &BagTopic) -> bool;
    /// Takes a message of a wanted topic.
    fn take(&mut self, message: BagMessage<'_>);
    /// Drops the positions in a file that could not be read to its end: the next file gets its index.
    fn forget(&mut self, file: usize);
}
