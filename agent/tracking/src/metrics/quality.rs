//! Track quality: the numbers of all metrics, as tables and JSON show them.

use serde::Serialize;

use super::{Amota, Hota, IdentityCounts, MATCH_DISTANCE_M, Sequence};

/// Quality of tracks; `None` where a number is not defined.
///
/// AMOTA and AMOTP average over thresholds on the score. All others hold at the threshold of the best MOTA, as in
/// nuScenes.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct TrackQuality {
    /// See [`Amota::amota`].
    pub amota: Option<f64>,
    /// See [`Amota::amotp_m`].
    pub amotp_m: Option<f64>,
    /// Lowest mean score of a track that counts below: the threshold of the best MOTA.
    pub min_score: Option<f64>,
    /// MOTA; negative where errors outnumber objects.
    pub mota: Option<f64>,
    /// MOTP, metres.
    pub motp_m: Option<f64>,
    /// Share of the object points that are tracked.
    pub recall: Option<f64>,
    /// Identity switches.
    pub ids: Option<usize>,
    /// Fragmentations.
    pub frag: Option<usize>,
    /// False positives.
    pub fp: Option<usize>,
    /// Misses.
    #[serde(rename = "fn")]
    pub misses: Option<usize>,
    /// Objects that are tracked in at least 80 % of their frames.
    pub mt: Option<usize>,
    /// Objects that are tracked in less than 20 % of their frames.
    pub ml: Option<usize>,
    /// Number of true tracks.
    pub true_tracks: Option<usize>,
    /// HOTA over centre distances, see [`Hota`].
    pub hota: Option<f64>,
    /// Detection accuracy of HOTA.
    pub det_a: Option<f64>,
    /// Association accuracy of HOTA.
    pub ass_a: Option<f64>,
    /// IDF1.
    pub idf1: Option<f64>,
}

impl TrackQuality {
    /// Quality of the tracks of all sequences.
    pub fn of(sequences: &[Sequence]) -> Self {
        let Some(found) = Amota::of(sequences) else {
            return Self::default();
        };
        let averages = Self {
            amota: Some(found.amota),
            amotp_m: Some(found.amotp_m),
            ..Self::default()
        };
        let Some(best) = found.best else {
            return averages;
        };
        let averaged: Vec<Sequence> = sequences.iter().map(Sequence::with_mean_scores).collect();
        let kept = Sequence::with_min_score(&averaged, best.min_score);
        let hota = Hota::of(&kept);
        Self {
            min_score: Some(best.min_score),
            mota: best.counts.mota(),
            motp_m: best.counts.motp_m(),
            recall: best.counts.recall(),
            ids: Some(best.counts.switches),
            frag: Some(best.counts.fragmentations),
            fp: Some(best.counts.false_positives),
            misses: Some(best.counts.misses),
            mt: Some(best.counts.mostly_tracked),
            ml: Some(best.counts.mostly_lost),
            true_tracks: Some(best.counts.true_tracks),
            hota: hota.map(|hota| hota.hota),
            det_a: hota.map(|hota| hota.det_a),
            ass_a: hota.map(|hota| hota.ass_a),
            idf1: IdentityCounts::of(&kept, MATCH_DISTANCE_M).f1(),
            ..averages
        }
    }
}
