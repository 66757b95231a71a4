//! Loss models: Bernoulli, Gilbert-Elliott, by distance, or from a trace.

use super::config::{FRAGMENT_BYTES, LinkConfig, LossModel, LossUnit};
use super::packet::Packet;
use super::trace::Step;
use support::random::SplitMix64;

/// State of the loss model on one direction of one link.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct LossState {
    is_bad: bool,
}

impl LossState {
    /// True if a message is lost; `step` is that of the trace at which its last bit was sent. Called for the messages of
    /// a link in the order in which they are sent.
    pub(super) fn loses(
        &mut self,
        config: &LinkConfig,
        packet: &Packet,
        step: Option<&Step>,
        random: &mut SplitMix64,
    ) -> bool {
        let units = match config.loss_unit {
            LossUnit::Message => 1,
            // An empty message is one fragment too: without any it could never be lost.
            LossUnit::Fragment => packet.bytes.div_ceil(FRAGMENT_BYTES).max(1),
        };
        let share = match &config.loss {
            LossModel::None => return false,
            LossModel::Bernoulli(share) => *share,
            LossModel::Distance(points) => interpolate(points, packet.distance_m),
            LossModel::Trace => step.map_or(0.0, |step| step.loss),
            LossModel::GilbertElliott {
                to_bad,
                to_good,
                loss_good,
                loss_bad,
            } => {
                let mut is_lost = false;
                for _ in 0..units {
                    // First the transition, then the loss in the state that it leads to.
                    let leaves = if self.is_bad { *to_good } else { *to_bad };
                    self.is_bad ^= random.chance(leaves);
                    is_lost |= random.chance(if self.is_bad { *loss_bad } else { *loss_good });
                }
                return is_lost;
            }
        };
        // Independent losses of all units at once.
        let survives = (1.0 - share).powi(i32::try_from(units).unwrap_or(i32::MAX));
        // `unit` is below 1: a share of 0 never loses, and a share of 1 always does.
        random.unit() >= survives
    }
}

/// Linear interpolation through `points` at `x`, constant beyond both ends; 0 without points.
fn interpolate(points: &[[f64; 2]], x: f64) -> f64 {
    let (before, after) = points.split_at(points.partition_point(|point| point[0] <= x));
    match (before, after) {
        ([], []) => 0.0,
        ([], [[_, y], ..]) | ([.., [_, y]], []) => *y,
        ([.., [x0, y0]], [[x1, y1], ..]) => y0 + (y1 - y0) * (x - x0) / (x1 - x0),
    }
}

#[cfg(test)]
mod tests {
    use protocol::{CavId, Stream};

    use super::*;

    const COUNT: u64 = 100_000;

    fn losses(law: &LossModel, unit: LossUnit, bytes: u64, distance_m: f64) -> f64 {
        let mut state = LossState::default();
        let config = LinkConfig {
            loss: law.clone(),
            loss_unit: unit,
            ..LinkConfig::default()
        };
        let [from, to] = ["1", "2"].map(|cav| CavId::new(cav).unwrap());
        let packet = Packet {
            id: 0,
            from,
            to,
            stream: Stream::Bev,
            sequence: 0,
            bytes,
            submitted_nanos: 0,
            distance_m,
        };
        let lost = (0..COUNT)
            .filter(|&k| state.loses(&config, &packet, None, &mut SplitMix64::derived(7, &[k])));
        lost.count() as f64 / COUNT as f64
    }

    fn three_sigma(share: f64) -> f64 {
        3.0 * (share * (1.0 - share) / COUNT as f64).sqrt()
    }

    #[test]
    fn a_message_survives_with_all_its_fragments() {
        for (bytes, fragments) in [(0, 1), (1, 1), (1400, 1), (1401, 2), (70_000, 50)] {
            let expected = 1.0 - 0.99f64.powi(fragments);
            let found = losses(&LossModel::Bernoulli(0.01), LossUnit::Fragment, bytes, 0.0);
            assert!(
                (found - expected).abs() < three_sigma(expected),
                "{bytes}: {found}, not {expected}"
            );
            let found = losses(&LossModel::Bernoulli(0.01), LossUnit::Message, bytes, 0.0);
            assert!((found - 0.01).abs() < three_sigma(0.01), "{found}");
        }
    }

    #[test]
    fn the_chain_has_its_stationary_loss() {
        let (to_bad, to_good, loss_good, loss_bad) = (0.02, 0.1, 0.001, 0.7);
        let law = LossModel::GilbertElliott {
            to_bad,
            to_good,
            loss_good,
            loss_bad,
        };
        let bad = to_bad / (to_bad + to_good);
        let expected = bad * loss_bad + (1.0 - bad) * loss_good;
        // Neighbours are correlated: the variance of the mean grows by (1 + r) / (1 - r) for the part explained by the
        // state.
        let r = 1.0 - to_bad - to_good;
        let between = bad * (1.0 - bad) * (loss_bad - loss_good) * (loss_bad - loss_good);
        let within = expected * (1.0 - expected) - between;
        let sigma = ((between * (1.0 + r) / (1.0 - r) + within) / COUNT as f64).sqrt();
        let found = losses(&law, LossUnit::Message, 1000, 0.0);
        assert!(
            (found - expected).abs() < 3.0 * sigma,
            "{found}, not {expected} +- {sigma}"
        );
    }

    #[test]
    fn distance_is_interpolated() {
        let law = LossModel::Distance(vec![[50.0, 0.0], [150.0, 0.5]]);
        for (distance_m, expected) in [
            (0.0, 0.0),
            (50.0, 0.0),
            (100.0, 0.25),
            (150.0, 0.5),
            (900.0, 0.5),
            (f64::INFINITY, 0.5),
        ] {
            let found = losses(&law, LossUnit::Message, 10, distance_m);
            assert!(
                (found - expected).abs() <= three_sigma(expected),
                "{distance_m}: {found}, not {expected}"
            );
        }
        assert_eq!(
            losses(&LossModel::Distance(Vec::new()), LossUnit::Message, 10, 5.0),
            0.0
        );
        assert_eq!(
            losses(&LossModel::Bernoulli(1.0), LossUnit::Message, 10, 5.0),
            1.0
        );
    }
}
