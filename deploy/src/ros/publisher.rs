//! Publisher of one topic of a ROS 2 network.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bus::{BusError, unix_nanos};
use ros2::Qos;
use ros2::endpoint::{Attachment, Gid};
use zenoh::liveliness::LivelinessToken;
use zenoh::qos::CongestionControl;
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedPublisher, AdvancedPublisherBuilderExt, CacheConfig, MissDetectionConfig};

/// Period at which the last sequence number of a latched topic is repeated if it has changed, as rmw_zenoh does.
const HEARTBEAT: Duration = Duration::from_millis(500);

/// A publisher; its token is withdrawn when this is dropped.
pub(super) struct RosPublisher {
    kind: QosKind,
    gid: Gid,
    /// Number of messages so far.
    published: i64,
    _token: LivelinessToken,
}

enum QosKind {
    /// Volatile.
    Plain {
        publisher: zenoh::pubsub::Publisher<'static>,
        has_subscribers: Arc<AtomicBool>,
    },
    /// Transient local: with the cache from which late subscribers get the last messages.
    Latched(AdvancedPublisher<'static>),
}

impl RosPublisher {
    /// Declares a publisher on `key`, whose token is declared already.
    pub(super) fn declare(
        session: &Session,
        key: &str,
        qos: Qos,
        (gid, token): (Gid, LivelinessToken),
    ) -> Result<Self, BusError> {
        let refused = |cause| BusError::zenoh(format!("declaring a publisher on {key}"), &cause);
        // As in rmw_zenoh: a slow receiver loses messages, nobody waits for it.
        let builder = session
            .declare_publisher(key.to_owned())
            .congestion_control(CongestionControl::Drop);
        let kind = if qos.is_latched {
            let cache = CacheConfig::default().max_samples(qos.depth as usize);
            let sequence = MissDetectionConfig::default().sporadic_heartbeat(HEARTBEAT);
            let builder = builder.cache(cache).sample_miss_detection(sequence);
            QosKind::Latched(builder.publisher_detection().wait().map_err(refused)?)
        } else {
            let publisher = builder.wait().map_err(refused)?;
            let has_subscribers = bus::has_subscribers(&publisher).map_err(refused)?;
            QosKind::Plain {
                publisher,
                has_subscribers,
            }
        };
        Ok(Self {
            kind,
            gid,
            published: 0,
            _token: token,
        })
    }

    /// True if a message would reach somebody, now or later.
    pub(super) fn is_wanted(&self) -> bool {
        match &self.kind {
            QosKind::Plain {
                has_subscribers, ..
            } => has_subscribers.load(Ordering::Relaxed),
            QosKind::Latched(_) => true,
        }
    }

    /// Publishes a message in CDR.
    pub(super) fn publish(&mut self, cdr: Vec<u8>) -> Result<(), BusError> {
        self.published = self.published.saturating_add(1);
        let source_nanos = i64::try_from(unix_nanos()).unwrap_or(i64::MAX);
        let attachment = Attachment {
            sequence: self.published,
            source_nanos,
            gid: self.gid,
        }
        .to_bytes();
        let put = match &self.kind {
            QosKind::Plain { publisher, .. } => publisher.put(cdr).attachment(attachment).wait(),
            QosKind::Latched(publisher) => publisher.put(cdr).attachment(attachment).wait(),
        };
        put.map_err(|cause| BusError::zenoh("publishing on the ROS 2 network", &cause))
    }
}
