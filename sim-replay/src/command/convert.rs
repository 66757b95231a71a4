//! `sim-replay convert`: write a data set in another layout.

use std::path::{Component, Path, PathBuf};

use dataset::{self, IntensityOption, OpenOptions};
use simulator::generate::{Converted, SceneLayout, SynthError, convert};
use support::output;
use terminal::progress;

use support::cli::{BadInput, Outcome};

/// Problems that are printed; all are counted, and included in the JSON summary.
const SHOWN_PROBLEMS: usize = 10;

/// Write a data set in another layout: sweeps, poses and boxes are unchanged, as far as the layout can hold them.
///
/// The layout of the input is detected, as by `inspect`.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// The data set, split, scenario or sequence, or a recording.
    from: PathBuf,
    /// Folder for the scenarios; made if missing.
    #[arg(long)]
    out: PathBuf,
    /// Layout of the files.
    #[arg(long, value_enum)]
    layout: SceneLayout,
    #[command(flatten)]
    intensity: IntensityOption,
    /// Write into a folder that is not empty; existing files of the layout are replaced.
    #[arg(long)]
    force: bool,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Converts and prints a summary to standard output.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    let open = OpenOptions::with_intensity_scale(args.intensity.scale);
    let input = dataset::open_with(&args.from, &open).map_err(BadInput::of)?;
    if overlap(&args.from, &args.out) {
        return Ok(Outcome::bad_input(&format_args!(
            "{}: the input is in this folder; choose another folder for --out",
            args.out.display()
        )));
    }
    let bar = progress::bar(0, "frames");
    let advance = progress::shown_on(&bar);
    let result = convert(&input, &args.out, args.layout, args.force, &advance);
    bar.finish_and_clear();
    match result {
        Ok(converted) => {
            print(&converted, args)?;
            Ok(Outcome::of(!converted.left_out.is_nothing()))
        }
        Err(error @ SynthError::Write(_)) => Err(error.into()),
        Err(error) => Ok(Outcome::bad_input(&error)),
    }
}

/// True if one of the two contains the other: the input would be overwritten.
fn overlap(from: &Path, out: &Path) -> bool {
    let [from, out] = [from, out].map(real);
    from.zip(out)
        .is_some_and(|(from, out)| from.starts_with(&out) || out.starts_with(&from))
}

/// The path without links and `..`, also where its last folders do not exist yet.
fn real(path: &Path) -> Option<PathBuf> {
    let mut real = PathBuf::new();
    for component in std::path::absolute(path).ok()?.components() {
        if component == Component::ParentDir {
            real.pop();
        } else {
            real.push(component);
            real = real.canonicalize().unwrap_or(real);
        }
    }
    Some(real)
}

fn print(converted: &Converted, args: &Args) -> std::io::Result<()> {
    let (scenarios, agent_frames) = (converted.scenarios, converted.agent_frames);
    let (omitted, left_out) = (&converted.omitted, &converted.left_out);
    for problem in left_out.problems().take(SHOWN_PROBLEMS) {
        output::note(format_args!("left out: {}", problem.message));
    }
    if args.json {
        let report = serde_json::json!({
            "out": args.out, "layout": args.layout.name(), "scenarios": scenarios, "agent_frames": agent_frames,
            "omitted": omitted, "left_out": left_out,
        });
        return output::line(report);
    }
    output::line(format_args!(
        "{}: {scenarios} scenarios, {agent_frames} agent-frames, layout {}",
        args.out.display(),
        args.layout.name()
    ))?;
    super::synth::print_omitted(omitted)?;
    match left_out.to_string().as_str() {
        "" => Ok(()),
        summary => output::line(summary),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_input_is_not_written_over() {
        let folder = tempfile::tempdir().unwrap();
        let [from, out, inside] = ["a", "b", "a/c"].map(|name| folder.path().join(name));
        std::fs::create_dir_all(&inside).unwrap();
        assert!(!overlap(&from, &out), "a folder that is not there yet");
        std::fs::create_dir(&out).unwrap();
        assert!(!overlap(&from, &out));
        assert!(overlap(&from, &from) && overlap(&from, &inside) && overlap(&inside, &from));
        assert!(overlap(&from, &inside.join("..")));
        let link = out.join("link");
        std::os::unix::fs::symlink(&inside, &link).unwrap();
        assert!(overlap(&from, &inside.join("new/d")) && overlap(&from, &link.join("../new")));
        assert!(!overlap(&from, &inside.join("new/../../../new")));
    }
}
