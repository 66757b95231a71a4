//! Command-line options that choose and configure a pose source.

use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, FromArgMatches, ValueEnum};
use protocol::config::{document, options_of};

use super::{
    BaselinePoseConfig, CachedPoseConfig, NoiseMode, NoisyPoseConfig, PgcConfig, PoseSourceConfig,
    TrackedPoseConfig,
};

/// Option that chooses the source.
#[derive(Debug, clap::Args)]
struct Choice {
    /// Source of the vehicle's pose [default: recorded].
    #[arg(long, value_enum)]
    pose_source: Option<Kind>,
}

/// Sources without their settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
#[value(rename_all = "snake_case")]
enum Kind {
    /// The recorded pose.
    Recorded,
    /// The recorded pose with an error.
    Noisy,
    /// Estimated from the LiDAR sweep alone, by PGC.
    Pgc,
    /// Estimated by PGC and followed from sweep to sweep.
    Tracked,
    /// Estimated from the LiDAR sweep alone, by a baseline of the paper: SGLoc, DiffLoc or HypLiLoc.
    Baseline,
    /// Read from a table that `agent localize` wrote.
    Cached,
}

impl PoseSourceConfig {
    fn kind(&self) -> Kind {
        match self {
            Self::Recorded => Kind::Recorded,
            Self::Noisy(_) => Kind::Noisy,
            Self::Pgc(_) => Kind::Pgc,
            Self::Tracked(_) => Kind::Tracked,
            Self::Baseline(_) => Kind::Baseline,
            Self::Cached(_) => Kind::Cached,
        }
    }

    fn new(kind: Kind) -> Self {
        match kind {
            Kind::Recorded => Self::Recorded,
            Kind::Noisy => Self::Noisy(NoisyPoseConfig::default()),
            Kind::Pgc => Self::Pgc(PgcConfig::default()),
            Kind::Tracked => Self::Tracked(TrackedPoseConfig::default()),
            Kind::Baseline => Self::Baseline(BaselinePoseConfig::default()),
            Kind::Cached => Self::Cached(CachedPoseConfig::default()),
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
        let requested = Choice::from_arg_matches(matches)?.pose_source;
        if let Some(kind) = requested.filter(|kind| *kind != self.kind()) {
            *self = Self::new(kind);
        }
        self.update_chosen(matches)?;
        let given = |option: &Arg| {
            matches.value_source(option.get_id().as_str()) == Some(ValueSource::CommandLine)
        };
        match options().find(|option| given(option) && !self.has_use_for(option.get_id().as_str()))
        {
            Some(option) => Err(self.refused(&option)),
            None => Ok(()),
        }
    }
}

/// The options of all sources.
fn options() -> impl Iterator<Item = Arg> {
    options_of::<NoisyPoseConfig>()
        .chain(options_of::<PgcConfig>())
        .chain(options_of::<TrackedPoseConfig>())
        .chain(options_of::<BaselinePoseConfig>())
        .chain(options_of::<CachedPoseConfig>())
}

impl PoseSourceConfig {
    /// True if the option changes something of this source.
    fn has_use_for(&self, option: &str) -> bool {
        match self {
            Self::Recorded => false,
            Self::Noisy(noise) => match option {
                "noise_position_std_m" | "noise_heading_std_deg" => {
                    noise.mode != NoiseMode::Replayed
                }
                "noise_step_s" => noise.mode != NoiseMode::Fixed,
                "noise_decay_s" => noise.mode == NoiseMode::Autoregressive,
                // A table that is not replayed is refused with the other values.
                option => option.starts_with("noise_"),
            },
            Self::Pgc(_) => ["encoder", "head", "lightloc"].contains(&option),
            Self::Tracked(_) => {
                ["encoder", "head"].contains(&option) || option.starts_with("tracking_")
            }
            Self::Baseline(_) => option == "baseline",
            Self::Cached(_) => option == "poses",
        }
    }

    fn refused(&self, option: &Arg) -> clap::Error {
        let option = option.get_long().unwrap_or_default();
        let mode = match self {
            Self::Noisy(noise) => noise.mode.to_possible_value(),
            _ => None,
        };
        let mode = mode.map_or_else(String::new, |mode| {
            format!(", noise mode {}", mode.get_name())
        });
        let source = self.name();
        clap::Error::raw(
            ErrorKind::ArgumentConflict,
            format!("--{option} has no effect on pose source {source}{mode}\n"),
        )
    }

    fn update_chosen(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        match self {
            Self::Recorded => Ok(()),
            Self::Noisy(noise) => noise.update_from_arg_matches(matches),
            Self::Pgc(networks) => networks.update_from_arg_matches(matches),
            Self::Tracked(tracked) => {
                let mut networks = PgcConfig {
                    encoder: tracked.encoder.clone(),
                    head: tracked.head.clone(),
                    ..Default::default()
                };
                networks.update_from_arg_matches(matches)?;
                (tracked.encoder, tracked.head) = (networks.encoder, networks.head);
                tracked.update_from_arg_matches(matches)
            }
            Self::Baseline(network) => network.update_from_arg_matches(matches),
            Self::Cached(table) => table.update_from_arg_matches(matches),
        }
    }
}

impl Args for PoseSourceConfig {
    fn augment_args(command: Command) -> Command {
        let command = NoisyPoseConfig::augment_args_for_update(Choice::augment_args(command));
        let noise = serde_json::json!({ "noise": NoisyPoseConfig::default() });
        let command = document(command, options_of::<NoisyPoseConfig>(), &noise);
        let command = PgcConfig::augment_args_for_update(command);
        let networks = serde_json::json!({ "pgc": PgcConfig::default() });
        let command = document(command, options_of::<PgcConfig>(), &networks);
        let command = TrackedPoseConfig::augment_args_for_update(command);
        let tracking = serde_json::json!({ "tracking": TrackedPoseConfig::default() });
        let command = document(command, options_of::<TrackedPoseConfig>(), &tracking);
        let command = BaselinePoseConfig::augment_args_for_update(command);
        CachedPoseConfig::augment_args_for_update(command)
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use protocol::config::Section;

    use super::super::NoiseMode;
    use super::*;

    #[derive(Debug, Parser)]
    struct Cli {
        #[command(flatten)]
        pose: Section<PoseSourceConfig>,
    }

    fn parsed(words: &[&str]) -> PoseSourceConfig {
        Cli::try_parse_from([&["program"], words].concat())
            .unwrap()
            .pose
            .0
    }

    #[test]
    fn options_choose_a_source_and_set_it_up() {
        assert_eq!(parsed(&[]), PoseSourceConfig::Recorded);
        let noisy = parsed(&[
            "--pose-source=noisy",
            "--noise-mode=autoregressive",
            "--noise-position-std-m=0.5",
        ]);
        let expected = NoisyPoseConfig {
            mode: NoiseMode::Autoregressive,
            position_std_m: 0.5,
            ..Default::default()
        };
        assert_eq!(noisy, PoseSourceConfig::Noisy(expected));
        let PoseSourceConfig::Pgc(pgc) = parsed(&["--pose-source=pgc", "--encoder=e", "--head=h"])
        else {
            panic!()
        };
        assert_eq!(
            (pgc.encoder.to_str(), pgc.head.to_str()),
            (Some("e"), Some("h"))
        );
        let message = parsed(&["--pose-source=pgc", "--encoder=e"])
            .validate()
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("pgc.head is empty") && message.contains("--head"),
            "{message}"
        );
        assert!(
            parsed(&["--pose-source=baseline", "--baseline=w"])
                .validate()
                .is_ok()
        );
        assert!(
            parsed(&["--pose-source=cached", "--poses=p.csv"])
                .validate()
                .is_ok()
        );
    }

    #[test]
    fn options_of_another_source_or_noise_mode_are_refused() {
        for (words, refused) in [
            (
                "--noise-position-std-m=2",
                "--noise-position-std-m has no effect on pose source recorded",
            ),
            ("--head=town1", "--head"),
            ("--measure-every=2", "--measure-every"),
            ("--poses=p.csv", "--poses"),
            ("--baseline=b", "--baseline"),
            ("--lightloc", "--lightloc"),
            (
                "--pose-source=tracked --head=h --lightloc",
                "--lightloc has no effect on pose source tracked",
            ),
            (
                "--pose-source=pgc --head=h --max-coast-s=1",
                "--max-coast-s",
            ),
            (
                "--pose-source=cached --poses=p.csv --noise-seed=1",
                "--noise-seed",
            ),
            (
                "--pose-source=noisy --noise-decay-s=1",
                "--noise-decay-s has no effect on pose source noisy, noise mode independent",
            ),
            (
                "--pose-source=noisy --noise-mode=fixed --noise-step-s=1",
                "--noise-step-s",
            ),
        ] {
            let words = ["p"].into_iter().chain(words.split(' '));
            let error = Cli::try_parse_from(words).unwrap_err();
            assert_eq!(error.exit_code(), 2);
            assert!(error.to_string().contains(refused), "{error}");
        }
    }

    #[test]
    fn an_option_changes_one_setting_of_a_source_that_is_set_up() {
        let mut source = PoseSourceConfig::Noisy(NoisyPoseConfig {
            seed: 3,
            decay_s: 2.0,
            ..Default::default()
        });
        let matches = PoseSourceConfig::augment_args(Command::new("p"))
            .get_matches_from(["p", "--noise-seed=4"]);
        source.update_from_arg_matches(&matches).unwrap();
        let expected = NoisyPoseConfig {
            seed: 4,
            decay_s: 2.0,
            ..Default::default()
        };
        assert_eq!(source, PoseSourceConfig::Noisy(expected));
    }
}
