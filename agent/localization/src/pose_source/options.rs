//! Command-line options that choose and configure a pose source.

use clap::{ArgMatches, Args, Command, FromArgMatches, ValueEnum};
use protocol::config::{document, options_of};

use super::{
    BaselinePoseConfig, CachedPoseConfig, NoisyPoseConfig, PgcConfig, PoseSourceConfig,
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

    /// Options of sources that are not chosen are ignored.
    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        let requested = Choice::from_arg_matches(matches)?.pose_source;
        if let Some(kind) = requested.filter(|kind| *kind != self.kind()) {
            *self = Self::new(kind);
        }
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
