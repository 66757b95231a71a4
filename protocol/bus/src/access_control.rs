//! Access control: [`protocol::access`] as access-control rules of zenoh.
//!
//! Everything that no rule allows is denied, in both directions. A rule applies to a certificate by its common name;
//! the handshake authenticates the name.

use std::collections::BTreeMap;

use protocol::{KeyExpr, Operation, Permission, Principal, RunScope, access};
use serde_json::{Value, json};

use super::credentials::ROUTER;

/// Key of the probes of a router's own process, below no run.
pub(super) const PROBE_KEY: &str = "v2v-probe";

/// Principals that a router admits, and their runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessControl {
    /// Principals that may connect.
    pub members: Vec<Principal>,
    /// Runs in which their permissions hold.
    pub runs: RunScope,
}

impl AccessControl {
    /// zenoh's `access_control`.
    pub(super) fn rules(&self) -> Value {
        // Publishers ask the router for subscribers, so that they do not send messages without any.
        let all = KeyExpr::all_of(&self.runs);
        let all = all.each_ref().map(KeyExpr::as_str);
        let subscribers = rule(SUBSCRIBERS_RULE, &["egress"], &["declare_subscriber"], &all);
        let mut rules = vec![subscribers];
        let (mut subjects, mut policies) = (Vec::new(), Vec::new());
        for member in &self.members {
            let name = member.to_string();
            let own = rules_of(&name, &member.rights(&self.runs));
            let mut names = vec![json!(SUBSCRIBERS_RULE)];
            names.extend(own.iter().map(|rule| rule["id"].clone()));
            rules.extend(own);
            subjects.push(subject(&name));
            policies.push(json!({"id": name, "rules": names, "subjects": [name]}));
        }
        // The process of the router receives its own probes over a second session.
        let messages = ["declare_subscriber", "put"];
        let probes = rule(PROBE_KEY, &["ingress", "egress"], &messages, &[PROBE_KEY]);
        rules.push(probes);
        subjects.push(subject(ROUTER));
        policies.push(json!({"id": ROUTER, "rules": [PROBE_KEY], "subjects": [ROUTER]}));
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        })
    }
}

/// zenoh's `low_pass_filter`: the router rejects messages above the size limit of their key.
pub(super) fn size_limits() -> Value {
    let limits = access::size_limits()
        .into_iter()
        .enumerate()
        .map(|(index, (keys, bytes))| {
            json!({
                "id": format!("size-{index}"),
                "flows": ["ingress"],
                "messages": ["put"],
                "key_exprs": keys.iter().map(KeyExpr::as_str).collect::<Vec<_>>(),
                "size_limit": bytes,
            })
        });
    limits.collect()
}

const SUBSCRIBERS_RULE: &str = "subscribers";

/// The process whose certificate has this common name.
fn subject(name: &str) -> Value {
    json!({"id": name, "cert_common_names": [name], "link_protocols": ["quic"]})
}

fn rule(id: &str, flows: &[&str], messages: &[&str], keys: &[&str]) -> Value {
    json!({
        "id": id,
        "permission": "allow",
        "flows": flows,
        "messages": messages,
        "key_exprs": keys,
    })
}

/// Two rules for every operation: messages from the principal, and messages to it.
fn rules_of(name: &str, rights: &[Permission]) -> Vec<Value> {
    let mut keys: BTreeMap<Operation, Vec<&str>> = BTreeMap::new();
    for right in rights {
        keys.entry(right.act).or_default().push(right.keys.as_str());
    }
    let mut rules = Vec::new();
    for (act, keys) in keys {
        let (from, to): (&[&str], &[&str]) = match act {
            Operation::Publish => (&["put"], &[]),
            Operation::Subscribe => (&["declare_subscriber"], &["put"]),
            Operation::DeclareLiveliness => (&["liveliness_token"], &[]),
            Operation::SubscribeLiveliness => (
                &["declare_liveliness_subscriber", "liveliness_query"],
                &["liveliness_token"],
            ),
            Operation::Query => (&["query"], &[]),
        };
        // Seen from the router: ingress comes from the principal, egress goes to it.
        for (flow, messages) in [("ingress", from), ("egress", to)] {
            if !messages.is_empty() {
                let id = format!("{name} {act:?} {flow}").to_lowercase();
                rules.push(rule(&id, &[flow], messages, &keys));
            }
        }
    }
    rules
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_principal_may_answer_queries_or_delete() {
        let members = [
            "agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer", "ros2",
        ];
        let access_control = AccessControl {
            members: members.map(|name| name.parse().unwrap()).into(),
            runs: RunScope::Any,
        };
        let rules = access_control.rules();
        assert_eq!(rules["default_permission"], "deny");
        let rules = rules["rules"].as_array().unwrap();
        for rule in rules {
            assert_eq!(rule["permission"], "allow");
            let messages = rule["messages"].as_array().unwrap();
            let never = ["reply", "declare_queryable", "delete"];
            assert!(
                messages
                    .iter()
                    .all(|message| !never.contains(&message.as_str().unwrap())),
                "{rule}"
            );
        }
        let ids: std::collections::BTreeSet<&str> = rules
            .iter()
            .map(|rule| rule["id"].as_str().unwrap())
            .collect();
        assert_eq!(
            ids.len(),
            rules.len(),
            "zenoh requires a unique id per rule"
        );
    }
}
