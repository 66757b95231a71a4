//! Configurations as options of a command line, and checks of their fields. With the feature `config` only.

mod field;
mod options;

pub use field::{FieldError, above_zero, require, within};
pub use options::{Section, document, options_of};
