//! Checked identifiers: what may stand in a key of the network.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

/// Longest identifier, in bytes.
const MAX_LEN: usize = 32;

/// Why a text is not an identifier.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{kind} {text:?} is not an identifier: 1 to 32 characters of a-z, 0-9, '_' and '-'")]
pub struct IdError {
    kind: &'static str,
    text: String,
}

fn check(kind: &'static str, text: &str) -> Result<Box<str>, IdError> {
    let allowed = |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'_' || byte == b'-';
    if (1..=MAX_LEN).contains(&text.len()) && text.bytes().all(allowed) {
        return Ok(text.into());
    }
    // A hostile name must not fill the log.
    let text = text.chars().take(2 * MAX_LEN).collect();
    Err(IdError { kind, text })
}

macro_rules! identifier {
    ($(#[$doc:meta])* $name:ident, $kind:literal) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(try_from = "String", into = "String")]
        pub struct $name(Box<str>);

        impl $name {
            /// Checks `text`: 1 to 32 characters of `a-z`, `0-9`, `_` and `-`.
            ///
            /// # Errors
            /// [`IdError`] names the text that is no identifier.
            pub fn new(text: &str) -> Result<Self, IdError> {
                check($kind, text).map(Self)
            }

            /// The identifier as text.
            #[must_use]
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

        impl TryFrom<String> for $name {
            type Error = IdError;

            fn try_from(text: String) -> Result<Self, IdError> {
                Self::new(&text)
            }
        }

        impl From<$name> for String {
            fn from(id: $name) -> Self {
                id.0.into()
            }
        }
    };
}

identifier! {
    /// One connected vehicle (or roadside unit), for example `4279` or `-1`.
    CavId, "CAV id"
}
identifier! {
    /// One run of the fleet: the second chunk of every key.
    RunId, "run name"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_the_names_of_datasets() {
        for text in ["4279", "-1", "cav_0", &"a".repeat(32)] {
            assert_eq!(CavId::new(text).unwrap().as_str(), text);
        }
    }

    #[test]
    fn refuses_what_could_steer_a_key() {
        for text in ["", "a/b", "*", "**", "@x", "a$*", "A", "é", &"a".repeat(33)] {
            assert!(CavId::new(text).is_err(), "{text}");
        }
    }

    #[test]
    fn a_long_hostile_name_is_cut_in_the_message() {
        let error = RunId::new(&"/".repeat(100_000)).unwrap_err();
        assert!(error.to_string().len() < 300);
    }
}
