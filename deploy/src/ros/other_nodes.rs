//! Other nodes of the ROS 2 network whose topics or frames are those of this node.

use std::collections::BTreeSet;

use bus::BusError;
use ros2::RosTopic;
use ros2::endpoint::NodeName;
use zenoh::Wait;
use zenoh::pubsub::Subscriber;
use zenoh::sample::SampleKind;

use super::node_options::ClockMode;
use super::session::RosSession;

/// Names other nodes of this program in the log, those that are there and those that come. In one namespace every
/// topic and frame has two publishers. Ends when the subscription is dropped.
pub(super) fn watch_namesakes(session: &RosSession) -> Result<Subscriber<()>, BusError> {
    let (own, domain_id) = (session.node.name_in_network(), session.node.domain_id);
    let selector = session.node.namesakes();
    let liveliness = session.zenoh.liveliness();
    let builder = liveliness.declare_subscriber(&selector).history(true);
    let subscriber = builder.callback(move |sample| {
        let token = sample.key_expr().as_str();
        if sample.kind() == SampleKind::Put
            && let Some(other) = NodeName::of_token(token)
            && other.zid != own.zid
        {
            warn(&own, &other, domain_id);
        }
    });
    subscriber
        .wait()
        .map_err(|cause| BusError::zenoh(format!("watching {selector}"), &cause))
}

fn warn(own: &NodeName, other: &NodeName, domain_id: u32) {
    let namespace = &other.namespace;
    if other.namespace == own.namespace {
        tracing::warn!(
            "another v2vloc node is in domain {domain_id} and namespace {namespace}: topics and frames of both collide; \
             give one of them another --namespace"
        );
    } else {
        tracing::info!("another v2vloc node is in domain {domain_id}, namespace {namespace}");
    }
}

/// True if this node publishes `/clock`. Of two clocks in one network each would set the time of all nodes.
pub(super) fn publishes_clock(session: &RosSession, mode: ClockMode) -> Result<bool, BusError> {
    if mode == ClockMode::Off {
        return Ok(false);
    }
    let own = &session.node;
    // Nodes that publish it, without this one.
    let publishers = own.publishers_of(&RosTopic::Clock.name(None));
    let others = bus::tokens(&session.zenoh, &publishers)?
        .filter_map(|token| NodeName::of_token(&token))
        .filter(|node| node.zid != own.zid);
    let others: BTreeSet<String> = others.map(|node| node.to_string()).collect();
    let is_published = others.is_empty() || mode == ClockMode::On;
    if !others.is_empty() {
        let names = Vec::from_iter(others).join(", ");
        if is_published {
            tracing::warn!("/clock is published by {names} too: nodes get the time of two clocks");
        } else {
            tracing::warn!("/clock is published by {names}: it is not by this node");
        }
    }
    Ok(is_published)
}
