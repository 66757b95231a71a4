//! Checked identifiers: names that are valid chunks of a key.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use crate::string_enum::written_as_text;
use crate::text::excerpt;

/// Reserved chunks at the position of a CAV in a key: a vehicle of that name would publish onto a key of another
/// process.
const RESERVED_CAV_IDS: [&str; 6] = ["alive", "control", "ready", "rx", "stats", "truth"];

/// Error of a text that is not an identifier: empty, too long, of a character outside the alphabet, or a word that has
/// another meaning in keys.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct IdError(pub(crate) String);

impl IdError {
    pub(crate) fn malformed(kind: &str, text: &str, max_len: usize) -> Self {
        let problem = format!("{kind} {text:?} is not an identifier: 1 to {max_len}");
        Self(format!("{problem} characters of a-z, 0-9, '_' and '-'"))
    }
}

fn check(kind: &str, text: &str, max_len: usize, reserved: &[&str]) -> Result<Box<str>, IdError> {
    let is_valid = (1..=max_len).contains(&text.len())
        && text
            .bytes()
            .all(|byte| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'_' | b'-'));
    if !is_valid {
        // A hostile name must not fill the log.
        let text = excerpt(text, 2 * max_len);
        return Err(IdError::malformed(kind, &text, max_len));
    }
    if reserved.contains(&text) {
        let problem = format!("{kind} {text:?} is a reserved word of the key space");
        return Err(IdError(format!("{problem}: one of {reserved:?}")));
    }
    Ok(text.into())
}

macro_rules! identifier {
    ($(#[$doc:meta])* $name:ident, $kind:literal, $max_len:literal, $reserved:expr) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        #[cfg_attr(feature = "config", derive(schemars::JsonSchema))]
        #[cfg_attr(feature = "config", schemars(extend("pattern" = "^[a-z0-9_-]+$", "maxLength" = $max_len)))]
        pub struct $name(Box<str>);

        impl $name {
            /// Longest identifier, bytes.
            pub const MAX_LEN: usize = $max_len;

            /// Checks `text`: 1 to [`Self::MAX_LEN`] characters of `a-z`, `0-9`, `_` and `-`.
            ///
            /// # Errors
            /// [`IdError`] states the text that is no identifier.
            pub fn new(text: &str) -> Result<Self, IdError> {
                check($kind, text, $max_len, $reserved).map(Self)
            }

            /// The identifier as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl FromStr for $name {
            type Err = IdError;

            fn from_str(text: &str) -> Result<Self, IdError> {
                Self::new(text)
            }
        }

        written_as_text!($name);
    };
}

identifier! {
    /// One connected vehicle (or roadside unit), for example `4279` or `-1`.
    CavId, "CAV id", 32, &RESERVED_CAV_IDS
}
identifier! {
    /// One run of the fleet: the second chunk of every key.
    RunId, "run name", 32, &[]
}
identifier! {
    /// One process of a run, for example `agent-4279`: the owner of a ledger.
    ProcessId, "process name", 64, &[]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_ids_of_data_sets() {
        for text in ["4279", "-1", "cav_0", &"a".repeat(32)] {
            assert_eq!(CavId::new(text).unwrap().as_str(), text);
        }
    }

    #[test]
    fn refuses_text_that_could_alter_a_key() {
        for text in ["", "a/b", "*", "**", "@x", "a$*", "A", "é", &"a".repeat(33)] {
            assert!(CavId::new(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_vehicle_cannot_take_the_place_of_a_reserved_key() {
        for word in RESERVED_CAV_IDS {
            let error = CavId::new(word).unwrap_err().to_string();
            assert!(error.contains("is a reserved word"), "{error}");
            assert!(ProcessId::new(word).is_ok() && RunId::new(word).is_ok());
        }
    }

    #[test]
    fn a_long_hostile_name_is_cut_in_the_message() {
        let error = RunId::new(&"/".repeat(100_000)).unwrap_err();
        assert!(error.to_string().len() < 300);
    }
}
