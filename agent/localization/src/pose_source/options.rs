//! Command-line options that choose and configure a pose source.

use std::path::PathBuf;

use clap::builder::EnumValueParser;
use clap::error::ErrorKind;
use clap::parser::ValueSource;
use clap::{Arg, ArgMatches, Args, Command, ValueEnum};
use protocol::config::{document, options_of};
use serde::Serialize;

use super::settings::PoseSettings;

/// Identifier of the option that chooses the source.
pub(super) const CHOICE: &str = "pose_source";
/// Options of the networks of PGC, for every source that has them.
const NETWORKS: [&str; 3] = ["encoder", "head", "surfel_map"];
/// Option of the least confidence of its poses.
const MIN_CONFIDENCE: &str = "min_confidence";

/// The option that chooses the source.
pub(super) fn choice<K: ValueEnum + Clone + Send + Sync + 'static>() -> Arg {
    Arg::new(CHOICE)
        .long("pose-source")
        .value_name("POSE_SOURCE")
        .value_parser(EnumValueParser::<K>::new())
        .help("Source of the vehicle's pose [default: recorded]")
}

/// The options of a source.
pub(super) fn of<S: Args>() -> Vec<Arg> {
    options_of::<S>().collect()
}

/// Adds the options of a source, with their defaults.
pub(super) fn augment<S: PoseSettings + Args + Default + Serialize>(command: Command) -> Command {
    let defaults = serde_json::json!({ S::option_prefix(): S::default() });
    // For an update no option is required: those of sources that are not chosen stay absent.
    let command = S::augment_args_for_update(command);
    document(command, options_of::<S>(), &defaults)
}

/// Changes settings by the options that are given. Returns the options of their source.
pub(super) fn update<S: PoseSettings + Args>(
    settings: &mut S,
    matches: &ArgMatches,
) -> Result<Vec<Arg>, clap::Error> {
    settings.update_from_arg_matches(matches)?;
    let mut own = of::<S>();
    if let Some((files, least)) = settings.networks() {
        for (file, option) in files.into_iter().zip(NETWORKS) {
            own.push(Arg::new(option));
            if let Some(given) = matches.get_one::<PathBuf>(option) {
                file.clone_from(given);
            }
        }
        own.push(Arg::new(MIN_CONFIDENCE));
        if let Some(given) = matches.get_one::<f64>(MIN_CONFIDENCE) {
            *least = *given;
        }
    }
    Ok(own)
}

/// Refuses an option of `all` that is given and has no effect on the source, whose options are `own`.
pub(super) fn refuse_useless(
    source: &str,
    settings: &dyn PoseSettings,
    own: &[Arg],
    all: &[Arg],
    matches: &ArgMatches,
) -> Result<(), clap::Error> {
    let useless = all.iter().find(|option| {
        let id = option.get_id();
        let is_own = own.iter().any(|own| own.get_id() == id);
        // Options with a default always have a value: only those that were typed count.
        matches.value_source(id.as_str()) == Some(ValueSource::CommandLine)
            && !(is_own && settings.has_use_for(id.as_str()))
    });
    let Some(option) = useless else {
        return Ok(());
    };
    let option = option.get_long().unwrap_or_default();
    let mode = settings.mode();
    let mode = mode.map_or_else(String::new, |mode| format!(", {mode}"));
    let message = format!("--{option} has no effect on pose source {source}{mode}\n");
    Err(clap::Error::raw(ErrorKind::ArgumentConflict, message))
}

#[cfg(test)]
mod tests {
    use clap::{FromArgMatches as _, Parser};
    use protocol::config::Section;

    use super::super::{NoiseMode, NoisyPoseConfig, PoseSourceConfig};
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

    fn least_confidence(words: &[&str]) -> f64 {
        match parsed(words) {
            PoseSourceConfig::Pgc(pgc) => pgc.min_confidence,
            PoseSourceConfig::Tracked(tracked) => tracked.min_confidence,
            other => panic!("{other:?}"),
        }
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
        for source in ["--pose-source=pgc", "--pose-source=tracked"] {
            let words = [source, "--head=h", "--min-confidence=0.8"];
            assert_eq!(least_confidence(&words), 0.8);
            assert_eq!(least_confidence(&words[..2]), 0.0);
        }
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
            (
                "--pose-source=noisy --noise-step-s=1",
                "--noise-step-s has no effect on pose source noisy, noise mode independent",
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
