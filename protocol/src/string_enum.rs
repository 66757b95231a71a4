//! Enums that are written as text: in keys, in text formats and in reports.

/// An enum whose values have one name each, used in keys and in JSON. On the wire a value is its index in the list, so
/// a new one is appended at the end.
macro_rules! named {
    ($(#[$doc:meta])* pub enum $name:ident { $($(#[$value_doc:meta])* $value:ident = $text:literal,)+ }) => {
        $(#[$doc])*
        #[derive(
            Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize,
            strum::Display, strum::EnumString, strum::IntoStaticStr,
        )]
        pub enum $name {
            $($(#[$value_doc])* #[serde(rename = $text)] #[strum(serialize = $text)] $value,)+
        }

        impl $name {
            /// Every value, in order.
            pub const ALL: [Self; [$(Self::$value),+].len()] = [$(Self::$value),+];

            /// Its name.
            pub fn as_str(self) -> &'static str {
                self.into()
            }
        }
    };
}

/// Conversions from and to an owned text, by way of `FromStr` and `Display`, as serde requires them for a type that is
/// written as text.
#[doc(hidden)]
#[macro_export]
macro_rules! written_as_text {
    ($name:ident) => {
        impl TryFrom<String> for $name {
            type Error = <Self as std::str::FromStr>::Err;

            fn try_from(text: String) -> Result<Self, Self::Error> {
                text.parse()
            }
        }

        impl From<$name> for String {
            fn from(value: $name) -> Self {
                value.to_string()
            }
        }
    };
}

pub(crate) use {named, written_as_text};

#[cfg(test)]
mod tests {
    use crate::DropReason;
    use crate::MisbehaviourReason;
    use crate::RateReason;
    use crate::Role;
    use crate::Verb;

    #[test]
    fn values_are_written_by_name_and_the_names_differ() {
        fn check<T: serde::Serialize + std::fmt::Display>(all: &[T]) {
            let names: std::collections::BTreeSet<String> =
                all.iter().map(ToString::to_string).collect();
            assert_eq!(names.len(), all.len());
            for value in all {
                assert_eq!(
                    serde_json::to_string(value).unwrap(),
                    format!("\"{value}\"")
                );
            }
        }
        check(&MisbehaviourReason::ALL);
        check(&DropReason::ALL);
        check(&RateReason::ALL);
        check(&Role::ALL);
        check(&Verb::ALL);
        assert_eq!(DropReason::LinkLoss.as_str(), "link_loss");
    }
}
