//! `sim-replay export`: a bag of ROS 2 from a recording.

use std::path::PathBuf;

use super::print_json;
use bus::log_to_stderr;
use recording::{ExportTimes, export_ros2};
use ros2::Mount;
use support::cli::{BadInput, Outcome};
use support::output;

/// Write a recording as a bag of ROS 2: clouds, poses, odometry, detections, tracks, transforms and diagnoses, without the
/// messages that ROS 2 has no types for.
///
/// `ros2 bag play --clock` and every reader of ROS 2 bags accept the file. Exit code 3: parts of the recording could not
/// be read.
#[derive(Debug, clap::Args)]
pub(crate) struct Args {
    /// Write for ROS 2, the one format there is.
    #[arg(long, required = true)]
    ros2: bool,
    /// The recording.
    from: PathBuf,
    /// The new bag.
    #[arg(value_name = "TO.mcap")]
    to: PathBuf,
    /// Times of the messages: `capture` as in their headers, so that the clock of a player and the stamps agree, or
    /// `arrival` at the recorder.
    #[arg(long, value_enum, default_value_t)]
    times: ExportTimes,
    /// Place of the LiDAR on its vehicle, for /tf_static: metres, and optionally its yaw in degrees.
    #[arg(long, value_name = "X,Y,Z[,YAW]", allow_hyphen_values = true)]
    lidar_mount: Option<Mount>,
    /// zstd level, 1 to 22 [default: not compressed].
    #[arg(long, value_name = "LEVEL", value_parser = clap::value_parser!(u32).range(1..=22))]
    zstd_level: Option<u32>,
    /// Print a JSON summary.
    #[arg(long)]
    json: bool,
}

/// Writes the bag and reports what is in it.
pub(crate) fn run(args: &Args) -> anyhow::Result<Outcome> {
    log_to_stderr();
    let (times, mount) = (args.times, args.lidar_mount.unwrap_or_default());
    let report = export_ros2(&args.from, &args.to, times, &mount, args.zstd_level);
    let report = report.map_err(BadInput::of)?;
    if args.json {
        print_json(&report)?;
    } else {
        let (messages, left_out, to) = (report.messages, report.left_out, args.to.display());
        output::line(format_args!(
            "{messages} messages in {to}; {left_out} others have no type in ROS 2"
        ))?;
        report.damage.iter().try_for_each(output::line)?;
    }
    Ok(Outcome::of(!report.damage.is_empty()))
}
