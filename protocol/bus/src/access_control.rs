//! What a router lets through: [`protocol::access`] as rules of zenoh's.
//!
//! Everything is refused that no rule allows, in both directions. A rule holds for a certificate by its common name;
//! which name a peer has is settled by the handshake and not by anything the peer says.

use std::collections::BTreeMap;

use protocol::{KeyExpr, Operation, Permission, Principal, RunScope, access};
use serde_json::{Value, json};

/// The parties that a router lets in, and for which runs.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AccessControl {
    /// Who.
    pub members: Vec<Principal>,
    /// Where.
    pub runs: RunScope,
}

impl AccessControl {
    /// zenoh's `access_control`.
    pub(super) fn rules(&self) -> Value {
        // Publishers ask the router who listens, so as not to send what nobody wants.
        let who_listens = json!({
            "id": LISTENERS,
            "permission": "allow",
            "flows": ["egress"],
            "messages": ["declare_subscriber"],
            "key_exprs": KeyExpr::all_of(&self.runs).each_ref().map(KeyExpr::as_str),
        });
        let mut rules = vec![who_listens];
        let (mut subjects, mut policies) = (Vec::new(), Vec::new());
        for member in &self.members {
            let name = member.to_string();
            let own = rules_of(&name, &member.rights(&self.runs));
            let names: Vec<Value> =
                [json!(LISTENERS)].into_iter().chain(own.iter().map(|rule| rule["id"].clone())).collect();
            rules.extend(own);
            subjects.push(json!({"id": name, "cert_common_names": [name], "link_protocols": ["quic"]}));
            policies.push(json!({"id": name, "rules": names, "subjects": [name]}));
        }
        json!({
            "enabled": true,
            "default_permission": "deny",
            "rules": rules,
            "subjects": subjects,
            "policies": policies,
        })
    }
}

/// zenoh's `low_pass_filter`: what is larger than any message of its key goes no further than the router.
pub(super) fn size_limits() -> Value {
    let limits = access::size_limits().into_iter().enumerate().map(|(index, (keys, bytes))| {
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

const LISTENERS: &str = "who-listens";

/// Two rules for every act: what comes from the party, and what goes to it.
fn rules_of(name: &str, rights: &[Permission]) -> Vec<Value> {
    let mut keys: BTreeMap<Operation, Vec<&str>> = BTreeMap::new();
    for right in rights {
        keys.entry(right.act).or_default().push(right.keys.as_str());
    }
    let rule = |act: Operation, flow: &str, messages: &[&str], keys: &[&str]| {
        json!({
            "id": format!("{name} {act:?} {flow}").to_lowercase(),
            "permission": "allow",
            "flows": [flow],
            "messages": messages,
            "key_exprs": keys,
        })
    };
    let mut rules = Vec::new();
    for (act, keys) in keys {
        let (from, to): (&[&str], &[&str]) = match act {
            Operation::Publish => (&["put"], &[]),
            Operation::Subscribe => (&["declare_subscriber"], &["put"]),
            Operation::DeclareLiveliness => (&["liveliness_token"], &[]),
            Operation::SubscribeLiveliness => {
                (&["declare_liveliness_subscriber", "liveliness_query"], &["liveliness_token"])
            }
            Operation::Query => (&["query"], &[]),
        };
        for (flow, messages) in [("ingress", from), ("egress", to)] {
            if !messages.is_empty() {
                rules.push(rule(act, flow, messages, &keys));
            }
        }
    }
    rules
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nobody_may_answer_questions_or_delete() {
        let members = ["agent-1", "ego-1", "link-1", "replay", "scorer", "recorder", "viewer"];
        let guard = AccessControl { members: members.map(|name| name.parse().unwrap()).into(), runs: RunScope::Any };
        let rules = guard.rules();
        assert_eq!(rules["default_permission"], "deny");
        let rules = rules["rules"].as_array().unwrap();
        for rule in rules {
            assert_eq!(rule["permission"], "allow");
            let messages = rule["messages"].as_array().unwrap();
            let never = ["reply", "declare_queryable", "delete"];
            assert!(messages.iter().all(|message| !never.contains(&message.as_str().unwrap())), "{rule}");
        }
        let ids: std::collections::BTreeSet<&str> = rules.iter().map(|rule| rule["id"].as_str().unwrap()).collect();
        assert_eq!(ids.len(), rules.len(), "zenoh wants every rule to have a name of its own");
    }
}
