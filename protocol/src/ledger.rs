//! Message accounting: every published message is delivered or counted under a [`DropReason`].
//!
//! A ledger holds the message counters of a process: sent, received, in flight, dropped. Summed over a run, for each
//! topic and each receiving process,
//!
//! `sent = received + dropped(reason) + in flight`.
//!
//! - A sender counts the messages that it publishes, and those that it drops before publishing (replaced by a newer
//!   frame), without naming a receiver: such lines hold for every receiver of the topic.
//! - A receiver opens an account when it subscribes ([`Ledger::open`]), so that it is known even if nothing ever
//!   arrives; it counts accepted and used messages as received, and all others as dropped.
//! - In simulation time the link counts, under the *sender's* topic, the messages that it drops on the way to one
//!   receiver, those in flight, and a duplicate that it makes as sent once more. It is no receiver itself.
//! - A live link is a process between two topics. It receives the messages of agents: messages that it forwards are
//!   received, those lost on the emulated link are dropped, those it still holds are in flight. It publishes under
//!   `rx/...` the messages that it forwards, a duplicate once more.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::reconciliation::Discrepancy;
use crate::{DropReason, Principal, ProcessId, RateReason, Reconciliation, Topic};

/// Key of a set of counters: a topic and its receiver (`None`: any receiver).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Account {
    /// The topic on which the message was first published.
    pub topic: Topic,
    /// The receiving process.
    pub to: Option<ProcessId>,
}

impl Account {
    /// Account of a sender.
    pub fn published(topic: Topic) -> Self {
        Self { topic, to: None }
    }

    /// Account of a receiver, or of the link on the way to it.
    pub fn towards(topic: Topic, to: &ProcessId) -> Self {
        let to = Some(to.clone());
        Self { topic, to }
    }
}

impl fmt::Display for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.to {
            Some(to) => write!(f, "{} to {to}", self.topic),
            None => write!(f, "{}", self.topic),
        }
    }
}

/// Counters of one account.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Messages published.
    pub sent: u64,
    /// Messages accepted and used.
    pub received: u64,
    /// Messages in flight.
    pub in_flight: u64,
    /// Messages lost, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
    /// Feature maps that had to keep within a limit, by the reason for their format. They are among those sent.
    pub adapted: BTreeMap<RateReason, u64>,
}

impl Counts {
    /// Messages lost for any reason.
    pub fn dropped_total(&self) -> u64 {
        self.dropped.values().copied().fold(0, u64::saturating_add)
    }

    /// Adds another's counters. Numbers from a hostile peer saturate.
    pub fn add(&mut self, other: &Self) {
        let Self {
            sent,
            received,
            in_flight,
            dropped,
            adapted,
        } = other;
        self.sent = self.sent.saturating_add(*sent);
        self.received = self.received.saturating_add(*received);
        self.in_flight = self.in_flight.saturating_add(*in_flight);
        add_each(&mut self.dropped, dropped);
        add_each(&mut self.adapted, adapted);
    }

    /// Sent minus all messages that are accounted for; 0 if the account is balanced.
    pub(crate) fn missing(&self) -> i128 {
        // In 128 bits: sums of hostile counters cannot overflow.
        let accounted = [self.received, self.in_flight]
            .into_iter()
            .chain(self.dropped.values().copied());
        i128::from(self.sent) - accounted.map(i128::from).sum::<i128>()
    }
}

fn add_each<K: Ord + Copy>(sums: &mut BTreeMap<K, u64>, counts: &BTreeMap<K, u64>) {
    for (key, count) in counts {
        let sum = sums.entry(*key).or_default();
        *sum = sum.saturating_add(*count);
    }
}

/// The message counters of one process, or the sum over many.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Line>", into = "Vec<Line>")]
pub struct Ledger {
    accounts: BTreeMap<Account, Counts>,
}

/// One account as serialised: in JSON `{"topic": "4279/bev", "to": "ego-4279", "sent": 0, ..., "dropped": {"stale":
/// 1}}`.
#[derive(Clone, Serialize, Deserialize)]
struct Line {
    topic: Topic,
    to: Option<ProcessId>,
    sent: u64,
    received: u64,
    in_flight: u64,
    dropped: BTreeMap<DropReason, u64>,
    #[serde(default)]
    adapted: BTreeMap<RateReason, u64>,
}

impl From<Vec<Line>> for Ledger {
    fn from(lines: Vec<Line>) -> Self {
        let mut ledger = Self::default();
        for line in lines {
            let (topic, to) = (line.topic, line.to);
            ledger.counts(&Account { topic, to }).add(&Counts {
                sent: line.sent,
                received: line.received,
                in_flight: line.in_flight,
                dropped: line.dropped,
                adapted: line.adapted,
            });
        }
        ledger
    }
}

impl From<Ledger> for Vec<Line> {
    fn from(ledger: Ledger) -> Self {
        let accounts = ledger.accounts.into_iter();
        let lines = accounts.map(|(Account { topic, to }, counts)| Line {
            topic,
            to,
            sent: counts.sent,
            received: counts.received,
            in_flight: counts.in_flight,
            dropped: counts.dropped,
            adapted: counts.adapted,
        });
        lines.collect()
    }
}

impl Ledger {
    /// Opens an account with all counters at zero.
    pub fn open(&mut self, account: &Account) {
        self.counts(account);
    }

    /// Counts one message published.
    pub fn sent(&mut self, account: &Account) {
        let counts = self.counts(account);
        counts.sent = counts.sent.saturating_add(1);
    }

    /// Counts one message used.
    pub fn received(&mut self, account: &Account) {
        let counts = self.counts(account);
        counts.received = counts.received.saturating_add(1);
    }

    /// Counts one message dropped.
    pub fn dropped(&mut self, account: &Account, reason: DropReason) {
        self.dropped_many(account, reason, 1);
    }

    /// Counts messages dropped for one reason.
    pub fn dropped_many(&mut self, account: &Account, reason: DropReason, messages: u64) {
        let count = self.counts(account).dropped.entry(reason).or_default();
        *count = count.saturating_add(messages);
    }

    /// Counts one feature map that was written to keep within a limit.
    pub fn adapted(&mut self, account: &Account, reason: RateReason) {
        let count = self.counts(account).adapted.entry(reason).or_default();
        *count = count.saturating_add(1);
    }

    /// Sets the number of messages in flight.
    pub fn set_in_flight(&mut self, account: &Account, messages: u64) {
        self.counts(account).in_flight = messages;
    }

    /// Adds the counters of another process.
    pub fn merge(&mut self, other: &Self) {
        for (account, counts) in &other.accounts {
            self.counts(account).add(counts);
        }
    }

    /// The counters of an account; `None` if nothing was ever counted.
    pub fn get(&self, account: &Account) -> Option<&Counts> {
        self.accounts.get(account)
    }

    /// Every account, in the order of topics, then receivers.
    pub fn iter(&self) -> impl Iterator<Item = (&Account, &Counts)> {
        self.accounts.iter()
    }

    /// Number of accounts.
    pub fn len(&self) -> usize {
        self.accounts.len()
    }

    /// True if nothing was ever counted.
    pub fn is_empty(&self) -> bool {
        self.accounts.is_empty()
    }

    /// The account of every receiver, with the counts of its topic's senders, which hold for each receiver.
    pub(crate) fn deliveries(&self) -> impl Iterator<Item = (&Account, Counts)> {
        let receivers = self.iter().filter(|(account, _)| account.to.is_some());
        receivers.map(|(account, counts)| {
            let mut counts = counts.clone();
            if let Some(published) = self.get(&Account::published(account.topic.clone())) {
                counts.add(published);
            }
            (account, counts)
        })
    }

    /// Sum over all receivers: a message to two of them counts as sent twice, one to none does not count.
    pub fn delivered(&self) -> Counts {
        let mut total = Counts::default();
        self.deliveries().for_each(|(_, counts)| total.add(&counts));
        total
    }

    /// Sum of all accounts. A topic with two receivers counts as sent once and received twice.
    pub fn total(&self) -> Counts {
        let mut total = Counts::default();
        self.accounts.values().for_each(|counts| total.add(counts));
        total
    }

    /// Compares sent messages with those accounted for, for each topic and receiver. To be called on the sum of the
    /// ledgers of all processes.
    pub fn balance(&self) -> Reconciliation {
        Reconciliation::of(self)
    }

    /// Exempts the accounts that `is_exempt` selects, because a process concerned was offline: missing messages are
    /// counted as dropped for that reason, surplus messages as sent. Returns the number of messages exempted. All other
    /// accounts have to balance by themselves.
    pub fn exempt(&mut self, is_exempt: impl Fn(&Account) -> bool) -> u64 {
        let mut exempted = 0_u64;
        for Discrepancy {
            topic, to, missing, ..
        } in self.balance().discrepancies
        {
            let account = Account { topic, to };
            if !is_exempt(&account) {
                continue;
            }
            let messages = missing.unsigned_abs();
            if missing < 0 {
                let counts = self.counts(&account);
                counts.sent = counts.sent.saturating_add(messages);
            } else {
                self.dropped_many(&account, DropReason::PeerOffline, messages);
            }
            exempted = exempted.saturating_add(messages);
        }
        exempted
    }

    /// Removes the accounts of messages that `process` neither receives nor publishes, and returns them: a report speaks
    /// of its own process only.
    pub fn remove_foreign(&mut self, process: &ProcessId) -> Vec<Account> {
        let principal: Option<Principal> = process.to_string().parse().ok();
        let (accounts, principal) = (&mut self.accounts, principal.as_ref());
        let foreign = accounts.extract_if(.., |account, _| match &account.to {
            Some(to) => to != process,
            None => principal.is_none_or(|principal| !principal.publishes(&account.topic)),
        });
        foreign.map(|(account, _)| account).collect()
    }

    fn counts(&mut self, account: &Account) -> &mut Counts {
        // The entry API would clone the account for every message.
        if !self.accounts.contains_key(account) {
            self.accounts.insert(account.clone(), Counts::default());
        }
        self.accounts.get_mut(account).expect("inserted above")
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::UnreceivedTopic;

    fn process(name: &str) -> ProcessId {
        ProcessId::new(name).unwrap()
    }

    fn bev() -> Topic {
        "4288/bev".parse().unwrap()
    }

    #[test]
    fn a_process_accounts_for_what_it_publishes_and_receives() {
        let own = [
            ("agent-4288", "4288/bev", None),
            ("agent-4288", "4288/lidar", Some("agent-4288")),
            ("ego-4279", "4279/detections", None),
            ("ego-4279", "rx/4279/4288/bev", Some("ego-4279")),
            ("link-4279", "rx/4279/4288/bev", None),
            ("link-4279", "4288/bev", Some("link-4279")),
            ("replay", "4288/camera/0", None),
            ("replay", "truth", None),
            ("ros2", "4288/imu", None),
            ("scorer", "truth", Some("scorer")),
        ];
        for (name, topic, to) in own {
            let account = Account {
                topic: topic.parse().unwrap(),
                to: to.map(process),
            };
            let mut ledger = Ledger::default();
            ledger.sent(&account);
            for other in ["agent-666", "ego-666", "link-666", "viewer", "unknown"] {
                assert_eq!(
                    ledger.clone().remove_foreign(&process(other)),
                    std::slice::from_ref(&account),
                    "{other}"
                );
            }
            assert_eq!(ledger.remove_foreign(&process(name)), [], "{account}");
            assert_eq!(ledger.len(), 1);
        }
    }

    /// An agent sends 10 messages: the link holds 1, loses 2 and repeats 1; the ego uses 6 and drops 2.
    fn ledgers() -> [Ledger; 3] {
        let [mut agent, mut link, mut ego] = [(); 3].map(|()| Ledger::default());
        let published = Account::published(bev());
        let towards = Account::towards(bev(), &process("ego-4279"));
        for _ in 0..10 {
            agent.sent(&published);
        }
        link.dropped(&towards, DropReason::LinkLoss);
        link.dropped(&towards, DropReason::LinkQueue);
        link.sent(&towards);
        link.set_in_flight(&towards, 7);
        link.set_in_flight(&towards, 1);
        ego.open(&towards);
        for _ in 0..6 {
            ego.received(&towards);
        }
        ego.dropped(&towards, DropReason::Duplicate);
        ego.dropped(&towards, DropReason::Stale);
        [agent, link, ego]
    }

    fn sum(ledgers: &[Ledger]) -> Ledger {
        let mut sum = Ledger::default();
        ledgers.iter().for_each(|ledger| sum.merge(ledger));
        sum
    }

    #[test]
    fn ledgers_balance_in_any_order() {
        let mut ledgers = ledgers();
        let forward = sum(&ledgers);
        ledgers.reverse();
        assert_eq!(sum(&ledgers), forward);
        assert_eq!(forward.balance(), Reconciliation::default());
        let total = forward.total();
        assert_eq!(
            (
                total.sent,
                total.received,
                total.in_flight,
                total.dropped_total()
            ),
            (11, 6, 1, 4)
        );
    }

    #[test]
    fn a_message_to_two_receivers_counts_twice_and_one_to_none_does_not_count() {
        let mut ledger = sum(&ledgers());
        let second = Account::towards(bev(), &process("ego-4288"));
        (0..10).for_each(|_| ledger.received(&second));
        ledger.sent(&Account::published("4288/descriptor".parse().unwrap()));
        let delivered = ledger.delivered();
        assert_eq!((delivered.sent, delivered.missing()), (21, 0));
    }

    #[test]
    fn a_missing_message_is_reported() {
        let mut ledgers = ledgers();
        ledgers[0].sent(&Account::published(bev()));
        let balance = sum(&ledgers).balance();
        assert!(!balance.is_exact());
        assert_eq!(balance.discrepancies[0].missing, 1);
        assert_eq!(
            balance.discrepancies[0].to_string(),
            "4288/bev to ego-4279: 1 not accounted for (sent 12, received 6, dropped 4, in flight 1)"
        );
        ledgers[2].received(&Account::towards(bev(), &process("ego-4279")));
        ledgers[2].received(&Account::towards(bev(), &process("ego-4279")));
        assert_eq!(sum(&ledgers).balance().discrepancies[0].missing, -1);
    }

    #[test]
    fn every_receiver_must_account_for_every_message() {
        let mut ledger = sum(&ledgers());
        let second = Account::towards(bev(), &process("ego-4288"));
        ledger.open(&second);
        let difference = ledger.balance().discrepancies.remove(0);
        assert_eq!((difference.to, difference.missing), (second.to, 10));
    }

    #[test]
    fn a_message_dropped_by_its_sender_is_lost_to_every_receiver() {
        let mut ledger = Ledger::default();
        let published = Account::published(bev());
        let receivers = ["a", "b"].map(|name| Account::towards(bev(), &process(name)));
        ledger.sent(&published);
        ledger.sent(&published);
        ledger.dropped(&published, DropReason::Superseded);
        receivers
            .iter()
            .for_each(|receiver| ledger.received(receiver));
        assert!(ledger.balance().is_exact());
    }

    #[test]
    fn only_offline_processes_are_exempt() {
        let mut ledger = sum(&ledgers());
        let (published, lost) = (
            Account::published(bev()),
            Account::towards(bev(), &process("ego-4279")),
        );
        (0..3).for_each(|_| ledger.sent(&published));
        assert_eq!(ledger.exempt(|_| false), 0);
        assert_eq!(ledger.exempt(|account| *account == lost), 3);
        assert_eq!(
            ledger.get(&lost).unwrap().dropped[&DropReason::PeerOffline],
            3
        );
        assert!(ledger.balance().is_exact());
        (0..2).for_each(|_| ledger.received(&lost));
        assert_eq!(ledger.exempt(|account| *account == lost), 2);
        assert!(ledger.balance().is_exact());
    }

    #[test]
    fn a_topic_without_receiver_is_no_loss_but_is_reported() {
        let mut ledger = Ledger::default();
        ledger.sent(&Account::published(bev()));
        let balance = ledger.balance();
        assert!(balance.is_exact());
        assert_eq!(
            balance.unreceived,
            [UnreceivedTopic {
                topic: bev(),
                messages: 1
            }]
        );
    }

    #[test]
    fn json_round_trip() {
        let ledger = sum(&ledgers());
        let json = serde_json::to_string(&ledger).unwrap();
        assert_eq!(
            json,
            r#"[{"topic":"4288/bev","to":null,"sent":10,"received":0,"in_flight":0,"dropped":{},"adapted":{}},"#
                .to_owned()
                + r#"{"topic":"4288/bev","to":"ego-4279","sent":1,"received":6,"in_flight":1,"#
                + r#""dropped":{"link_loss":1,"link_queue":1,"stale":1,"duplicate":1},"adapted":{}}]"#
        );
        assert_eq!(serde_json::from_str::<Ledger>(&json).unwrap(), ledger);
    }

    #[test]
    fn hostile_numbers_saturate() {
        let line = r#"{"topic":"1/bev","to":"x","sent":18446744073709551615,"received":0,"in_flight":0,"dropped":{}}"#;
        let ledger: Ledger = serde_json::from_str(&format!("[{line},{line}]")).unwrap();
        assert_eq!(ledger.balance().discrepancies[0].missing, i64::MAX);
        assert!(!ledger.balance().discrepancies[0].to_string().is_empty());
    }
}
