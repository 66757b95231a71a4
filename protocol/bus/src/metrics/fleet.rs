//! Fleet metrics: the series of several processes as one document.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::net::SocketAddr;
use std::thread;
use std::time::Duration;

use crate::web;

/// Longest time that a process is waited for; a stopped one must not hold up the others.
const WAIT_LIMIT: Duration = Duration::from_millis(800);

/// Another process of the fleet that serves its series.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MetricsPeer {
    /// Its name.
    pub process: String,
    /// Its address.
    pub address: SocketAddr,
}

/// One document of the own series and those of the others, with `v2vloc_process_up` for each of the others.
pub(super) fn fleet_exposition(own: &str, others: &[MetricsPeer]) -> String {
    // All at once: slow processes delay the document by one limit, not by one limit each.
    let texts: Vec<Option<String>> = thread::scope(|scope| {
        let threads: Vec<_> = others
            .iter()
            .map(|peer| scope.spawn(move || series_of(peer)))
            .collect();
        threads
            .into_iter()
            .map(|thread| thread.join().ok().flatten())
            .collect()
    });
    let mut up = String::from(
        "# HELP v2vloc_process_up Process serves its series.\n# TYPE v2vloc_process_up gauge\n",
    );
    for (peer, text) in others.iter().zip(&texts) {
        // Writing to a string cannot fail. Names of processes need no escape.
        let (process, is_up) = (&peer.process, u8::from(text.is_some()));
        let _ = writeln!(up, "v2vloc_process_up{{process=\"{process}\"}} {is_up}");
    }
    let served = texts.iter().flatten().map(String::as_str);
    merged([own, &up].into_iter().chain(served))
}

fn series_of(peer: &MetricsPeer) -> Option<String> {
    let (status, body) = web::fetch_within(peer.address, "/metrics", WAIT_LIMIT).ok()?;
    let is_found = status.contains(" 200 ");
    String::from_utf8(body).ok().filter(|_| is_found)
}

/// Several documents as one: OpenMetrics wants the samples of a family together, described once.
fn merged<'a>(texts: impl Iterator<Item = &'a str>) -> String {
    // Description and samples of each family.
    let mut families: BTreeMap<&str, [String; 2]> = BTreeMap::new();
    for text in texts {
        let (mut family, mut is_known) = ("", false);
        for line in text
            .lines()
            // Each document ends in this line, which may occur only once in the merged one.
            .filter(|line| !line.is_empty() && *line != "# EOF")
        {
            if let Some(described) = line.strip_prefix("# ") {
                let name = described.split(' ').nth(1).unwrap_or_default();
                if name != family {
                    (family, is_known) = (name, families.contains_key(name));
                }
                let [description, _] = families.entry(family).or_default();
                if !is_known {
                    description.extend([line, "\n"]);
                }
            } else {
                let [_, samples] = families.entry(family).or_default();
                samples.extend([line, "\n"]);
            }
        }
    }
    let texts = families.into_values().flatten();
    texts.chain(["# EOF\n".to_owned()]).collect()
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn samples_of_a_family_are_together_and_described_once() {
        let [first, second] = ["a", "b"].map(|process| {
            format!(
                "# HELP v2vloc_ticks Ticks.\n# TYPE v2vloc_ticks counter\nv2vloc_ticks_total{{process=\"{process}\"}} 1\n\
                 # HELP v2vloc_stage_seconds Stage.\n# TYPE v2vloc_stage_seconds histogram\n\
                 v2vloc_stage_seconds_sum{{process=\"{process}\"}} 2\n# EOF\n"
            )
        });
        let expected = "# HELP v2vloc_stage_seconds Stage.\n# TYPE v2vloc_stage_seconds histogram\n\
                        v2vloc_stage_seconds_sum{process=\"a\"} 2\nv2vloc_stage_seconds_sum{process=\"b\"} 2\n\
                        # HELP v2vloc_ticks Ticks.\n# TYPE v2vloc_ticks counter\n\
                        v2vloc_ticks_total{process=\"a\"} 1\nv2vloc_ticks_total{process=\"b\"} 1\n# EOF\n";
        assert_eq!(merged([first.as_str(), &second].into_iter()), expected);
    }

    #[test]
    fn a_process_that_does_not_answer_is_down_and_delays_nobody() {
        let silent = TcpListener::bind("127.0.0.1:0").unwrap();
        let closed = TcpListener::bind("127.0.0.1:0")
            .unwrap()
            .local_addr()
            .unwrap();
        let peers = [("agent-1", silent.local_addr().unwrap()), ("ego-1", closed)];
        let others = peers.map(|(process, address)| MetricsPeer {
            process: process.into(),
            address,
        });
        let began = std::time::Instant::now();
        let text = fleet_exposition("# TYPE a gauge\na 1\n# EOF\n", &others);
        assert!(began.elapsed() < 3 * WAIT_LIMIT, "{:?}", began.elapsed());
        for line in [
            "a 1",
            "v2vloc_process_up{process=\"agent-1\"} 0",
            "v2vloc_process_up{process=\"ego-1\"} 0",
        ] {
            assert!(
                text.lines().any(|found| found == line),
                "{line} is not in\n{text}"
            );
        }
    }
}
