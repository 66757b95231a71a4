//! Table of pose sources: one row per source. The configuration and its command-line options are generated from it.

use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, ValueEnum};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::options;
use super::settings::PoseSettings;
use super::{
    BaselinePoseConfig, CachedPoseConfig, NoisyPoseConfig, PgcConfig, RecordedPose,
    TrackedPoseConfig,
};

/// Rows `Variant(Settings) = "name"`, each with its documentation, after the recorded pose, which has no settings.
macro_rules! pose_sources {
    ($($(#[$doc:meta])* $variant:ident($settings:ident) = $name:tt,)+) => {
        /// A pose source and its settings.
        #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
        #[serde(rename_all = "snake_case", deny_unknown_fields)]
        pub enum PoseSourceConfig {
            /// The measured pose.
            #[default]
            Recorded,
            $($(#[$doc])* #[serde(rename = $name)] $variant($settings),)+
        }

        /// Sources without their settings.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
        #[value(rename_all = "snake_case")]
        pub(super) enum Kind {
            /// The measured pose.
            Recorded,
            $($(#[$doc])* #[value(name = $name)] $variant,)+
        }

        impl PoseSourceConfig {
            /// Groups of command-line options, one for each source with settings.
            pub const OPTION_GROUPS: &[&str] = &[$(stringify!($settings)),+];

            /// Name in files and on command lines.
            pub fn name(&self) -> &'static str {
                match self {
                    Self::Recorded => "recorded",
                    $(Self::$variant(_) => $name,)+
                }
            }

            pub(super) fn settings(&self) -> &dyn PoseSettings {
                match self {
                    Self::Recorded => &RecordedPose,
                    $(Self::$variant(settings) => settings,)+
                }
            }

            pub(super) fn settings_mut(&mut self) -> Option<&mut dyn PoseSettings> {
                match self {
                    Self::Recorded => None,
                    $(Self::$variant(settings) => Some(settings),)+
                }
            }

            fn of_kind(kind: Kind) -> Self {
                match kind {
                    Kind::Recorded => Self::Recorded,
                    $(Kind::$variant => Self::$variant($settings::default()),)+
                }
            }
        }

        impl FromArgMatches for PoseSourceConfig {
            fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
                let mut source = Self::default();
                source.update_from_arg_matches(matches)?;
                Ok(source)
            }

            /// Options of a source that is not chosen are refused.
            fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
                // The source of a file keeps its values where the command line names the same one.
                let requested = matches.get_one::<Kind>(options::CHOICE).copied();
                let requested = requested.map(Self::of_kind);
                if let Some(source) = requested.filter(|source| source.name() != self.name()) {
                    *self = source;
                }
                let own: Vec<Arg> = match self {
                    Self::Recorded => Vec::new(),
                    $(Self::$variant(settings) => options::update(settings, matches)?,)+
                };
                let all = [$(options::of::<$settings>()),+].concat();
                options::refuse_useless(self.name(), self.settings(), &own, &all, matches)
            }
        }

        impl Args for PoseSourceConfig {
            fn augment_args(command: Command) -> Command {
                let command = command.arg(options::choice::<Kind>());
                $(let command = options::augment::<$settings>(command);)+
                command
            }

            fn augment_args_for_update(command: Command) -> Command {
                Self::augment_args(command)
            }
        }
    };
}

pose_sources! {
    /// The measured pose with an error.
    Noisy(NoisyPoseConfig) = "noisy",
    /// Estimated from the sweep alone, by PGC.
    Pgc(PgcConfig) = "pgc",
    /// Estimated by PGC and followed from sweep to sweep.
    Tracked(TrackedPoseConfig) = "tracked",
    /// Estimated from the sweep alone, by a baseline of the paper: SGLoc, DiffLoc or HypLiLoc.
    Baseline(BaselinePoseConfig) = "baseline",
    /// Read from a table that `agent localize` wrote.
    Cached(CachedPoseConfig) = "cached",
}

#[cfg(test)]
mod tests {
    /// A table of its own, with one source that the crate does not have.
    #[allow(unreachable_pub, dead_code)]
    mod dummy {
        use std::path::PathBuf;

        use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, ValueEnum};
        use perception::inference::Inference;
        use protocol::config::FieldError;
        use schemars::JsonSchema;
        use serde::{Deserialize, Serialize};

        use super::super::super::settings::{PoseBasis, require_file};
        use super::super::super::{PoseSource, PoseSourceError, options};
        use super::super::{PoseSettings, RecordedPose};

        /// The place of a beacon.
        #[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema, Args)]
        #[serde(default, deny_unknown_fields)]
        pub struct BeaconConfig {
            /// Places of the beacons.
            #[arg(id = "beacon_file", long = "beacon-file")]
            pub file: PathBuf,
            /// Its number.
            #[arg(id = "beacon_number", long = "beacon-number")]
            pub number: u32,
        }

        impl PoseSettings for BeaconConfig {
            fn basis(&self) -> PoseBasis {
                PoseBasis::Files
            }

            fn build(&self, _: Inference) -> Result<Box<dyn PoseSource>, PoseSourceError> {
                Ok(Box::new(RecordedPose))
            }

            fn validate(&self) -> Result<(), FieldError> {
                require_file("beacon.file", "--beacon-file", &self.file)
            }

            fn files(&mut self) -> Vec<&mut PathBuf> {
                vec![&mut self.file]
            }

            fn option_prefix() -> &'static str {
                "beacon"
            }

            fn set_turn(&mut self, turn: u32) {
                self.number = turn;
            }
        }

        pose_sources! {
            /// The place of a beacon.
            Beacon(BeaconConfig) = "beacon",
        }
    }

    use clap::Parser;
    use perception::inference::Inference;
    use protocol::config::Section;

    use dummy::{BeaconConfig, PoseSourceConfig};

    use super::super::settings::PoseBasis;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        pose: Section<PoseSourceConfig>,
    }

    fn parsed(words: &str) -> Result<PoseSourceConfig, clap::Error> {
        let words = ["program"].into_iter().chain(words.split_whitespace());
        Cli::try_parse_from(words).map(|cli| cli.pose.0)
    }

    #[test]
    fn a_new_source_is_one_file_and_one_row() {
        assert_eq!(parsed("").unwrap(), PoseSourceConfig::Recorded);
        let options = "--pose-source beacon --beacon-file b.csv --beacon-number 3";
        let mut source = parsed(options).unwrap();
        let beacon = BeaconConfig {
            file: "b.csv".into(),
            number: 3,
        };
        assert_eq!(source, PoseSourceConfig::Beacon(beacon));
        let refused = parsed("--beacon-number 3").unwrap_err().to_string();
        let expected = "--beacon-number has no effect on pose source recorded";
        assert!(refused.contains(expected), "{refused}");
        let help = <Cli as clap::CommandFactory>::command()
            .render_long_help()
            .to_string();
        assert!(help.contains("beacon:") && help.contains("Its number [default: 0]"));

        let text = serde_json::to_string(&source).unwrap();
        assert_eq!(text, r#"{"beacon":{"file":"b.csv","number":3}}"#);
        assert_eq!(
            serde_json::from_str::<PoseSourceConfig>(&text).unwrap(),
            source
        );
        assert_eq!(source.name(), "beacon");
        assert_eq!(PoseSourceConfig::OPTION_GROUPS, ["BeaconConfig"]);
        assert_eq!(source.settings().basis(), PoseBasis::Files);
        assert!(source.settings().build(Inference::default()).is_ok());
        let settings = source.settings_mut().unwrap();
        settings.set_turn(8);
        assert_eq!(settings.files()[0].to_str(), Some("b.csv"));
        *settings.files()[0] = std::path::PathBuf::new();
        let error = settings.validate().unwrap_err().to_string();
        assert!(error.contains("beacon.file is empty") && error.contains("--beacon-file"));
        let PoseSourceConfig::Beacon(beacon) = &source else {
            panic!("{source:?}")
        };
        assert_eq!(beacon.number, 8);
    }
}
