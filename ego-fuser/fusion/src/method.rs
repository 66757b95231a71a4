//! The table of collaboration methods, and [`Method`], a handle to one of them.

use std::borrow::Cow;
use std::ffi::OsStr;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::path::Path;
use std::str::FromStr;

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser, ValueParserFactory};
use clap::{Arg, Command};
use perception::model_config::DetectorConfig;
use perception::weights::{FileError, METHOD_KEY, Weights};
use protocol::ConfidenceGate;
use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::Error;
use serde::{Deserialize, Deserializer, Serialize};

use crate::{
    FusionConfig, MethodSpec, attention, coalign, cobevt, disconet, ermvp, max, own, pastat,
    script, traf_align, v2vnet, v2xvit, where2comm,
};

pub use crate::Exchange;

/// A collaboration method: how the views of several CAVs become one set of boxes.
#[derive(Clone, Copy, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Method(&'static MethodSpec);

protocol::written_as_text!(Method);

/// Every method, in the order of tables, as `NAME: specification`.
macro_rules! methods {
    ($($name:ident: $spec:path,)*) => {
        impl Method {
            $(#[doc = concat!("See `", stringify!($spec), "`.")]
            pub const $name: Self = Self(&$spec);)*

            /// Every method, in the order of tables.
            pub const ALL: [Self; [$(stringify!($name)),*].len()] = [$(Self::$name),*];
        }
    };
}

methods! {
    NONE: own::NONE,
    LATE: own::LATE,
    EARLY: own::EARLY,
    MAX: max::METHOD,
    ATTENTION: attention::METHOD,
    WHERE2COMM: where2comm::METHOD,
    COALIGN: coalign::METHOD,
    V2VNET: v2vnet::METHOD,
    DISCONET: disconet::METHOD,
    V2XVIT: v2xvit::METHOD,
    COBEVT: cobevt::METHOD,
    ERMVP: ermvp::METHOD,
    TRAF_ALIGN: traf_align::METHOD,
    PASTAT: pastat::METHOD,
}

impl Method {
    /// A method that is not in the table: this process reaches it only by its handle.
    pub const fn of(spec: &'static MethodSpec) -> Self {
        Self(spec)
    }

    /// The name on the command line and in result files.
    pub const fn name(self) -> &'static str {
        self.0.name
    }

    /// The TorchScript file of a method `script:FILE.pt`, a fusion of a user's, which may stand on any encoder.
    pub fn script_file(self) -> Option<&'static Path> {
        self.name().strip_prefix(script::PREFIX).map(Path::new)
    }

    /// One line for `--help` and tables.
    pub const fn summary(self) -> &'static str {
        self.0.summary
    }

    /// Content of its messages.
    pub const fn exchange(self) -> Exchange {
        self.0.exchange
    }

    /// Content that the ego needs of its own sweep: that of its messages, and its feature map for ego-only operation.
    pub const fn own_content(self) -> Exchange {
        match self.exchange() {
            Exchange::Nothing => Exchange::Features,
            other => other,
        }
    }

    /// Selection of the cells that agents send unless configured otherwise; absent: all cells.
    pub const fn gate(self) -> Option<ConfidenceGate> {
        self.0.gate
    }

    /// Names of the methods whose weights it runs with, best first.
    pub fn weights_names(self) -> Vec<&'static str> {
        match self.0.runs_with_weights_of {
            [] => vec![self.name()],
            names => names.to_vec(),
        }
    }

    /// Checks that a weights file, if it names a method, was trained for one whose weights this method runs with.
    ///
    /// # Errors
    /// [`FileError`] with both methods.
    pub fn check_training(self, weights: &Weights) -> Result<(), FileError> {
        let names = self.weights_names();
        match weights.metadata(METHOD_KEY) {
            Some(trained) if trained != self.name() && !names.contains(&trained) => {
                let needed = format_args!("method {self} needs weights trained for {}", names[0]);
                let problem = format_args!("trained for {trained}, and {needed}");
                Err(FileError::new(weights.path(), problem))
            }
            _ => Ok(()),
        }
    }

    /// The method to run with a weights file: `named`, or else the one that the file names.
    ///
    /// # Errors
    /// [`UnknownMethod`] when the name in the file is that of no method.
    pub fn of_weights(weights: &Weights, named: Option<Self>) -> Result<Self, UnknownMethod> {
        match (named, weights.metadata(METHOD_KEY)) {
            (Some(method), _) => Ok(method),
            (None, Some(name)) => name.parse(),
            // A file without a method is that of a detector alone.
            (None, None) => Ok(Self::NONE),
        }
    }

    /// Default settings of its fusion behind a detector; methods that exchange no feature maps fuse none.
    pub fn default_fusion(self, detector: &DetectorConfig) -> FusionConfig {
        (self.0.fusion.default_config)(self.0, detector)
    }

    /// True if the settings of a weights file are to be used for its fusion. A script's file is that of its name.
    pub(crate) fn has_fusion(self, config: &FusionConfig) -> bool {
        self.0.fusion.kind == config.kind() && config.kind() != script::FUSION.kind
    }
}

/// A name that no method has.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no method is called {0:?}; there are {names} and script:FILE.pt", names = Method::ALL.map(Method::name).join(", "))]
pub struct UnknownMethod(String);

impl FromStr for Method {
    type Err = UnknownMethod;

    fn from_str(text: &str) -> Result<Self, UnknownMethod> {
        let of_table = Self::ALL.into_iter().find(|method| method.name() == text);
        of_table
            .or_else(|| script::spec(text).map(Self))
            .ok_or_else(|| UnknownMethod(text.to_owned()))
    }
}

impl fmt::Display for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl fmt::Debug for Method {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Method({})", self.name())
    }
}

impl PartialEq for Method {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for Method {}

impl Hash for Method {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name().hash(state);
    }
}

impl JsonSchema for Method {
    fn schema_name() -> Cow<'static, str> {
        "Method".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let mut names: Vec<Schema> = Self::ALL
            .iter()
            .map(|method| json_schema!({"const": method.name(), "description": method.summary()}))
            .collect();
        names.push(json_schema!({"pattern": "^script:.+", "description": "A TorchScript file, script:FILE.pt."}));
        json_schema!({"description": "How the views of several CAVs become one set of boxes.", "oneOf": names})
    }
}

/// For command lines: `--help` and the error for an unknown name list the names.
impl ValueParserFactory for Method {
    type Parser = MethodParser;

    fn value_parser() -> Self::Parser {
        MethodParser
    }
}

/// Parser of a method on a command line.
#[derive(Debug, Clone, Copy)]
pub struct MethodParser;

impl TypedValueParser for MethodParser {
    type Value = Method;

    fn parse_ref(
        &self,
        command: &Command,
        argument: Option<&Arg>,
        value: &OsStr,
    ) -> Result<Method, clap::Error> {
        // The parser below knows the names of the table only and would refuse that of a file.
        if let Some(spec) = value.to_str().and_then(script::spec) {
            return Ok(Method(spec));
        }
        PossibleValuesParser::new(of_table())
            .try_map(|name| name.parse::<Method>())
            .parse_ref(command, argument, value)
    }

    fn possible_values(&self) -> Option<Box<dyn Iterator<Item = PossibleValue> + '_>> {
        let script = PossibleValue::new("script:FILE.pt")
            .help("feature maps, fused by a TorchScript module");
        Some(Box::new(of_table().into_iter().chain([script])))
    }
}

fn of_table() -> Vec<PossibleValue> {
    Method::ALL
        .map(|method| PossibleValue::new(method.name()).help(method.summary()))
        .to_vec()
}

impl<'de> Deserialize<'de> for FusionConfig {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut fields = serde_json::Map::deserialize(deserializer)?;
        let kind = fields
            .remove("kind")
            .ok_or_else(|| D::Error::missing_field("kind"))?;
        // A script is not in the table, but its settings are stored like all others.
        let known = Method::ALL
            .into_iter()
            .map(|method| method.0.fusion)
            .chain([script::FUSION]);
        let fusion = known.into_iter().find(|fusion| kind == fusion.kind);
        let fusion = fusion
            .ok_or_else(|| D::Error::custom(format_args!("unknown kind of fusion {kind}")))?;
        (fusion.parse)(fields.into()).map_err(D::Error::custom)
    }
}

#[cfg(test)]
mod tests;
