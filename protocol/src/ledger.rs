//! The books: nothing is lost without a line that says why.
//!
//! Every process counts what it sends, what it takes and what it drops. Added up over a run, for each topic and each
//! process that receives it,
//!
//! `sent = received + dropped(reason) + in flight`.
//!
//! - A sender counts what it publishes, and what it drops before publishing (a newer frame took the place), without
//!   naming a receiver: such lines hold for every receiver of the topic.
//! - A receiver opens an account when it subscribes ([`Ledger::open`]), so that it is known even if nothing ever comes;
//!   it counts as received what it accepted and used, and everything else as dropped.
//! - The link counts under the *sender's* topic what it drops on the way to one receiver, what it still holds (in
//!   flight), and a duplicate that it makes as sent once more. It never counts as a receiver.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

use crate::{ProcessId, Topic};

/// Why a message was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DropReason {
    /// Lost on the emulated air.
    LinkLoss,
    /// The emulated air's queue was full.
    LinkQueue,
    /// A newer one took its place before it was used.
    Superseded,
    /// Too old when it came.
    Stale,
    /// The same one had come before.
    Duplicate,
    /// Not a message, or not of this kind.
    Decode,
    /// Changed on the way.
    Checksum,
    /// Sizes that do not agree with each other, with what was announced, or with the limits.
    Shape,
    /// A value that is NaN, infinite or out of bounds.
    NotFinite,
    /// Sent under another's name.
    Identity,
    /// Of another wire version.
    Version,
    /// Sender or receiver does not know where it is.
    NoPose,
}

impl DropReason {
    /// Every reason.
    pub const ALL: [Self; 12] = [
        Self::LinkLoss,
        Self::LinkQueue,
        Self::Superseded,
        Self::Stale,
        Self::Duplicate,
        Self::Decode,
        Self::Checksum,
        Self::Shape,
        Self::NotFinite,
        Self::Identity,
        Self::Version,
        Self::NoPose,
    ];

    /// Its name, as in reports: `link_loss`.
    #[must_use]
    pub fn as_str(self) -> &'static str {
        match self {
            Self::LinkLoss => "link_loss",
            Self::LinkQueue => "link_queue",
            Self::Superseded => "superseded",
            Self::Stale => "stale",
            Self::Duplicate => "duplicate",
            Self::Decode => "decode",
            Self::Checksum => "checksum",
            Self::Shape => "shape",
            Self::NotFinite => "not_finite",
            Self::Identity => "identity",
            Self::Version => "version",
            Self::NoPose => "no_pose",
        }
    }
}

impl fmt::Display for DropReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// What is counted separately: a topic, and who receives it (`None`: whoever does).
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Account {
    /// The topic on which the message was first published.
    pub topic: Topic,
    /// The receiving process.
    pub to: Option<ProcessId>,
}

impl Account {
    /// What a sender counts.
    #[must_use]
    pub fn published(topic: Topic) -> Self {
        Self { topic, to: None }
    }

    /// What a receiver, or the link on the way to it, counts.
    #[must_use]
    pub fn towards(topic: Topic, to: &ProcessId) -> Self {
        Self { topic, to: Some(to.clone()) }
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

/// One account's counters.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Counts {
    /// Messages published.
    pub sent: u64,
    /// Messages accepted and used.
    pub received: u64,
    /// Messages under way.
    pub in_flight: u64,
    /// Messages lost, by reason.
    pub dropped: BTreeMap<DropReason, u64>,
}

impl Counts {
    /// Messages lost for any reason.
    #[must_use]
    pub fn dropped_total(&self) -> u64 {
        self.dropped.values().fold(0, |sum, count| sum.saturating_add(*count))
    }

    /// Adds another's counters. Numbers from a hostile peer saturate.
    pub fn add(&mut self, other: &Self) {
        let Self { sent, received, in_flight, dropped } = other;
        self.sent = self.sent.saturating_add(*sent);
        self.received = self.received.saturating_add(*received);
        self.in_flight = self.in_flight.saturating_add(*in_flight);
        for (reason, count) in dropped {
            let sum = self.dropped.entry(*reason).or_default();
            *sum = sum.saturating_add(*count);
        }
    }

    /// Sent less everything that is accounted for; 0 where the books balance.
    fn missing(&self) -> i128 {
        let accounted = [self.received, self.in_flight].into_iter().chain(self.dropped.values().copied());
        i128::from(self.sent) - accounted.map(i128::from).sum::<i128>()
    }
}

/// The books of one process, or of many added up.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(from = "Vec<Line>", into = "Vec<Line>")]
pub struct Ledger {
    accounts: BTreeMap<Account, Counts>,
}

/// One account as written: in JSON `{"topic": "4279/bev", "to": "ego-4279", "sent": 0, ..., "dropped": {"stale": 1}}`.
#[derive(Clone, Serialize, Deserialize)]
struct Line {
    topic: Topic,
    to: Option<ProcessId>,
    sent: u64,
    received: u64,
    in_flight: u64,
    dropped: BTreeMap<DropReason, u64>,
}

impl From<Vec<Line>> for Ledger {
    fn from(lines: Vec<Line>) -> Self {
        let mut ledger = Self::default();
        for Line { topic, to, sent, received, in_flight, dropped } in lines {
            ledger.counts(&Account { topic, to }).add(&Counts { sent, received, in_flight, dropped });
        }
        ledger
    }
}

impl From<Ledger> for Vec<Line> {
    fn from(ledger: Ledger) -> Self {
        let line = |(Account { topic, to }, Counts { sent, received, in_flight, dropped })| Line {
            topic,
            to,
            sent,
            received,
            in_flight,
            dropped,
        };
        ledger.accounts.into_iter().map(line).collect()
    }
}

impl Ledger {
    /// Opens an account with nothing on it.
    pub fn open(&mut self, account: &Account) {
        self.counts(account);
    }

    /// One more message published.
    pub fn sent(&mut self, account: &Account) {
        self.counts(account).sent += 1;
    }

    /// One more message used.
    pub fn received(&mut self, account: &Account) {
        self.counts(account).received += 1;
    }

    /// One more message lost.
    pub fn dropped(&mut self, account: &Account, reason: DropReason) {
        *self.counts(account).dropped.entry(reason).or_default() += 1;
    }

    /// How many messages are under way right now.
    pub fn set_in_flight(&mut self, account: &Account, messages: u64) {
        self.counts(account).in_flight = messages;
    }

    /// Adds another process's books.
    pub fn merge(&mut self, other: &Self) {
        for (account, counts) in &other.accounts {
            self.counts(account).add(counts);
        }
    }

    /// The counters of an account; `None` where nothing was ever counted.
    #[must_use]
    pub fn get(&self, account: &Account) -> Option<&Counts> {
        self.accounts.get(account)
    }

    /// Every account, in the order of topics, then receivers.
    pub fn iter(&self) -> impl Iterator<Item = (&Account, &Counts)> {
        self.accounts.iter()
    }

    /// Number of accounts.
    #[must_use]
    pub fn len(&self) -> usize {
        self.accounts.len()
    }

    /// Whether nothing was ever counted.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.accounts.is_empty()
    }

    /// All accounts added up. A topic with two receivers counts as sent once and received twice.
    #[must_use]
    pub fn total(&self) -> Counts {
        let mut total = Counts::default();
        self.accounts.values().for_each(|counts| total.add(counts));
        total
    }

    /// Compares what was sent with what is accounted for, for each topic and receiver. Call it on the sum of all
    /// processes' books.
    #[must_use]
    pub fn balance(&self) -> Balance {
        let mut balance = Balance::default();
        for (account, counts) in &self.accounts {
            if account.to.is_none() {
                let heard = self.accounts.keys().any(|other| other.to.is_some() && other.topic == account.topic);
                if !heard && counts.missing() > 0 {
                    balance.unheard.push(Unheard { topic: account.topic.clone(), messages: counts.missing() as u64 });
                } else if !heard && counts.missing() < 0 {
                    balance.push_difference(account, counts.clone());
                }
                continue;
            }
            let mut both = counts.clone();
            if let Some(published) = self.accounts.get(&Account::published(account.topic.clone())) {
                both.add(published);
            }
            balance.push_difference(account, both);
        }
        balance
    }

    fn counts(&mut self, account: &Account) -> &mut Counts {
        if !self.accounts.contains_key(account) {
            self.accounts.insert(account.clone(), Counts::default());
        }
        self.accounts.get_mut(account).expect("inserted above")
    }
}

/// What [`Ledger::balance`] finds.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Balance {
    /// Accounts whose numbers do not add up.
    pub differences: Vec<Difference>,
    /// Topics that nobody subscribed to: sent, lost to no one.
    pub unheard: Vec<Unheard>,
}

/// One account that does not add up.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Difference {
    /// The topic.
    pub topic: Topic,
    /// The receiving process, where one is known.
    pub to: Option<ProcessId>,
    /// Sent less received, dropped and in flight: positive, messages vanished; negative, messages came from nowhere.
    pub missing: i64,
    /// The numbers that do not add up.
    pub counts: Counts,
}

/// A topic without a receiver.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Unheard {
    /// The topic.
    pub topic: Topic,
    /// Messages published.
    pub messages: u64,
}

impl Balance {
    /// Whether every message is accounted for.
    #[must_use]
    pub fn is_exact(&self) -> bool {
        self.differences.is_empty()
    }

    fn push_difference(&mut self, account: &Account, counts: Counts) {
        let missing = counts.missing();
        if missing != 0 {
            let Account { topic, to } = account.clone();
            // Books of real runs are far from the ends of the range; hostile ones may be cut there.
            let missing = missing.clamp(i64::MIN.into(), i64::MAX.into()) as i64;
            self.differences.push(Difference { topic, to, missing, counts });
        }
    }
}

impl fmt::Display for Difference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { topic, to, missing, counts } = self;
        let to = to.as_ref().map(|to| format!(" to {to}")).unwrap_or_default();
        let (verb, count) = if *missing > 0 { ("vanished", *missing) } else { ("came from nowhere", -missing) };
        write!(
            f,
            "{topic}{to}: {count} {verb} (sent {}, received {}, dropped {}, in flight {})",
            counts.sent,
            counts.received,
            counts.dropped_total(),
            counts.in_flight
        )
    }
}
