//! Table of an evaluation: one row per sweep.

use protocol::Pose;
use support::csv_file::CsvText;

use super::{EvaluatedSweep, outcome};
use localization::pgc::PoseEvidence;

const HEADER: &str = "scenario,cav,frame,true_x_m,true_y_m,true_z_m,true_yaw_deg,x_m,y_m,z_m,yaw_deg,error_m,error_deg,\
    sigma,outcome,cells,inliers,inlier_ratio,rms_m,inlier_epsilon_m,median_epsilon_m,position_std_m,rotation_std_deg,\
    second_inlier_ratio,second_rms_m,second_epsilon_m,moved_m,residual_quartile_m,information_per_m2,worst_axis_std_m,ms";

/// One row per sweep; fields of sweeps without a pose are empty, and the evidence of methods without cells.
pub fn csv(sweeps: &[EvaluatedSweep]) -> String {
    let mut text = CsvText::new(HEADER);
    sweeps.iter().for_each(|sweep| text.row(row(sweep)));
    text.finish()
}

fn row(sweep: &EvaluatedSweep) -> Vec<String> {
    let localization = &sweep.localization;
    let (scenario, stem) = (sweep.scenario.clone(), sweep.stem.clone());
    let mut fields = vec![scenario, sweep.cav.to_string(), stem];
    fields.extend(pose(&sweep.truth));
    let found = localization.found.zip(sweep.error());
    if let Some((found, error)) = &found {
        fields.extend(pose(&found.world_from_sensor.into()));
        fields.extend([error.distance_m, error.angle_deg, found.sigma].map(four));
    }
    let columns = || HEADER.split(',');
    let before_outcome = columns().position(|column| column == "outcome");
    fields.resize(before_outcome.unwrap_or_default(), String::new());
    fields.push(outcome(&localization.estimate).to_owned());
    // Methods without cells have no evidence of this kind.
    let evidence = found.map(|(found, _)| found.evidence);
    if let Some(evidence) = evidence.filter(|evidence| evidence.cells > 0) {
        fields.extend(evidence_fields(&evidence));
    }
    // All but the last, the time.
    fields.resize(columns().count() - 1, String::new());
    let total_ms = localization.times.total().as_secs_f64() * 1e3;
    fields.push(format!("{total_ms:.3}"));
    fields
}

fn evidence_fields(evidence: &PoseEvidence) -> Vec<String> {
    let mut fields = vec![evidence.cells.to_string(), evidence.inliers.to_string()];
    fields.extend(
        [
            evidence.inlier_ratio,
            evidence.rms_m,
            evidence.inlier_epsilon_m,
            evidence.median_epsilon_m,
            evidence.position_std_m,
            evidence.rotation_std_rad.to_degrees(),
        ]
        .map(four),
    );
    if let Some(second) = &evidence.second {
        fields.extend([
            four(second.inlier_ratio),
            four(second.rms_m),
            four(second.median_epsilon_m),
            four(second.moved_m),
            four(second.residual_quartile_m),
            format!("{:.3}", second.information_per_m2),
            four(second.worst_axis_std_m),
        ]);
    }
    fields
}

fn four(value: f64) -> String {
    format!("{value:.4}")
}

fn pose(pose: &Pose) -> [String; 4] {
    let [x, y, z] = pose.translation_m;
    [x, y, z, pose.yaw_rad().to_degrees()].map(four)
}

/// The errors of all sweeps, as the table that the pose source `noisy` replays.
pub fn error_table(sweeps: &[EvaluatedSweep]) -> String {
    let mut text = CsvText::new("x_m,y_m,z_m,yaw_deg,confidence");
    for sweep in sweeps {
        let estimate = &sweep.localization.estimate;
        match estimate.world_from_cav() {
            Some(world_from_cav) => {
                let error = sweep.truth.isometry().inv_mul(&world_from_cav.isometry());
                let [x, y, z, yaw] = pose(&error.into());
                text.row([x, y, z, yaw, format!("{:.4}", estimate.confidence())]);
            }
            None => text.row(["no_pose"]),
        }
    }
    text.finish()
}

#[cfg(test)]
mod tests {
    use super::super::tests::evaluated;
    use super::*;
    use localization::pgc::Localization;
    use localization::pose_source::ErrorTable;

    #[test]
    fn every_row_has_every_column() {
        let sweeps = evaluated(40);
        assert!(
            sweeps
                .iter()
                .any(|sweep| sweep.localization.found.is_none())
        );
        let text = csv(&sweeps);
        let columns: Vec<usize> = text.lines().map(|line| line.split(',').count()).collect();
        assert!(
            columns.len() == 41 && columns.iter().all(|&count| count == columns[0]),
            "{columns:?}"
        );
    }

    #[test]
    fn a_method_without_cells_has_no_evidence() {
        let mut sweep = evaluated(1).swap_remove(0);
        let times = sweep.localization.times.clone();
        let estimate = sweep.localization.estimate;
        sweep.localization = Localization::from_estimate(estimate, times);
        let text = csv(&[sweep]);
        let mut lines = text.lines().map(|line| line.split(',').collect::<Vec<_>>());
        let (columns, fields) = (lines.next().unwrap(), lines.next().unwrap());
        for (column, field) in columns.iter().zip(&fields).skip(14) {
            let is_stated = ["outcome", "ms"].contains(column);
            assert_eq!(field.is_empty(), !is_stated, "{column} {field}");
        }
        assert_eq!((columns[13], fields[14]), ("sigma", "pose"));
    }

    #[test]
    fn errors_are_replayed_as_they_were() {
        let sweeps = evaluated(40);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("errors.csv");
        std::fs::write(&path, error_table(&sweeps)).unwrap();
        let table = ErrorTable::read(&path).unwrap();
        for (step, sweep) in sweeps.iter().enumerate() {
            match (table.row(0, step as u64), sweep.published_error()) {
                (Some((error, _)), Some(estimated)) => {
                    assert!((error.distance_m() - estimated.distance_m).abs() < 1e-3);
                }
                (None, None) => {}
                other => panic!("{other:?}"),
            }
        }
    }
}
