//! Runs of a sweep as one CSV, a line each, in the order of the grid.

use deploy::operate::run_folder::{fixed, plain};
use fusion::Exchange;
use protocol::DropReason;
use support::csv_file::CsvText;

use super::Run;
use crate::experiment::spec::Experiment;

/// Reasons with a column of their own; the last column is the sum of the others.
const REASONS: [DropReason; 7] = {
    use DropReason::{Duplicate, LinkLoss, LinkQueue, NoPose, OutOfRange, Stale, Superseded};
    [
        LinkLoss, LinkQueue, Superseded, Stale, Duplicate, NoPose, OutOfRange,
    ]
};

/// Names of the columns.
pub(super) const COLUMNS: &str = "method,dtype,keep,zstd,latency_ms,jitter_ms,bandwidth_mbps,loss,noise_t,noise_r,vehicles,seed,frames,\
    ap_global_30,ap_global_50,ap_global_70,ap_frame_30,ap_frame_50,ap_frame_70,payload_bytes,wire_bytes,log2_payload,\
    log2_wire,log2_frame,log2_fp32,nominal_fp32_log2,e2e_ms_p50,e2e_ms_p95,e2e_ms_p99,age_ms_p50,age_ms_p95,frames_used,\
    stale,sent,received,in_flight,dropped_link_loss,dropped_link_queue,dropped_superseded,dropped_stale,dropped_duplicate,\
    dropped_no_pose,dropped_out_of_range,dropped_other";

/// Definitions of columns whose names are not enough: a line `COLUMN, ...: definition` each.
pub(super) const NOTES: &str = include_str!("column_notes.txt");

/// The whole table.
pub fn csv(experiment: &Experiment, runs: &[Run]) -> String {
    let mut text = CsvText::new(COLUMNS);
    runs.iter().for_each(|run| text.row(line(experiment, run)));
    text.finish()
}

/// Fields of the line of a run.
pub(super) fn line(experiment: &Experiment, Run { point, cell }: &Run) -> Vec<String> {
    let (metrics, used, messages) = (&cell.metrics, cell.used, &cell.messages);
    let codec = (point.method.exchange() == Exchange::Features).then_some(point.codec);
    // The size of a compressed, fitted or sparse map, and that of boxes, has no fixed ratio to the values of a map.
    let is_plain = codec.is_some_and(|codec| {
        let is_whole = codec.keep.is_none_or(|keep| keep >= 1.0) && point.method.gate().is_none();
        is_whole && codec.fit.is_none() && codec.zstd_level.is_none() && codec.boxes.is_none()
    });
    // A point has no rate where it is unlimited, and where the grid does not vary it.
    let bandwidth = match point.bandwidth_mbps {
        None if experiment.grid.bandwidth_mbps.is_some() => "inf".into(),
        mbps => plain(mbps),
    };
    let mut fields = vec![
        point.method.name().to_owned(),
        plain(codec.map(|codec| codec.name())),
        plain(codec.and_then(|codec| codec.keep)),
        plain(codec.and_then(|codec| codec.zstd_level)),
        plain(point.latency_ms),
        plain(point.jitter_ms),
        bandwidth,
        plain(point.loss),
        plain(point.pose_noise.map(|noise| noise.position_std_m)),
        plain(point.pose_noise.map(|noise| noise.heading_std_deg)),
        plain(point.vehicles),
        // Without seeds in the grid each random part keeps its own.
        plain(experiment.grid.seed.as_ref().map(|_| point.seed)),
        metrics.frames.to_string(),
    ];
    for ap in [metrics.ap_global, metrics.ap_frame_order] {
        fields.extend(ap.values().map(|precision| fixed(precision, 4)));
    }
    let comm = &metrics.comm;
    fields.extend([
        fixed(comm.payload_bytes_mean, 1),
        fixed(comm.wire_bytes_mean, 1),
        fixed(comm.log2_payload, 4),
    ]);
    let per_frame = used as f64 / metrics.frames.max(1) as f64;
    let payload = comm.payload_bytes_mean.filter(|_| is_plain);
    let sizes = [
        comm.wire_bytes_mean,
        comm.wire_bytes_mean.map(|bytes| bytes * per_frame),
        payload.map(|bytes| bytes * 4.0 / point.codec.dtype.size() as f64),
    ];
    fields.extend(sizes.map(|bytes| fixed(bytes.filter(|bytes| *bytes > 0.0).map(f64::log2), 4)));
    fields.push(fixed(Some(comm.nominal_fp32_log2), 4));
    let (latency, age) = (&metrics.latency_ms.capture_to_detection, &metrics.age_ms);
    fields.extend([latency.p50, latency.p95, latency.p99, age.p50, age.p95].map(|ms| fixed(ms, 3)));
    let dropped = REASONS.map(|reason| messages.dropped.get(&reason).copied().unwrap_or(0));
    let stale = messages.dropped.get(&DropReason::Stale).copied();
    let mut counts = vec![
        used,
        stale.unwrap_or(0),
        messages.sent,
        messages.received,
        messages.in_flight,
    ];
    counts.extend(dropped);
    let all: u64 = messages.dropped.values().sum();
    counts.push(all - dropped.iter().sum::<u64>());
    fields.extend(counts.iter().map(ToString::to_string));
    fields
}

#[cfg(test)]
pub(super) mod tests;
