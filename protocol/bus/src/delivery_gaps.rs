//! Delivery gaps: messages that the router has taken and not handed on to this process.
//!
//! Every publisher numbers what it hands over, in the source information of zenoh's samples, apart from the sequence
//! numbers of headers: a link relays messages under the headers of their senders. Messages of one publisher arrive in
//! order, so a number that is skipped belongs to a message that the router has dropped for this receiver
//! (`egress`), or that was published while one of the two had lost its connection.

use std::collections::HashMap;

use protocol::Topic;
use zenoh::sample::SourceInfo;
use zenoh::session::EntityGlobalId;

/// Maximum number of topics kept: a hostile sender must not fill the memory.
const TOPICS: usize = 1024;

/// Next message of the publisher of each topic.
#[derive(Debug, Default)]
pub(super) struct DeliveryGaps {
    next: HashMap<Topic, (EntityGlobalId, u32)>,
}

impl DeliveryGaps {
    /// Adds a message, or with `is_notice` a notification, which has the number of the message after it. Returns the
    /// number of messages skipped before it; 0 for the first of a publisher.
    pub(super) fn note(
        &mut self,
        topic: &Topic,
        source: Option<&SourceInfo>,
        is_notice: bool,
    ) -> u32 {
        let Some(source) = source else { return 0 };
        let (publisher, number) = (*source.source_id(), source.source_sn());
        let after = number.wrapping_add(u32::from(!is_notice));
        if let Some((known, next)) = self.next.get_mut(topic) {
            // A restarted publisher begins anew.
            if *known != publisher {
                (*known, *next) = (publisher, after);
                return 0;
            }
            let skipped = number.wrapping_sub(*next);
            // Numbers wrap around: more than half the range ahead is behind, as of a repeated message.
            if skipped > u32::MAX / 2 {
                return 0;
            }
            *next = after;
            return skipped;
        }
        if self.next.len() < TOPICS {
            self.next.insert(topic.clone(), (publisher, after));
        }
        0
    }
}

#[cfg(test)]
mod tests {
    use zenoh::Wait;

    use super::*;
    use crate::{BusOptions, Endpoint, open};

    #[test]
    fn skipped_numbers_are_counted_once() {
        let session = open(&BusOptions::router(Endpoint::loopback(0))).unwrap();
        let publishers = [(); 2].map(|()| {
            session
                .declare_publisher("v2v/test/7/bev")
                .wait()
                .unwrap()
                .id()
        });
        let (topic, mut gaps) = ("7/bev".parse::<Topic>().unwrap(), DeliveryGaps::default());
        let mut note = |publisher: usize, number, is_notice| {
            gaps.note(
                &topic,
                Some(&SourceInfo::new(publishers[publisher], number)),
                is_notice,
            )
        };
        assert_eq!(note(0, 3, false), 0, "subscribed late");
        assert_eq!(note(0, 4, true), 0, "a notification is no message");
        assert_eq!(note(0, 4, false), 0);
        assert_eq!(note(0, 7, false), 2);
        assert_eq!(note(0, 6, false), 0, "never counted twice");
        assert_eq!(note(0, 9, true), 1, "the last message was dropped");
        assert_eq!(note(1, 5, false), 0, "a restarted publisher");
        assert_eq!(note(1, 6, false), 0);
        assert_eq!(gaps.note(&topic, None, false), 0, "not one of ours");
    }
}
