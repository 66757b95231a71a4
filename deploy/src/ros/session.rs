//! Session on a ROS 2 network: a node, its publishers and its subscriptions.

use std::any::Any;
use std::sync::atomic::{AtomicU32, Ordering};

use bus::BusError;
use ros2::endpoint::{EndpointKind, Node, gid};
use ros2::{Distribution, Qos, RosName, RosTopic, RosType};
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Locality, Sample};
use zenoh::{Session, Wait};
use zenoh_ext::{AdvancedSubscriberBuilderExt, HistoryConfig};

use super::publisher::RosPublisher;

/// Name of the node.
const NODE_NAME: &str = "v2vloc";

/// A node of a ROS 2 network. Its tokens are withdrawn when this is dropped.
pub struct RosSession {
    /// The session.
    pub(super) zenoh: Session,
    /// The node.
    pub(super) node: Node,
    /// Number of the last endpoint.
    endpoints: AtomicU32,
    _token: LivelinessToken,
}

/// A subscription; ends when dropped.
pub(super) struct RosSubscription {
    /// Plain, or one with history.
    _subscriber: Box<dyn Any + Send + Sync>,
    _token: LivelinessToken,
}

impl RosSession {
    /// Declares the node on an open session.
    ///
    /// # Errors
    /// [`BusError::Zenoh`] when the session is closed.
    pub fn declare(
        session: Session,
        domain_id: u32,
        namespace: Option<RosName>,
        distribution: Distribution,
    ) -> Result<Self, BusError> {
        let node = Node {
            domain_id,
            zid: session.zid().to_string(),
            namespace,
            name: NODE_NAME.into(),
            distribution,
        };
        let token = declare_token(&session, &node.token())?;
        Ok(Self {
            zenoh: session,
            node,
            endpoints: AtomicU32::new(0),
            _token: token,
        })
    }

    /// Declares a publisher of `topic`.
    pub(super) fn publisher(&self, topic: &RosTopic) -> Result<RosPublisher, BusError> {
        let name = topic.name(self.node.namespace.as_ref());
        let (ros_type, qos) = (topic.ros_type(), topic.qos());
        let key = self.node.key(&name, ros_type);
        let (id, kind) = (self.next_endpoint(), EndpointKind::Publisher);
        let token = self.node.endpoint_token(id, kind, &name, ros_type, qos);
        let declared = declare_token(&self.zenoh, &token)?;
        RosPublisher::declare(&self.zenoh, &key, qos, (gid(&token), declared))
    }

    /// Calls `receive` for every message of a topic, on zenoh's receive thread: it must not wait.
    pub(super) fn subscribe(
        &self,
        topic: &RosName,
        ros_type: RosType,
        qos: Qos,
        receive: impl Fn(Sample) + Send + Sync + 'static,
    ) -> Result<RosSubscription, BusError> {
        // Publishers of every distribution are heard, whatever hash they write; but not our own.
        let keys = self.node.any_hash(topic, ros_type);
        let builder = self.zenoh.declare_subscriber(&keys);
        let builder = builder.allowed_origin(Locality::Remote).callback(receive);
        let refused = |cause| BusError::zenoh(format!("subscribing to {keys}"), &cause);
        let subscriber: Box<dyn Any + Send + Sync> = if qos.is_latched {
            let history = HistoryConfig::default().detect_late_publishers();
            let builder = builder.history(history).subscriber_detection();
            Box::new(builder.wait().map_err(refused)?)
        } else {
            Box::new(builder.wait().map_err(refused)?)
        };
        // The token shows the subscription to other nodes, so it follows once messages are received.
        let (id, kind) = (self.next_endpoint(), EndpointKind::Subscription);
        let token = self.node.endpoint_token(id, kind, topic, ros_type, qos);
        Ok(RosSubscription {
            _subscriber: subscriber,
            _token: declare_token(&self.zenoh, &token)?,
        })
    }

    fn next_endpoint(&self) -> u32 {
        self.endpoints.fetch_add(1, Ordering::Relaxed) + 1
    }
}

fn declare_token(session: &Session, key: &str) -> Result<LivelinessToken, BusError> {
    let token = session.liveliness().declare_token(key).wait();
    token.map_err(|cause| BusError::zenoh(format!("declaring {key}"), &cause))
}
